"""The SoftHand passes the suite of all drivers."""

from __future__ import annotations

from typing import Any

from rtee.drivers.qb_softhand.codec import Command
from rtee.testing import DeviceCase, DriverContract, actuator, cycles
from tests.drivers.objects import obstruct


def held(emulator: Any) -> None:
    obstruct(emulator.axes[0], 0.3 * emulator.options.limit, 1.0)
    emulator._activate(3)
    emulator.axes[0].target = 12_000.0
    emulator.axes[0].advance(1.0)
    assert emulator.axes[0].effort > 500.0


def told(emulator: Any) -> int:
    return emulator.frames.get(Command.ACTIVATE, 0) + emulator.frames.get(Command.SET_INPUTS, 0)


class TestSoftHand(DriverContract):
    case = DeviceCase(
        driver="qb_softhand",
        actuators=(actuator("qbhand_synergy_joint", 0.0, 1.0, effort=3.0),),
        options={"emulator": {"speed": 200_000.0}},
        grip_object=held,
        commands=told,
        fault="low_supply",
        homes=False,
        cycles=cycles(100),
    )
