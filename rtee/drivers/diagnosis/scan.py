"""Scan all buses of this computer for devices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from rtee.buses.pool import BusPool
from rtee.drivers.diagnosis import probes
from rtee.drivers.diagnosis.probes import Probe
from rtee.drivers.diagnosis.slaves import Found
from rtee.errors import BusBusy, BusError

DYNAMIXEL_RATES = (57600, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 115200)
"""Rates at which Dynamixels are looked for [baud]: as from the factory, then the usual ones."""

FEETECH_RATES = (1_000_000, 115_200, 500_000)
"""Rates at which Feetech servos are looked for [baud]: as from the factory, by TTL and RS-485."""


@dataclass(frozen=True, slots=True)
class Address:
    """An address and what was found there.

    Attributes:
        address: A tty, a network address or a CAN channel.
        about: What the system knows of it.
        found: The devices that answered.
        problem: Why it could not be asked; empty when it could.
    """

    address: str
    about: str = ""
    found: tuple[Found, ...] = ()
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Plan:
    """What to ask at one address.

    Attributes:
        address: The address.
        about: What the system knows of it.
        probes: The questions, in order.
    """

    address: str
    about: str = ""
    probes: tuple[Probe, ...] = field(default=())


def serial_ports() -> list[tuple[str, str]]:
    """Return the serial ports of this computer and what they say they are."""
    from serial.tools.list_ports import comports

    return [
        # USB adapters only: a computer's own serial ports seldom lead to a hand.
        (port.device, port.description or "")
        for port in sorted(comports())
        if port.vid is not None
    ]


def serial_probes(units: Sequence[int] | None = None) -> tuple[Probe, ...]:
    """Return the questions for a serial port, fastest first.

    Args:
        units: Modbus numbers to ask; by default the usual ones.
    """
    return (
        probes.wsg50(),
        probes.svh(),
        probes.ability_hand(),
        probes.orca_touch(),
        probes.softhand(range(1, 10)),
        probes.rh56(range(1, 5)),
        probes.linkerhand(),
        probes.modbus(115200, "N", units or (*range(1, 17),), name="Robotiq"),
        probes.modbus(1_000_000, "E", units or (65, 66, 67), name="OnRobot"),
        probes.modbus(115200, "E", units or (12, 65, 66, 67), name="SCHUNK EGU, OnRobot"),
        *(probes.feetech(rate) for rate in FEETECH_RATES),
        *(probes.dynamixel(rate) for rate in DYNAMIXEL_RATES),
    )


def network_probes(units: Sequence[int] | None = None) -> tuple[Probe, ...]:
    """Return the questions for a network address."""
    return (probes.wsg50(), probes.modbus(115200, "N", units or (65, 66, 67, 2, 9, 1)))


async def scan(
    plans: Sequence[Plan], pool: BusPool, tell: Callable[[str], None] = lambda line: None
) -> list[Address]:
    """Ask at all addresses, one after the other; nothing moves by it.

    A port that another program holds is left alone. On a line where somebody answered in one
    language, the other languages are not tried, only other rates of the same one. A device that
    answers to several questions is listed once.

    Args:
        plans: Where to ask what.
        pool: The buses.
        tell: Called with what is being asked.
    """
    return [await _ask(plan, pool, tell) for plan in plans]


async def _ask(plan: Plan, pool: BusPool, tell: Callable[[str], None]) -> Address:
    found: list[Found] = []
    language = ""
    for probe in plan.probes:
        if language and probe.name != language:
            continue
        tell(f"{plan.address}: {probe.name}")
        try:
            answers = await probe.ask(pool, plan.address)
        except BusBusy as error:
            return Address(plan.address, plan.about, problem=error.message)
        except BusError as error:
            # What has been found is worth more than the error of a later question.
            if not found:
                return Address(plan.address, plan.about, problem=error.message)
            continue
        if answers:
            language = probe.name
            found += [one for one in answers if one not in found]
    return Address(plan.address, plan.about, tuple(found))
