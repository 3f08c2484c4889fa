"""The EGU and EGK pass the suite of all drivers, and what is special about them."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.axis import VirtualObject
from rtee.drivers.schunk_egu.codec import Control, Status
from rtee.drivers.schunk_egu.driver import SchunkEguDriver
from rtee.errors import ConfigError, DeviceFault, HandshakeError
from rtee.testing import DeviceCase, DriverContract, Session, actuator, cycles
from rtee.types import JointKind, Reference
from tests.drivers.objects import close_schunk_egu
from tests.drivers.use import cycled

FINGER = actuator(
    "left_finger_joint", 0.0, 0.040, kind=JointKind.PRISMATIC, velocity=0.1, effort=300.0
)
CASE = DeviceCase(
    driver="schunk_egu",
    actuators=(FINGER,),
    options={"settle": 0.02, "emulator": {"haste": 8.0, "watch": 5.0}},
    grip_object=close_schunk_egu,
    commands=lambda emulator: emulator.moves,
    # Two newtons at one finger's joint are one at the fingertips; the largest force is 150 N.
    efforts=lambda emulator: [2.0 * 1.5 * emulator.begun],
    max_efforts=[120.0],
    fault="motor_hot",
    homes=False,
    # The gripper closes on what may be there, so it goes from open to closed for its force.
    postures=([0.010], [0.030]),
    tolerance=0.0005,
    cycles=cycles(100),
)


class TestOnTheLine(DriverContract):
    case = CASE


pytestmark = pytest.mark.anyio


async def test_it_closes_by_grip_with_the_force_asked_for() -> None:
    async with Session(CASE) as session:
        await session.start()
        await session.reach([0.005])
        session.emulator.axis.obstacle = VirtualObject(40.0, 1e3, closing=-1.0)
        state = await cycled(session, 0.040, max_effort=[90.0])
        assert state.grasped == (True,)
        assert float(state.position[0]) == pytest.approx(0.020, abs=0.0005)
        # 30 % of 150 N.
        assert abs(session.emulator.axis.effort) == pytest.approx(45.0)
        moves = session.emulator.moves
        await cycled(session, 0.040, max_effort=[90.0])
        assert session.emulator.moves == moves
        await cycled(session, 0.040, max_effort=[180.0])
        assert abs(session.emulator.axis.effort) == pytest.approx(90.0)


async def test_a_grip_is_stopped_where_the_reference_is() -> None:
    case = replace(CASE, options={**CASE.options, "emulator": {"haste": 1.0, "watch": 5.0}})
    async with Session(case) as session:
        await session.start()
        # From open, 6 mm of a finger at the 40 mm/s of a grip.
        assert session.near(await session.reach([0.006]), [0.006])
        state = await cycled(session, 0.006, 40)
        assert Control.STOP in session.emulator.taken
        assert session.near(state, [0.006])
        assert not session.emulator.image().status & Status.NO_WORKPIECE


async def test_the_stop_of_a_grip_is_sent_before_it_is_too_far() -> None:
    """Not only in the cycle that finds it at the reference: that is a cycle's way too late."""
    emulator = {"haste": 1.0, "watch": 5.0, "grip_speed": 100.0}
    case = replace(CASE, options={"settle": 0.02, "emulator": emulator}, rate=25.0)
    early = False
    async with Session(case) as session:
        await session.start()
        # A busy computer may miss the moment: what always comes too late never comes early.
        for goal in (0.006, 0.012, 0.018, 0.024, 0.030) * 3:
            stopped = False
            while not stopped:
                begun = asyncio.get_running_loop().time()
                state = await session.cycle(Reference.at([goal]))
                taken = session.emulator.taken
                # One before the grip belongs to the last goal.
                gripped = taken.index(Control.GRIP) if Control.GRIP in taken else len(taken)
                stopped = Control.STOP in taken[gripped:]
                await asyncio.sleep(max(0.0, begun + 0.04 - asyncio.get_running_loop().time()))
            assert state is not None
            early = float(state.position[0]) < goal - 0.0002
            if early:
                break
            session.emulator.taken.clear()
            assert session.near(await session.reach([goal]), [goal])
            if goal == 0.030:  # back to open, so that the next goal is closed to
                assert session.near(await session.reach([0.0]), [0.0])
            session.emulator.taken.clear()
    assert early


async def test_a_grip_that_meets_an_object_before_its_reference_is_not_stopped() -> None:
    """The stop is due 30 ms after the fingers have met it, and readings tell of it in between."""
    emulator = {"haste": 1.0, "watch": 5.0, "grip_speed": 100.0}
    case = replace(CASE, options={"settle": 0.02, "emulator": emulator}, rate=25.0)
    told = []
    # A busy computer may read too late: what is always stopped never grips at once.
    for _ in range(5):
        async with Session(case, pool=BusPool(wire_time=True)) as session:
            await session.start()
            session.emulator.axis.obstacle = VirtualObject(40.0, 1e3, closing=-1.0)
            session.emulator.taken.clear()
            for _ in range(25):
                state = await session.cycle(Reference.at([0.0215], max_effort=[90.0]))
                await asyncio.sleep(0.02)
            assert state is not None
            assert state.grasped == (True,)
            # 30 % of 150 N, whether or not it was stopped on its way.
            assert abs(session.emulator.axis.effort) == pytest.approx(45.0)
            told = list(session.emulator.taken)
        if told == [Control.GRIP]:
            break
    assert told == [Control.GRIP]


async def test_what_is_gripped_is_released_before_it_opens() -> None:
    async with Session(CASE) as session:
        await session.before(close_schunk_egu)
        state = await session.start()
        assert state.grasped == (True,)
        assert session.near(await session.reach([0.005]), [0.005])
        assert (await session.sense()).grasped == (False,)
        order = session.emulator.taken
        assert order.index(Control.RELEASE) < order.index(Control.MOVE)


async def test_a_motion_takes_the_speed_of_the_reference() -> None:
    case = replace(CASE, options={**CASE.options, "emulator": {"haste": 1.0, "watch": 5.0}})
    async with Session(case) as session:
        await session.start()
        await session.reach([0.030])
        await cycled(session, 0.010, 20, max_velocity=[0.015])
        # Of the distance between the fingers, which changes twice as fast as a finger moves.
        assert session.emulator.axis.max_velocity == pytest.approx(30.0)


async def test_after_power_up_it_is_made_ready_without_moving() -> None:
    async with Session(CASE) as session:
        await session.before(lambda emulator: emulator.power_cycle(0.0))
        assert session.emulator.image().to_registers()[0] == 0x8000
        await session.connect()
        assert await session.driver.examine() == ""
        await session.driver.activate()
        status = session.emulator.image().status
        assert status & Status.READY
        assert not status & Status.ERROR
        assert session.emulator.moves == 0


async def test_silence_is_an_error_that_connecting_again_acknowledges() -> None:
    options = {**CASE.options, "emulator": {"haste": 8.0, "watch": 0.2}}
    async with Session(replace(CASE, options=options)) as session:
        await session.start()
        await session.driver.close()
        await asyncio.sleep(0.4)
        await session.connect()
        assert session.emulator.image().error == 0xEF
        await session.driver.activate()
        assert session.near(await session.reach([0.02]), [0.02])
        await asyncio.sleep(0.4)
        with pytest.raises(DeviceFault, match="communication lost"):
            await session.sense()


@pytest.mark.parametrize(
    ("fault", "code", "name", "remedy"),
    [
        ("motor_hot", 0x6D, "motor too hot", "let it cool down, then `rtee recover`"),
        ("motor_supply_low", 0x74, "supply of the motor too low", "check the 24 V supply, then"),
        ("overcurrent", 0xDE, "motor current too high", "free the fingers, then"),
    ],
)
async def test_errors_have_names_and_are_acknowledged(
    fault: str, code: int, name: str, remedy: str
) -> None:
    async with Session(CASE) as session:
        await session.start()
        session.emulator.inject(fault)
        with pytest.raises(DeviceFault, match=name) as told:
            await session.sense()
        assert (told.value.code, told.value.hint.startswith(remedy)) == (code, True)
        with pytest.raises(DeviceFault, match=name):
            await session.driver.recover()
        session.emulator.clear()
        await session.driver.recover()
        assert Control.ACKNOWLEDGE in session.emulator.taken
        await session.driver.activate()
        assert session.near(await session.reach([0.01]), [0.01])


async def test_an_error_that_only_a_restart_clears_says_so() -> None:
    async with Session(CASE) as session:
        await session.start()
        session.emulator.inject("restart")
        with pytest.raises(DeviceFault, match="restart required") as told:
            await session.sense()
        assert told.value.hint.startswith("switch its supply off and on")
        with pytest.raises(DeviceFault, match="restart required"):
            await session.driver.recover()
        session.wire.power_cycle()
        await session.driver.recover()
        await session.driver.activate()
        assert session.near(await session.reach([0.01]), [0.01])


async def test_a_motion_that_meets_something_is_an_error() -> None:
    async with Session(CASE) as session:
        await session.start()
        await session.reach([0.030])
        session.emulator.axis.obstacle = VirtualObject(40.0, 1e4, closing=1.0)
        with pytest.raises(DeviceFault, match="motion blocked") as told:
            await cycled(session, 0.005)
        assert told.value.code == 0xF4


async def test_the_brake_is_tested_where_asked_for() -> None:
    options = {**CASE.options, "brake_test": True}
    async with Session(replace(CASE, options=options)) as session:
        await session.start()
        assert session.emulator.tests == 1
        assert session.emulator.moves == 0
        assert session.near(await session.reach([0.02]), [0.02])
        await session.driver.close()
        session.emulator.inject("brake_test")
        await session.connect()
        with pytest.raises(DeviceFault, match="brake test failed") as told:
            await session.driver.activate()
        assert told.value.code == 0x28


async def test_another_device_and_a_wrong_stroke_are_named() -> None:
    async with Session(CASE) as session:
        await session.before(lambda emulator: emulator.inject("wrong_device"))
        with pytest.raises(HandshakeError, match="module type 99"):
            await session.driver.configure()
    long = replace(CASE, actuators=(replace(FINGER, upper=0.060),))
    async with Session(long) as session:
        with pytest.raises(ConfigError, match=r"moves 40.0 mm, but the actuator has 60.0 mm"):
            await session.driver.configure()


async def test_positions_are_the_distance_between_the_fingers() -> None:
    """The maker's demo moves to "30 mm, distance between fingers"; an EGU 60 reports 120 mm."""
    emulator = {"stroke": 120.0, "position": 120.0, "haste": 8.0, "watch": 5.0}
    finger = replace(FINGER, upper=0.060)
    case = replace(CASE, actuators=(finger,), options={**CASE.options, "emulator": emulator})
    async with Session(case) as session:
        await session.start()
        assert float((await session.sense()).position[0]) == pytest.approx(0.0, abs=1e-4)
        await cycled(session, 0.045)
        # Each finger has come 45 mm from its side: 120 - 2 * 45 mm are left between them.
        assert session.emulator.axis.position == pytest.approx(30.0, abs=0.5)
        assert session.driver.capabilities.identity["stroke between the fingers"] == "120.0 mm"


async def test_it_tells_what_it_is() -> None:
    async with Session(CASE) as session:
        await session.connect()
        capabilities = session.driver.capabilities
        assert capabilities.identity["model"] == "SCHUNK EGK 40 M-B"
        assert capabilities.identity["serial"] == "EMULATED"
        assert capabilities.identity["largest force"] == "150 N"
        assert capabilities.grip["left_finger_joint"].range_at(0.0) == (1.5, 150.0)


async def test_a_gripper_whose_positions_fall_while_it_opens() -> None:
    async with Session(replace(CASE, options={**CASE.options, "opens": "down"})) as session:
        await session.start()
        state = await session.sense()
        # At 80 mm it is closed then.
        assert float(state.position[0]) == pytest.approx(0.040)
        assert session.driver.position.to_count(0.040) == 80_000


def test_options_are_checked() -> None:
    for options, message in [
        ({"unit": 0}, "option 'unit'"),
        ({"opens": "left"}, "option 'opens'"),
        ({"brakes": True}, "did you mean 'brake_test'"),
    ]:
        with pytest.raises(ConfigError, match=message):
            SchunkEguDriver(replace(CASE, options=options).spec(), BusPool())
