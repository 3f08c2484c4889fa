"""The Allegro Hand passes the suite of all drivers."""

from __future__ import annotations

from typing import Any

from rtee.drivers.allegro.codec import Command
from rtee.testing import DeviceCase, DriverContract, actuator, cycles
from tests.drivers.suites import few_faults


def torques(emulator: Any) -> int:
    return int(emulator.frames.get(Command.SYSTEM_ON, 0))


@few_faults
class TestAllegro(DriverContract):
    case = DeviceCase(
        driver="allegro",
        actuators=tuple(actuator(f"joint_{i}", -0.4, 1.6, rest=0.0) for i in range(16)),
        options={"kp": 2.0, "kd": 0.08, "info_every": 5},
        commands=torques,
        fault="over_temperature",
        tolerance=0.05,
        stopping=0.5,  # its controller runs here, and swings out
        wire_faults=frozenset({"drop", "corrupt", "duplicate", "delay"}),
        answers=False,
        cycles=cycles(100),
    )
