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
"""Rates at which to search for Dynamixels [baud]: the factory rate, then the usual ones."""

FEETECH_RATES = (1_000_000, 115_200, 500_000)
"""Rates at which to search for Feetech servos [baud]: the factory rates (TTL and RS-485)."""


@dataclass(frozen=True, slots=True)
class Address:
    """An address and the devices found there.

    Attributes:
        address: A tty, a network address or a CAN channel.
        about: The system's description of it.
        found: The devices that answered.
        problem: Why it could not be probed; empty if it could.
    """

    address: str
    about: str = ""
    found: tuple[Found, ...] = ()
    problem: str = ""


@dataclass(frozen=True, slots=True)
class ScanPlan:
    """The probes for one address.

    Attributes:
        about: The system's description of it.
        probes: The probes, in order.
    """

    address: str
    about: str = ""
    probes: tuple[Probe, ...] = field(default=())


def serial_ports() -> list[tuple[str, str]]:
    """Return the serial ports of this computer and their descriptions."""
    from serial.tools.list_ports import comports

    return [
        # USB adapters only, since a hand is seldom on a computer's own serial port.
        (port.device, port.description or "")
        for port in sorted(comports())
        if port.vid is not None
    ]


def serial_probes(units: Sequence[int] | None = None) -> tuple[Probe, ...]:
    """Return the probes for a serial port, fastest first; by default at usual Modbus numbers."""
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
    """Return the probes for a network address."""
    return (probes.wsg50(), probes.modbus(115200, "N", units or (65, 66, 67, 2, 9, 1)))


async def scan(
    plans: Sequence[ScanPlan], pool: BusPool, tell: Callable[[str], None] = lambda line: None
) -> list[Address]:
    """Probe all addresses, one after the other; moves nothing.

    A port that another program has open is left alone. Once a line has answered one protocol, only
    other rates of that protocol are probed. A device that answers several probes is listed once.

    Args:
        plans: The addresses and their probes.
        pool: The buses.
        tell: Called with the address and name of each probe.
    """
    return [await _ask(plan, pool, tell) for plan in plans]


async def _ask(plan: ScanPlan, pool: BusPool, tell: Callable[[str], None]) -> Address:
    found: list[Found] = []
    protocol = ""
    for probe in plan.probes:
        if protocol and probe.name != protocol:
            continue
        tell(f"{plan.address}: {probe.name}")
        try:
            answers = await probe.ask(pool, plan.address)
        except BusBusy as error:
            return Address(plan.address, plan.about, problem=error.message)
        except BusError as error:
            # Devices that were found are worth more than the error of a later probe.
            if not found:
                return Address(plan.address, plan.about, problem=error.message)
            continue
        # The line speaks this protocol, so probes of other protocols would only disturb it.
        if answers:
            protocol = probe.name
            found += [one for one in answers if one not in found]
    return Address(plan.address, plan.about, tuple(found))
