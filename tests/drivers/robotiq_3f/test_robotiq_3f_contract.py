"""The 3-Finger passes the suite of all drivers: fingers and scissor, each finger, and TCP."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.robotiq_3f.codec import SCALES, Command, Mode, Request
from rtee.drivers.robotiq_3f.driver import Robotiq3FDriver
from rtee.errors import ConfigError, DeviceFault
from rtee.testing import DeviceCase, DriverContract, Session, actuator, cycles
from tests.drivers.objects import close_robotiq

FINGERS = actuator("finger_1_joint_1", 0.0495, 1.2218, effort=8.0)
SCISSOR = actuator("palm_finger_1_joint", -0.1784, 0.192, effort=8.0, rest=0.0)


def efforts(emulator: Any) -> list[float]:
    begun = emulator.begun
    axes = (("a", begun.axes[0]), ("scissor", begun.axes[3]))
    return [SCALES[name].effort.to_si(axis.force) for name, axis in axes]


def closed_on_something(emulator: Any) -> None:
    axes = (Request(255, 255, 128), Request(), Request(), Request())
    close_robotiq(emulator, Command(activate=True, go=True, axes=axes), 150, 10.0)


CASE = DeviceCase(
    driver="robotiq_3f",
    actuators=(FINGERS, SCISSOR),
    options={
        "port": "/dev/ttyUSB0",
        "home": "on_connect",
        "emulator": {"activation_time": 0.2, "haste": 8.0},
    },
    grip_object=closed_on_something,
    commands=lambda emulator: emulator.moves,
    efforts=efforts,
    max_efforts=[5.0, 12.0],
    fault="mode_change_failed",
    cycles=cycles(100),
)


class TestFingersAndScissor(DriverContract):
    case = CASE


SEPARATE = (
    actuator("finger_1_joint_1", 0.0495, 1.2218),
    actuator("finger_2_joint_1", 0.0495, 1.2218),
    actuator("finger_middle_joint_1", 0.0495, 1.2218),
    SCISSOR,
)

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize("port", ["tcp://192.0.2.1", "/dev/ttyUSB0"])
async def test_each_finger_goes_its_own_way(port: str) -> None:
    case = replace(CASE, actuators=SEPARATE, options={**CASE.options, "port": port})
    async with Session(case) as session:
        await session.start()
        goal = [0.3, 0.6, 0.9, 0.1]
        state = await session.reach(goal)
        assert session.near(state, goal)
        positions = [axis.position for axis in session.emulator.axes]
        assert positions[:3] == pytest.approx([60, 120, 180], abs=1)


@pytest.mark.parametrize("mode", ["pinch", "wide", "scissor"])
async def test_a_mode_is_taken_at_activation_where_that_is_allowed(mode: str) -> None:
    options = {**CASE.options, "mode": mode}
    case = replace(CASE, actuators=(FINGERS,), options=options)
    async with Session(case) as session:
        await session.start()
        assert session.emulator.status().mode is Mode[mode.upper()]
        state = await session.reach([0.8])
        assert session.near(state, [0.8])


async def test_nothing_moves_before_it_is_asked_for() -> None:
    emulator = {"activated": False, "haste": 9.0}
    options = {**CASE.options, "home": "on_demand", "mode": "wide", "emulator": emulator}
    async with Session(replace(CASE, actuators=(FINGERS,), options=options)) as session:
        await session.connect()
        with pytest.raises(DeviceFault, match="not activated") as caught:
            await session.driver.activate()
        assert "rtee recover" in caught.value.hint
        assert session.emulator.moves == 0
        await session.driver.recover()
        await session.driver.activate()
        assert session.emulator.status().ready


async def test_another_mode_is_not_taken_unasked() -> None:
    options = {**CASE.options, "home": "on_demand", "mode": "pinch"}
    async with Session(replace(CASE, actuators=(FINGERS,), options=options)) as session:
        await session.before(closed_on_something)
        await session.connect()
        with pytest.raises(DeviceFault, match="in mode 'basic', not 'pinch'"):
            await session.driver.activate()


async def test_a_scissor_that_does_not_arrive_is_told_from_an_activation() -> None:
    options = {**CASE.options, "mode": "wide", "activation_timeout": 0.05}
    options["emulator"] = {"activated": True}
    async with Session(replace(CASE, actuators=(FINGERS,), options=options)) as session:
        with pytest.raises(DeviceFault, match="the change of mode did not finish in time") as told:
            await session.start()
        assert told.value.code == 0x0E


def test_roles_are_checked() -> None:
    options = {**CASE.options, "roles": {"finger_1_joint_1": "scissor"}}
    with pytest.raises(ConfigError, match="two actuators drive the same motor"):
        Robotiq3FDriver(replace(CASE, options=options).spec(), BusPool())
    options = {**CASE.options, "roles": {"thumb": "a"}}
    wrong = "option 'roles' names 'thumb', which is not one of its actuators"
    with pytest.raises(ConfigError, match=wrong):
        Robotiq3FDriver(replace(CASE, options=options).spec(), BusPool())
