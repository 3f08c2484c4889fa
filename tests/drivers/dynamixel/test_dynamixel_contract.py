"""A line of Dynamixels passes the suite of all drivers."""

from __future__ import annotations

from typing import Any

from rtee.drivers.dynamixel import table
from rtee.testing import DeviceCase, DriverContract, actuator, cycles
from tests.drivers.objects import obstruct
from tests.drivers.suites import few_faults

NAMES = ("j0", "j1", "j2")


def held(emulator: Any) -> None:
    for number, servo in emulator.servos.items():
        servo.write(table.OPERATING_MODE.address, b"\x05")
        servo.write(table.TORQUE.address, b"\x01")
        obstruct(emulator.servos[number].axis, 2060.0, 50.0)
        servo.write(table.GOAL_POSITION.address, (2200).to_bytes(4, "little"))
        servo.axis.advance(1.0)
        assert servo.axis.effort > 100.0


def moves(emulator: Any) -> int:
    targets = [servo.axis.target - servo.properties.start for servo in emulator.servos.values()]
    return round(sum(abs(target) for target in targets))


def limits(emulator: Any) -> list[float]:
    unit = 0.52 / 1.47 / 1000.0
    return [servo.get(table.GOAL_CURRENT) * unit for servo in emulator.servos.values()]


@few_faults
class TestDynamixel(DriverContract):
    case = DeviceCase(
        driver="dynamixel",
        actuators=tuple(actuator(name, -1.0, 1.5, effort=0.5, rest=0.0) for name in NAMES),
        options={
            "servos": {name: {"id": i} for i, name in enumerate(NAMES)},
            "emulator": {"servo": {"reboot_time": 0.05}},
            "health_every": 15,
            "retries": 9,
            "deadline": 0.1,
        },
        grip_object=held,
        commands=moves,
        efforts=limits,
        max_efforts=[0.2, 0.3, 0.4],
        fault="overload",
        cycles=cycles(100),
    )
