"""The RG passes the suite of all drivers, and what is special about it."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.axis import VirtualObject
from rtee.drivers.onrobot_rg.codec import MODELS, LinkageScale
from rtee.drivers.onrobot_rg.driver import OnRobotRGDriver
from rtee.errors import ConfigError, DeviceFault, HandshakeError, NotConnected
from rtee.testing import DeviceCase, DriverContract, Session, actuator, cycles
from rtee.types import Reference
from tests.drivers.objects import close_onrobot_rg
from tests.drivers.use import cycled

RG2 = MODELS["rg2"]
FINGER = actuator("finger_joint", 0.0789, 1.2873, effort=3.33, rest=1.2873)
SCALE = LinkageScale(RG2, FINGER.lower, FINGER.upper)

TCP = DeviceCase(
    driver="onrobot_rg",
    actuators=(FINGER,),
    options={"host": "192.0.2.1", "emulator": {"haste": 8.0}, "settle": 0.02},
    grip_object=close_onrobot_rg,
    commands=lambda emulator: emulator.moves,
    efforts=lambda emulator: [SCALE.effort.to_si(emulator.begun)],
    max_efforts=[1.5],
    fault="safety_error",
    homes=False,
    checksums=False,
    cycles=cycles(100),
)
LINE = replace(
    TCP,
    options={**TCP.options, "port": "/dev/ttyUSB0", "baudrate": 115200},
    checksums=True,
)


class TestThroughTheComputeBox(DriverContract):
    case = TCP


class TestOnALine(DriverContract):
    case = LINE


pytestmark = pytest.mark.anyio


@pytest.mark.parametrize("case", [TCP, LINE])
async def test_a_tool_that_has_failed_is_not_taken_for_another(case: DeviceCase) -> None:
    async with Session(case) as session:
        await session.before(lambda emulator: emulator.inject("failing"))
        sentence = r"it answers: Modbus exception 4.*supply off and on"
        with pytest.raises(NotConnected, match=sentence):
            await session.driver.configure()
        session.wire.call(session.emulator.clear)
        await session.start()


async def test_it_grips_with_the_force_that_the_effort_means() -> None:
    async with Session(TCP) as session:
        await session.start()
        session.emulator.axis.obstacle = VirtualObject(RG2.angle(0.05), 1e5, closing=-1.0)
        state = await cycled(session, FINGER.lower, max_effort=[SCALE.effort.to_si(250)])
        assert state.grasped == (True,)
        assert abs(session.emulator.axis.effort) == pytest.approx(25.0, rel=1e-3)
        moves = session.emulator.moves
        # The force is regulated by the gripper: nothing more is sent while nothing else is asked.
        await cycled(session, FINGER.lower, max_effort=[SCALE.effort.to_si(250)])
        assert session.emulator.moves == moves
        await cycled(session, FINGER.lower, max_effort=[SCALE.effort.to_si(100)])
        assert session.emulator.begun == 100
        assert session.emulator.moves == moves + 1


async def test_fingertips_that_meet_hold_nothing() -> None:
    async with Session(TCP) as session:
        await session.start()
        state = await cycled(session, FINGER.lower)
        assert session.emulator.status().grip_detected
        assert state.grasped == (False,)


async def test_a_moving_reference_is_followed_in_steps() -> None:
    async with Session(TCP) as session:
        await session.start()
        for n in range(60):
            await session.cycle(Reference.at([FINGER.upper - 0.015 * n]))
            await asyncio.sleep(0.005)
        assert 2 <= session.emulator.moves <= 25
        goal = FINGER.upper - 0.9
        assert session.near(await session.reach([goal]), [goal])


async def test_a_motion_that_leads_past_the_reference_is_stopped() -> None:
    case = replace(TCP, options={**TCP.options, "emulator": {"haste": 0.5}})
    async with Session(case) as session:
        await session.start()
        while session.emulator.axis.position > 0.9:
            await cycled(session, FINGER.lower, 2)
        assert session.emulator.status().busy
        assert session.near(await session.reach([1.1]), [1.1])
        assert session.emulator.stopped == 1


async def test_a_motion_with_more_force_than_is_asked_for_now_is_stopped() -> None:
    case = replace(TCP, options={**TCP.options, "emulator": {"haste": 0.5}})
    async with Session(case) as session:
        await session.start()
        while session.emulator.axis.position > 1.1:
            await cycled(session, FINGER.lower, 2, max_effort=[SCALE.effort.to_si(300)])
        assert session.emulator.begun == 300
        await cycled(session, FINGER.lower, 10, max_effort=[SCALE.effort.to_si(50)])
        assert session.emulator.status().busy
        assert session.emulator.begun == 50


async def test_a_safety_switch_is_named_and_recovered_from() -> None:
    async with Session(TCP) as session:
        await session.start()
        await cycled(session, 0.9)
        session.emulator.inject("safety_2")
        state = await session.sense()
        assert state.warnings == ("safety switch 2 is pushed",)
        with pytest.raises(DeviceFault, match="safety switch 2 was pushed during a motion") as told:
            await cycled(session, 0.4)
        assert told.value.code == 5
        assert "restart the tool" in told.value.hint
        with pytest.raises(DeviceFault):
            await session.driver.recover()
        session.emulator.clear()
        await session.driver.recover()
        await session.driver.activate()
        assert session.near(await session.reach([0.4]), [0.4])


async def test_recovery_is_refused_while_a_switch_is_pushed() -> None:
    async with Session(TCP) as session:
        await session.start()
        session.emulator.inject("safety_1")
        with pytest.raises(DeviceFault, match="safety switch 1 is pushed") as told:
            await session.driver.recover()
        assert told.value.hint == "release it"


async def test_the_fingertips_offset_is_set_where_it_differs() -> None:
    for wanted, tenths in ((None, 49), (0.0049, 49), (0.007, 70)):
        options = {**TCP.options, "fingertip_offset": wanted}
        async with Session(replace(TCP, options=options)) as session:
            await session.start()
            writes = [pdu for pdu in session.emulator.requests if pdu[:3] == b"\x10\x04\x07"]
            assert len(writes) == (tenths != 49)
            assert session.emulator.registers()[0x0102] == tenths
            # Neither it nor the width between the fingertips changes where the links are.
            assert session.near(await session.reach([0.6]), [0.6])


@pytest.mark.parametrize(
    ("asked", "there", "hint"), [("rg2", "rg6", "model: rg6"), ("rg6", "rg2", "model: rg2")]
)
async def test_another_model_is_named(asked: str, there: str, hint: str) -> None:
    options = {**TCP.options, "model": asked, "emulator": {"model": there}}
    async with Session(replace(TCP, options=options)) as session:
        with pytest.raises(HandshakeError, match=f"OnRobot {there.upper()}") as told:
            await session.connect()
        assert hint in told.value.hint


async def test_another_tool_and_none_are_named() -> None:
    async with Session(TCP) as session:
        await session.before(lambda emulator: emulator.inject("wrong_device"))
        with pytest.raises(HandshakeError, match="an OnRobot 2FG7"):
            await session.driver.configure()
        session.emulator.inject("no_tool")
        with pytest.raises(NotConnected, match="the Compute Box finds no tool"):
            await session.driver.configure()


async def test_it_tells_what_it_is() -> None:
    async with Session(TCP) as session:
        await session.connect()
        identity = session.driver.capabilities.identity
        assert identity["model"] == "OnRobot RG2"
        assert identity["fingertip offset"] == "4.9 mm"
        assert identity["product code"] == "0x20"
        assert identity["serial"] == "RG-EMULATED"
        assert session.driver.capabilities.grip["finger_joint"].range_at(0.5) == (0.0, 40.0)


def test_options_are_checked() -> None:
    for options, message in [
        ({"model": "rg4"}, "option 'model'"),
        ({"unit": 300}, "option 'unit'"),
        ({"fingertip_offset": -0.001}, "option 'fingertip_offset'"),
        ({"stepp": 0.1}, "did you mean 'step'"),
    ]:
        with pytest.raises(ConfigError, match=message):
            OnRobotRGDriver(replace(TCP, options=options).spec(), BusPool())
    two = (FINGER, replace(FINGER, name="other"))
    with pytest.raises(ConfigError, match="an OnRobot RG has one actuator, not 2"):
        OnRobotRGDriver(replace(TCP, actuators=two).spec(), BusPool())
