"""The LinkerHands O6 and L10 pass the suite of all drivers: over Modbus RTU, and on CAN."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import pytest

from rtee.drivers.axis import VirtualObject
from rtee.drivers.linkerhand.codec import L10, MOST, O6, Model, Table
from rtee.drivers.linkerhand.emulator import LinkerHandEmulator
from rtee.testing import DeviceCase, DriverContract, actuator, cycles
from rtee.types import ActuatorSpec


def actuators_of(model: Model) -> tuple[ActuatorSpec, ...]:
    return tuple(
        actuator(name, min(ends), max(ends), effort=2.0)
        for name, ends in zip(model.motors, model.ranges, strict=True)
    )


def held(emulator: LinkerHandEmulator) -> None:
    """Have the hand press on something halfway, as another program may have left it."""
    for closing in emulator.closings():
        closing.motor.obstacle = VirtualObject(128.0, 50.0, -1.0)
    emulator.set_table(Table.POSITION, 0, [60] * emulator.model.count)
    for axis in emulator.axes:
        axis.advance(3.0)
    emulator.moves = 0
    assert abs(emulator.axes[2].effort) > 100.0


def efforts(emulator: Any) -> list[float]:
    return [torque / MOST * 2.0 for torque in emulator.begun]


CASE = DeviceCase(
    driver="linkerhand",
    actuators=actuators_of(O6),
    options={"emulator": {"haste": 4.0}, "health_every": 5},
    grip_object=held,
    commands=lambda emulator: int(emulator.moves),
    efforts=efforts,
    max_efforts=[0.4, 0.8, 1.2, 1.6, 2.0, 1.0],
    fault="over_current",
    homes=False,
    cycles=cycles(100),
)
CAN = {**CASE.options, "channel": "can0"}
CAN_FAULTS = frozenset({"drop", "corrupt", "duplicate", "delay"})


class TestO6(DriverContract):
    case: ClassVar[DeviceCase] = CASE


@pytest.mark.heavy
class TestL10(DriverContract):
    case: ClassVar[DeviceCase] = replace(
        CASE,
        actuators=actuators_of(L10),
        options={**CASE.options, "model": "l10"},
        max_efforts=[0.4, 0.8, 1.2, 1.6, 2.0, 1.0, 0.5, 0.6, 0.7, 0.9],
    )


@pytest.mark.heavy
class TestO6OnCan(DriverContract):
    case: ClassVar[DeviceCase] = replace(CASE, options=CAN, wire_faults=CAN_FAULTS)


class TestL10OnCan(DriverContract):
    case: ClassVar[DeviceCase] = replace(
        TestL10.case, options={**CAN, "model": "l10"}, wire_faults=CAN_FAULTS
    )
