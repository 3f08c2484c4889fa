"""The 3FG passes the suite of all drivers, and what is special about it."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest

from rtee.buses.faults import Faults
from rtee.drivers.axis import VirtualObject
from rtee.drivers.onrobot_3fg.codec import scale_of
from rtee.errors import HandshakeError, NotConnected
from rtee.testing import DeviceCase, DriverContract, Session, actuator, cycles
from rtee.types import Reference
from tests.drivers.objects import close_onrobot_3fg

SCALE = scale_of(0.0, 2.9)


def with_an_object(emulator: Any) -> list[float]:
    return [SCALE.effort.to_si(emulator.begun)]


TCP = DeviceCase(
    driver="onrobot_3fg",
    actuators=(actuator("robot_onrobot_3fg15_finger_joint1", 0.0, 2.9, effort=10.0),),
    options={"host": "192.0.2.1", "emulator": {"haste": 8.0}, "settle": 0.02},
    grip_object=close_onrobot_3fg,
    commands=lambda emulator: emulator.moves,
    efforts=with_an_object,
    max_efforts=[4.0],
    fault="calibration_lost",
    homes=False,
    checksums=False,
    cycles=cycles(100),
)


class TestThroughTheComputeBox(DriverContract):
    case = TCP


pytestmark = pytest.mark.anyio


async def gripped(session: Session, goal: float, **limits: Any) -> Any:
    for _ in range(300):
        busy = session.emulator.status().busy
        await session.cycle(Reference.at([goal], **limits))
        state = await session.sense()
        if state.grasped == (True,) and not busy:
            return state
        await asyncio.sleep(0.005)
    pytest.fail("it never gripped")


@pytest.mark.parametrize("grip", ["external", "internal"])
async def test_targets_between_the_tips_are_reached_too(grip: str) -> None:
    options = {**TCP.options, "target": "tips", "grip": grip}
    options["emulator"] = {**TCP.options["emulator"], "target": "tips"}
    async with Session(replace(TCP, options=options)) as session:
        await session.start()
        assert session.near(await session.reach([1.2]), [1.2])
        assert session.emulator.status().raw_diameter == pytest.approx(
            SCALE.position.to_count(1.2), abs=10
        )


async def test_a_reference_that_rests_is_gripped_at_with_its_force() -> None:
    async with Session(TCP) as session:
        await session.start()
        session.emulator.axis.obstacle = VirtualObject(0.090, 1e5, closing=-1.0)
        state = await gripped(session, 2.5, max_effort=[3.0])
        assert float(state.effort[0]) == pytest.approx(3.0, rel=0.1)
        assert float(state.position[0]) == pytest.approx(SCALE.position.to_si(900), abs=0.05)
        moves = session.emulator.moves
        for _ in range(20):
            await session.cycle(Reference.at([2.5], max_effort=[3.0]))
        assert session.emulator.moves == moves
        weaker = await gripped(session, 2.5, max_effort=[3.0])
        assert weaker.grasped == (True,)
        for _ in range(100):
            state = await session.cycle(Reference.at([2.5], max_effort=[1.0]))
            await asyncio.sleep(0.005)
        assert float(state.effort[0]) == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize("ignores", ["grip", "all"])
async def test_a_moving_reference_is_followed_whatever_the_gripper_ignores(ignores: str) -> None:
    options = {**TCP.options, "emulator": {"haste": 4.0, "busy_ignores": ignores}}
    async with Session(replace(TCP, options=options)) as session:
        await session.start()
        for n in range(60):
            await session.cycle(Reference.at([0.02 * n]))
        state = await session.reach([1.2])
        assert session.near(state, [1.2])


async def test_an_internal_grip_opens_into_its_object() -> None:
    options = {**TCP.options, "grip": "internal"}
    async with Session(replace(TCP, options=options)) as session:
        await session.start()
        await session.reach([2.0])
        session.emulator.axis.obstacle = VirtualObject(0.100, 1e5, closing=1.0)
        state = await gripped(session, 0.2)
        assert float(state.position[0]) == pytest.approx(SCALE.position.to_si(1000), abs=0.08)


@pytest.mark.parametrize("exchange", ["auto", "separate"])
async def test_a_direct_line_works_too(exchange: str) -> None:
    options = {**TCP.options, "port": "/dev/ttyUSB0", "exchange": exchange}
    async with Session(replace(TCP, options=options)) as session:
        await session.start()
        session.wire.faults = Faults(
            drop=0.05, corrupt=0.05, delay=0.05, split=0.05, noise=0.05, delay_time=0.003
        )
        for _ in range(60):
            state = await session.cycle(Reference.at([1.5]))
            assert state is None or -0.1 <= float(state.position[0]) <= 3.0
        session.wire.faults = Faults()
        assert session.near(await session.reach([0.7]), [0.7])
        assert session.driver.capabilities.best_rate > 130.0


async def test_no_tool_behind_the_box_is_named() -> None:
    async with Session(TCP) as session:
        await session.before(lambda emulator: emulator.inject("no_tool"))
        with pytest.raises(NotConnected, match="the Compute Box finds no tool"):
            await session.driver.configure()


async def test_another_tool_is_named() -> None:
    async with Session(TCP) as session:
        await session.before(lambda emulator: emulator.inject("wrong_device"))
        with pytest.raises(HandshakeError, match="finger position 0"):
            await session.driver.configure()


async def test_it_tells_what_it_is() -> None:
    async with Session(TCP) as session:
        await session.connect()
        identity = session.driver.capabilities.identity
        assert identity["serial"] == "3FG15-EMULATED"
        assert identity["diameters"] == "20.0 to 150.0 mm"
        assert identity["finger position"] == "2"
