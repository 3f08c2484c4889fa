"""CiA 402 drives pass the suite of all drivers."""

from __future__ import annotations

from typing import Any

from rtee.drivers.cia402.codec import State
from rtee.testing import DeviceCase, DriverContract, actuator, cycles
from tests.drivers.suites import few_faults

NAMES = ("left",)


def held(emulator: Any) -> None:
    for drive in emulator.drives.values():
        drive._become(State.ENABLED)


def moves(emulator: Any) -> int:
    return sum(drive.axis.target != 0.0 for drive in emulator.drives.values())


def limits(emulator: Any) -> list[float]:
    return [drive.node.get(0x6072) / 1000.0 * 0.5 for drive in emulator.drives.values()]


def case(mode: str) -> DeviceCase:
    return DeviceCase(
        driver="cia402",
        actuators=tuple(actuator(name, -0.5, 1.5, effort=0.4, rest=0.0) for name in NAMES),
        options={
            "nodes": {"left": {"id": 3}},
            "mode": mode,
            "watchdog": 0.0,
            "enable_timeout": 0.5,
        },
        grip_object=held,
        commands=moves,
        efforts=limits,
        max_efforts=[0.2],
        fault="overcurrent",
        wire_faults=frozenset({"drop", "corrupt", "duplicate", "delay"}),
        cycles=cycles(100),
    )


@few_faults
class TestProfilePosition(DriverContract):
    case = case("profile_position")
