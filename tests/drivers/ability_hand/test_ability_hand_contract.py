"""The Ability Hand passes the suite of all drivers: by positions, velocities and currents."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import pytest

from rtee.drivers.ability_hand.codec import Header, angle_counts
from rtee.drivers.ability_hand.emulator import AbilityHandEmulator
from rtee.drivers.axis import VirtualObject
from rtee.testing import DeviceCase, DriverContract, actuator, cycles
from tests.drivers.suites import same_wire

ACTUATORS = (
    actuator("index_q1", 0.0, 1.74, effort=6.0),
    actuator("middle_q1", 0.0, 1.74, effort=6.0),
    actuator("ring_q1", 0.0, 1.74, effort=6.0),
    actuator("pinky_q1", 0.0, 1.74, effort=6.0),
    actuator("thumb_flexion", 0.0, 1.74, effort=6.0),
    actuator("thumb_rotation", 0.0, 1.74, effort=1.2),
)


def held(emulator: AbilityHandEmulator) -> None:
    """Have the hand press on something halfway, as another program may have left it."""
    for axis in emulator.axes[:5]:
        axis.obstacle = VirtualObject(0.8, 50.0)
    goal = angle_counts(1.2)
    for motor in range(5):
        emulator._aim(motor, Header.POSITION, goal)
    emulator._clock = None  # a time of its own, whatever the computer's clock shows
    emulator.advance(1000.0)
    emulator.advance(1002.0)
    emulator._clock = None
    assert emulator.axes[0].effort > 1.0


def heard(emulator: Any) -> int:
    count: int = emulator.moves
    return count


CASE = DeviceCase(
    driver="ability_hand",
    actuators=ACTUATORS,
    options={"emulator": {"haste": 2.0}},
    grip_object=held,
    commands=heard,
    homes=False,
    cycles=cycles(100),
)


class TestPositions(DriverContract):
    case: ClassVar[DeviceCase] = CASE


@pytest.mark.heavy
class TestVelocities(DriverContract):
    case: ClassVar[DeviceCase] = replace(CASE, options={**CASE.options, "mode": "velocity"})


@same_wire
class TestCurrents(DriverContract):
    case: ClassVar[DeviceCase] = replace(
        CASE, options={**CASE.options, "mode": "current", "baudrate": 921_600, "reply": 3}
    )
