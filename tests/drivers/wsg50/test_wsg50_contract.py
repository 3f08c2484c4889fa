"""The WSG 50 passes the suite of all drivers, and what is special about it."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.axis import VirtualObject
from rtee.drivers.wsg50.codec import Command, Grasping, State, setting
from rtee.drivers.wsg50.driver import Wsg50Driver
from rtee.errors import CommandRejected, ConfigError, DeviceFault, HandshakeError
from rtee.testing import DeviceCase, DriverContract, Session, actuator, cycles
from rtee.types import JointKind, Reference
from tests.drivers.objects import close_wsg50
from tests.drivers.use import cycled

FINGER = actuator(
    "left_finger_joint", 0.0, 0.055, kind=JointKind.PRISMATIC, velocity=0.2, effort=160.0
)


CASE = DeviceCase(
    driver="wsg50",
    actuators=(FINGER,),
    options={
        "port": "socket://192.0.2.1:1000",
        "home": "on_connect",
        "settle": 0.02,
        "rate": 100.0,
        "emulator": {"haste": 8.0},
    },
    grip_object=close_wsg50,
    commands=lambda emulator: emulator.moves,
    # Both fingers move: a newton at the fingertips is two at one finger's joint.
    efforts=lambda emulator: [2.0 * emulator.begun],
    max_efforts=[50.0],
    fault="temperature",
    tolerance=0.0005,
    cycles=cycles(100),
)


class TestOnTheNetwork(DriverContract):
    case = CASE


pytestmark = pytest.mark.anyio


def heard(session: Session) -> list[int]:
    return [frame.command for frame in session.emulator.requests]


async def test_what_blocks_a_motion_is_grasped_with_the_force_asked_for() -> None:
    async with Session(CASE) as session:
        await session.start()
        await session.reach([0.01])
        session.emulator.axis.obstacle = VirtualObject(50.0, 500.0, closing=-1.0)
        state = await cycled(session, 0.055, max_effort=[60.0])
        assert state.grasped == (True,)
        assert float(state.position[0]) == pytest.approx(0.030, abs=0.0005)
        assert float(state.effort[0]) == pytest.approx(60.0)
        assert abs(session.emulator.axis.effort) == pytest.approx(30.0)
        order = [c for c in heard(session) if c in (Command.MOVE, Command.GRASP)]
        assert order[-2:] == [Command.MOVE, Command.GRASP]
        # Another force is taken, too.
        state = await cycled(session, 0.055, max_effort=[100.0])
        assert state.grasped == (True,)
        assert abs(session.emulator.axis.effort) == pytest.approx(50.0)


async def test_what_is_held_is_released_before_it_opens() -> None:
    async with Session(CASE) as session:
        await session.before(close_wsg50)
        state = await session.start()
        assert state.grasped == (True,)
        assert session.near(await session.reach([0.005]), [0.005])
        assert Command.RELEASE in heard(session)
        assert (await session.sense()).grasped == (False,)


async def test_closing_on_nothing_holds_nothing() -> None:
    async with Session(CASE) as session:
        await session.start()
        state = await session.reach([0.055])
        assert session.near(state, [0.055])
        assert (await cycled(session, 0.055, 20)).grasped == (False,)
        assert Command.GRASP not in heard(session)


async def test_it_moves_at_the_speed_of_the_reference() -> None:
    case = replace(CASE, options={**CASE.options, "emulator": {"haste": 1.0}, "home": "on_demand"})
    async with Session(case) as session:
        await session.start()
        await session.reach([0.01])
        for _ in range(20):
            await session.cycle(Reference.at([0.05], max_velocity=[0.020]))
            await asyncio.sleep(0.005)
        state = await session.sense()
        assert float(state.velocity[0]) == pytest.approx(0.020, rel=0.05)
        # 20 mm/s of one finger are 40 mm/s of the width.
        assert session.emulator.axis.max_velocity == pytest.approx(40.0)


async def test_a_fast_stop_is_named_and_cleared_by_recover() -> None:
    async with Session(CASE) as session:
        await session.start()
        await session.reach([0.01])
        session.emulator.inject("fast_stop")
        session.emulator.clear()
        # Its cause is gone, and yet it is latched.
        with pytest.raises(DeviceFault, match="fast stop") as told:
            await session.sense()
        assert told.value.code == 12
        with pytest.raises(DeviceFault, match="fast stop"):
            await session.driver.activate()
        await session.driver.recover()
        assert Command.ACKNOWLEDGE in heard(session)
        await session.driver.activate()
        assert session.near(await session.reach([0.02]), [0.02])


@pytest.mark.parametrize(
    ("fault", "code", "name"),
    [
        ("temperature", 14, "over temperature"),
        ("power", 15, "supply out of range"),
        ("current", 16, "motor current too high"),
        ("finger", 17, "finger fault"),
    ],
)
async def test_every_error_of_the_state_has_a_name(fault: str, code: int, name: str) -> None:
    async with Session(CASE) as session:
        await session.start()
        session.emulator.inject(fault)
        with pytest.raises(DeviceFault, match=name) as told:
            await session.sense()
        assert (told.value.code, bool(told.value.hint)) == (code, True)


async def test_it_is_homed_only_when_allowed() -> None:
    options = {**CASE.options, "home": "on_demand", "emulator": {"referenced": False, "haste": 9.0}}
    async with Session(replace(CASE, options=options)) as session:
        await session.connect()
        assert await session.driver.examine() == "not homed"
        with pytest.raises(DeviceFault, match="not homed") as told:
            await session.driver.activate()
        assert "rtee recover" in told.value.hint
        assert session.emulator.homings == 0
        await session.driver.recover()
        assert session.emulator.homings == 0
        await session.driver.activate()
        assert session.emulator.homings == 1


async def test_homing_that_cannot_end_is_a_fault() -> None:
    async with Session(replace(CASE, options={**CASE.options, "home_timeout": 0.2})) as session:
        await session.before(lambda emulator: emulator.inject("stuck"))
        await session.connect()
        with pytest.raises(DeviceFault, match="homing did not finish in time"):
            await session.driver.activate()


async def test_a_connection_is_ended_with_a_word() -> None:
    """Some grippers take one that ends without it for an error, and stop for good."""
    options = {**CASE.options, "emulator": {"haste": 8.0, "error_on_disconnect": True}}
    async with Session(replace(CASE, options=options)) as session:
        await session.start()
        await session.driver.close()
        assert heard(session)[-1] == Command.DISCONNECT
        state = await session.start()
        assert not session.emulator.state() & State.FAST_STOP
        assert state.fresh


async def test_a_width_beyond_the_soft_limits_is_rejected_by_name() -> None:
    async with Session(CASE) as session:
        await session.start()
        await session.reach([0.010])
        session.emulator.feed(setting(Command.SET_SOFT_LIMITS, 30.0, 105.0).to_bytes(), 0.0)
        with pytest.raises(CommandRejected, match="refuses command 0x21: range"):
            await cycled(session, 0.050)
        assert session.near(await session.reach([0.030]), [0.030])


async def test_a_refusal_is_named() -> None:
    async with Session(CASE) as session:
        await session.before(lambda emulator: emulator.inject("wrong_device"))
        with pytest.raises(HandshakeError, match="refuses command 0x50: unknown command"):
            await session.driver.configure()


async def test_it_tells_what_it_is() -> None:
    async with Session(CASE) as session:
        await session.connect()
        capabilities = session.driver.capabilities
        assert capabilities.identity["firmware"] == "4.0.0"
        assert capabilities.identity["serial"] == "1234"
        assert capabilities.identity["stroke"] == "110 mm"
        assert capabilities.grip["left_finger_joint"].range_at(0.0) == (5.0, 80.0)
        assert session.emulator._grasping is Grasping.IDLE


def test_options_are_checked() -> None:
    for options, message in [
        ({"prot": "x"}, "did you mean 'port'"),
        ({"home": "never"}, "option 'home'"),
        ({"rate": 0.0}, "option 'rate'"),
    ]:
        with pytest.raises(ConfigError, match=message):
            Wsg50Driver(replace(CASE, options=options).spec(), BusPool())
    two = (FINGER, replace(FINGER, name="other"))
    with pytest.raises(ConfigError, match="a WSG 50 has one actuator, not 2"):
        Wsg50Driver(replace(CASE, actuators=two).spec(), BusPool())


async def test_a_stop_right_behind_a_release_is_sent() -> None:
    case = replace(CASE, options={**CASE.options, "emulator": {"haste": 1.0}})
    async with Session(case) as session:
        await session.before(close_wsg50)
        assert (await session.start()).grasped == (True,)
        begun = session.emulator.moves
        while session.emulator.moves == begun:
            await session.sense()
            await session.driver.move(Reference.at([0.0]))
            await asyncio.sleep(0.005)
        await session.driver.stop()
        assert Command.STOP in heard(session)
        stopped = session.emulator.axis.position
        await asyncio.sleep(0.3)
        assert session.emulator.axis.position == pytest.approx(stopped, abs=3.0)


async def test_a_part_that_slips_out_of_a_grasp_is_lost() -> None:
    part = VirtualObject(40.0, 1e3, closing=-1.0)
    async with Session(CASE) as session:
        await session.start()
        await session.reach([0.01])
        session.wire.call(lambda: setattr(session.emulator.axis, "obstacle", part))
        held = await cycled(session, 0.045, max_effort=[40.0])
        assert (held.grasped, held.warnings) == ((True,), ())
        session.wire.call(lambda: setattr(session.emulator.axis, "obstacle", None))
        lost = ()
        for _ in range(100):
            state = await session.sense()
            lost = lost or state.warnings
            await asyncio.sleep(0.005)
        assert (state.grasped, lost) == ((False,), ("part lost",))
