"""Lines of Feetech servos pass the suite of all drivers: every family, alone and in pairs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import pytest

from rtee.drivers.feetech import table
from rtee.drivers.feetech.table import FULL
from rtee.testing import DeviceCase, DriverContract, actuator, cycles
from tests.drivers.objects import obstruct
from tests.drivers.suites import few_faults, same_wire

NAMES = ("j0", "j1", "j2")
TORQUE = 2.0  # of the servos at their stall [N·m]
FINGERS = ("index", "middle")
PAIRED = tuple(
    one
    for finger in FINGERS
    for one in (
        actuator(f"{finger}_flexion", 0.0, 1.2, effort=0.4, velocity=4.0),
        actuator(f"{finger}_tilt", -0.3, 0.3, effort=0.2, velocity=2.0, rest=0.0),
    )
)
DIFFERENTIAL = {
    "flexion": [[-0.8, -0.16], [0.0, 0.53], [0.8, 1.02], [1.57, 1.29]],
    "tilt": [[-1.0, -0.57], [1.0, 0.57]],
    "tilt_share": [[-0.5, 0.87], [0.0, 1.0], [0.5, 0.84], [1.05, 0.48]],
    "pairs": {
        finger: {
            "servos": [f"{finger}_1", f"{finger}_2"],
            "actuators": [f"{finger}_flexion", f"{finger}_tilt"],
        }
        for finger in FINGERS
    },
}


def held(emulator: Any) -> None:
    """Have every servo push against something a little beyond where it stands."""
    for servo in emulator.ordered:
        counts = emulator.family.counts / 4096
        here = float(servo.axis.position)
        obstruct(servo.axis, here + 12.0 * counts, 50.0 / counts)
        goal = round(here + 150.0 * counts)
        servo.write(table.GOAL_POSITION.address, emulator.family.pack(table.GOAL_POSITION, goal))
        servo.write(table.TORQUE.address, b"\x01")
        servo.axis.advance(1.0)
        assert servo.axis.effort > 100.0


def moves(emulator: Any) -> int:
    """Return how far the goals are from where the servos started."""
    goals = [servo.axis.target - servo.properties.start for servo in emulator.ordered]
    return round(sum(abs(goal) for goal in goals))


def limits(emulator: Any) -> list[float]:
    register = table.TORQUE_LIMIT
    return [servo.get(register) / FULL * TORQUE for servo in emulator.ordered]


def currents(emulator: Any) -> list[float]:
    return [servo.get(table.GOAL_TIME) * table.CURRENT_UNIT * 0.5 for servo in emulator.ordered]


CASE = DeviceCase(
    driver="feetech",
    actuators=tuple(actuator(name, -1.0, 1.4, effort=2.0, rest=0.0) for name in NAMES),
    options={
        "family": "sts",
        "servos": {name: {"id": i + 1} for i, name in enumerate(NAMES)},
        "stall_torque": TORQUE,
        "emulator": {"servo": {"reboot_time": 0.05}},
        "check_every": 5,
        "retries": 9,
        "deadline": 0.1,
    },
    grip_object=held,
    commands=moves,
    efforts=limits,
    max_efforts=[0.5, 1.0, 1.6],
    fault="overload",
    homes=False,
    cycles=cycles(100),
)


@few_faults
class TestSts(DriverContract):
    case: ClassVar[DeviceCase] = CASE


@pytest.mark.heavy
class TestHls(DriverContract):
    case: ClassVar[DeviceCase] = replace(
        CASE,
        options={**CASE.options, "family": "hls", "torque_per_ampere": 0.5},
        efforts=currents,
        max_efforts=[0.3, 0.5, 0.7],
    )


@pytest.mark.heavy
class TestSmsOneByOne(DriverContract):
    case: ClassVar[DeviceCase] = replace(
        CASE, options={**CASE.options, "family": "sms", "read": "single", "baudrate": 115200}
    )


@same_wire
class TestScsInPairs(DriverContract):
    case: ClassVar[DeviceCase] = replace(
        CASE,
        actuators=PAIRED,
        options={
            "family": "scs",
            "servos": {
                f"{finger}_{k}": {"id": 2 * i + k}
                for i, finger in enumerate(FINGERS)
                for k in (1, 2)
            },
            "differential": DIFFERENTIAL,
            "emulator": {"echo": True, "servo": {"reboot_time": 0.05, "return_delay": 250}},
            "check_every": 5,
            "retries": 9,
            "deadline": 0.1,
        },
        efforts=None,
        max_efforts=None,
        fault="overheating",
    )
