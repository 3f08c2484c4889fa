"""HERI II's boards pass the suite of all drivers."""

from __future__ import annotations

from typing import Any

from rtee.testing import DeviceCase, DriverContract, actuator, cycles

NAMES = ("motor_finger1", "motor_finger2", "motor_finger3", "motor_thumb")


def powered(emulator: Any) -> int:
    return sum(board.power for board in emulator.boards)


def limits(emulator: Any) -> list[float]:
    ampere = emulator.properties.torque_per_ampere
    return [motor.max_effort * ampere for board in emulator.boards for motor in board.motors]


class TestHeriII(DriverContract):
    case = DeviceCase(
        driver="heri_ethercat",
        actuators=tuple(actuator(name, 0.0, 2.5, effort=3.3) for name in NAMES),
        options={"emulator": {"speed": 20.0}, "product": 0x13, "watchdog": 0.0},
        commands=powered,
        efforts=limits,
        max_efforts=[1.0, 1.0, 0.5, 0.5],
        fault="hardware",
        wire_faults=frozenset({"drop", "corrupt", "delay"}),
        cycles=cycles(100),
    )
