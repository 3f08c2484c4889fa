"""The RH56 passes the suite of all drivers: by its own frames, and over Modbus RTU and TCP."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

from rtee.drivers.inspire_rh56.codec import Register, table
from rtee.drivers.inspire_rh56.options import FORCES
from rtee.testing import DeviceCase, DriverContract, actuator, cycles
from tests.drivers.objects import place_in_rh56
from tests.drivers.suites import same_wire

ACTUATORS = (
    actuator("thumb_proximal_yaw_joint", 0.0, 1.308, effort=0.6),
    actuator("thumb_proximal_pitch_joint", 0.0, 0.6, effort=1.9),
    actuator("index_proximal_joint", 0.0, 1.47, effort=0.7),
    actuator("middle_proximal_joint", 0.0, 1.47, effort=0.6),
    actuator("ring_proximal_joint", 0.0, 1.47, effort=0.6),
    actuator("pinky_proximal_joint", 0.0, 1.47, effort=0.5),
)
MOTORS = ("thumb_rotate", "thumb_bend", "index", "middle", "ring", "little")
ORDER = ("little", "ring", "middle", "index", "thumb_bend", "thumb_rotate")


def held(emulator: Any) -> None:
    """Have the hand press on something halfway, as another program may have left it."""
    place_in_rh56(emulator)
    emulator.memory.write(Register.FORCE_SET, table([400] * 6))
    emulator.memory.write(Register.ANGLE_SET, table([200] * 5 + [1000]))
    emulator.memory.advance(2.0)
    assert abs(emulator.axes[3].effort) == 400.0


def efforts(emulator: Any) -> list[float]:
    begun = dict(zip(ORDER, emulator.memory.begun, strict=True))
    return [FORCES[name].newtons(begun[name]) * FORCES[name].arm for name in MOTORS]


CASE = DeviceCase(
    driver="inspire_rh56",
    actuators=ACTUATORS,
    options={"emulator": {"haste": 4.0}},
    grip_object=held,
    commands=lambda emulator: emulator.memory.moves,
    efforts=efforts,
    max_efforts=[0.3, 1.0, 0.3, 0.4, 0.2, 0.3],
    fault="over_current",
    homes=False,
    cycles=cycles(100),
)


class TestFrames(DriverContract):
    case: ClassVar[DeviceCase] = CASE


class TestModbusRtu(DriverContract):
    case: ClassVar[DeviceCase] = replace(CASE, options={**CASE.options, "protocol": "modbus"})


@same_wire
class TestModbusTcp(DriverContract):
    case: ClassVar[DeviceCase] = replace(
        CASE,
        options={
            "port": "tcp://192.0.2.1:6000",
            "emulator": {"haste": 4.0, "behind": True},
        },
        checksums=False,
    )
