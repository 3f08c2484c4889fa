"""Recognise Modbus slaves by registers that only they have; nothing is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

from rtee.buses.modbus import ModbusBus, ModbusRefusal
from rtee.buses.modbus_frames import READ_HOLDING, READ_INPUT
from rtee.buses.parser import CodecError
from rtee.errors import BusTimeout, FrameError

_ROBOTIQ = 9
"""Factory Modbus number of Robotiq's grippers."""
_HANDS = (1, 2)
"""Factory Modbus number of an RH56, and the number of the second hand of a pair."""
ANSWER = ContextVar("ANSWER", default=0.04)
"""Longest time for an answer [s]: slaves need about 10 ms, a busy computer or a network more."""


@dataclass(frozen=True, slots=True)
class Found:
    """A device that answered.

    Attributes:
        driver: Name of its driver; empty if there is none.
        what: Its name and identity, in words.
        options: Options for hand.yaml to connect to it.
    """

    driver: str
    what: str
    options: Mapping[str, Any] = field(default_factory=dict)


async def slave(bus: ModbusBus, address: str, unit: int) -> Found | None:
    """Return the Modbus slave with a number, with its driver if it is known."""
    options: dict[str, Any] = {"port": address, "unit": unit}
    robotiq = await _registers(bus, unit, 0x07D0, 8)
    if robotiq is None and unit == _ROBOTIQ:
        robotiq = await _registers(bus, unit, 0x07D0, 8, READ_INPUT)
    # For registers that they do not have, devices may return zeros, like an inactive gripper, or
    # not answer.
    doubtful = robotiq is None and unit in _HANDS
    zeros = isinstance(robotiq, tuple) and not any(robotiq)
    refused = isinstance(robotiq, ModbusRefusal)
    if doubtful or zeros or refused:
        rh56 = await _rh56(bus, unit, options)
        if rh56 is not None:
            return rh56
    # Robotiq's grippers do not answer requests for unknown registers; OnRobot's refuse them.
    if zeros or refused:
        known = await _onrobot(bus, unit, options) or await _egu(bus, unit, options)
        if known is not None:
            return known
        if refused or unit != _ROBOTIQ:
            return Found("", f"a Modbus slave, unit {unit}", options)
    return _robotiq(robotiq, unit, options) if isinstance(robotiq, tuple) else None


async def _egu(bus: ModbusBus, unit: int, options: Mapping[str, Any]) -> Found | None:
    """Return a SCHUNK EGU or EGK if the slave has its module type."""
    from rtee.drivers.schunk_egu.codec import MODULES, Parameter

    module = await _registers(bus, unit, Parameter.MODULE.register, 1)
    # The low byte comes first.
    name = MODULES.get(module[0] >> 8) if isinstance(module, tuple) else None
    return None if name is None else Found("schunk_egu", f"SCHUNK {name}, unit {unit}", options)


async def _onrobot(bus: ModbusBus, unit: int, options: Mapping[str, Any]) -> Found | None:
    """Return an OnRobot gripper if the slave has its diameters or its product code."""
    from rtee.drivers.onrobot_3fg.codec import LIMITS
    from rtee.drivers.onrobot_common import PRODUCT, PRODUCTS
    from rtee.drivers.onrobot_rg.codec import MODELS

    limits = await _registers(bus, unit, LIMITS, 2)
    if isinstance(limits, tuple) and 0 < limits[0] < limits[1]:
        return Found("onrobot_3fg", f"OnRobot 3FG, unit {unit}", options)
    code = await _registers(bus, unit, PRODUCT, 1)
    name = PRODUCTS.get(code[0]) if isinstance(code, tuple) else None
    if name is None:
        return None
    if name.lower() not in MODELS:
        return Found("", f"OnRobot {name}, unit {unit}", options)
    return Found("onrobot_rg", f"OnRobot {name}, unit {unit}", {**options, "model": name.lower()})


async def _rh56(bus: ModbusBus, unit: int, options: Mapping[str, Any]) -> Found | None:
    """Return an RH56 if the slave returns plausible angles, states and temperatures."""
    from rtee.drivers.inspire_rh56.codec import GAP, REPORT, WORDS, Register, Report, State
    from rtee.drivers.inspire_rh56.link import ModbusLink

    link = ModbusLink(bus, unit, ANSWER.get(), 0)
    try:
        angles = await link.read(Register.ANGLE, WORDS)
        report = Report.from_bytes(angles + GAP + await link.read(Register.FORCE, REPORT))
    except (BusTimeout, FrameError, ModbusRefusal, CodecError):
        return None
    # Registers full of zeros would pass for a report, but no motor is at 0 °C. Among other
    # devices, only published states count.
    if not all(report.temperatures) or State.OTHER in report.states:
        return None
    protocol = {"protocol": "modbus"} if bus.rtu else {}
    return Found("inspire_rh56", f"Inspire RH56, unit {unit}", {**options, **protocol})


def _robotiq(registers: Sequence[int], unit: int, options: dict[str, Any]) -> Found:
    from rtee.drivers.robotiq_2f.codec import Status as Status2
    from rtee.drivers.robotiq_3f.codec import Status as Status3

    try:
        Status3.from_registers(registers)
        # The registers after its first three are 0 in a two-finger gripper.
        three = bool(registers[6] >> 8 or registers[4] or registers[5])
        if three:
            return Found("robotiq_3f", f"Robotiq 3-Finger, unit {unit}", options)
        Status2.from_registers(registers)
    except FrameError:
        return Found("", f"a Modbus slave with registers at 2000, unit {unit}", options)
    return Found("robotiq_2f", f"Robotiq 2-finger gripper, unit {unit}", options)


async def _registers(
    bus: ModbusBus, unit: int, address: int, count: int, function: int = READ_HOLDING
) -> tuple[int, ...] | ModbusRefusal | None:
    try:
        return await bus.read(
            unit, address, count, deadline=ANSWER.get(), retries=0, function=function
        )
    # A refusal is an answer, too: there is a slave.
    except ModbusRefusal as refusal:
        return refusal
    except (BusTimeout, FrameError):
        return None
