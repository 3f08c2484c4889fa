"""The 2F passes the suite of all drivers: and what is special about it."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest

from rtee.buses.faults import Faults
from rtee.buses.pool import BusPool
from rtee.drivers.axis import VirtualObject
from rtee.drivers.robotiq_2f.codec import MODELS, Command
from rtee.drivers.robotiq_2f.driver import Robotiq2FDriver
from rtee.errors import BusError, ConfigError, DeviceFault, NotConnected
from rtee.testing import DeviceCase, DriverContract, Session, actuator, cycles
from rtee.types import JointKind, Reference
from tests.drivers.objects import close_robotiq
from tests.drivers.suites import same_wire

SCALE = MODELS["2f_85"].scale(0.0, 0.82)


def begun_with(emulator: Any) -> list[float]:
    return [SCALE.effort.to_si(emulator.begun.force)]


def closed_on_something(emulator: Any) -> None:
    command = Command(activate=True, go=True, position=255, speed=255, force=128)
    close_robotiq(emulator, command, 180, 20.0)


RTU = DeviceCase(
    driver="robotiq_2f",
    actuators=(actuator("finger_joint", 0.0, 0.82, effort=25.0),),
    options={
        "port": "/dev/ttyUSB0",
        "home": "on_connect",
        "emulator": {"haste": 8.0, "activation_time": 0.2},
    },
    grip_object=closed_on_something,
    commands=lambda emulator: emulator.moves,
    efforts=begun_with,
    max_efforts=[12.0],
    fault="overcurrent",
    cycles=cycles(100),
)


class TestRtu(DriverContract):
    case = RTU


FINGER = actuator(
    "left_finger_joint", 0.0, 0.025, kind=JointKind.PRISMATIC, velocity=0.075, effort=260.0
)
HAND_E_SCALE = MODELS["hand_e"].scale(0.0, 0.025)
HAND_E = replace(
    RTU,
    actuators=(FINGER,),
    options={**RTU.options, "model": "hand_e"},
    efforts=lambda emulator: [HAND_E_SCALE.effort.to_si(emulator.begun.force)],
    max_efforts=[150.0],
    tolerance=0.0005,
)


@same_wire
class TestHandE(DriverContract):
    case = HAND_E


pytestmark = pytest.mark.anyio


async def drive(session: Session, times: int) -> None:
    for _ in range(times):
        await session.driver.sense()
        await session.driver.move(Reference.at([0.5]))


OTHERS = [
    {"port": "socket://192.0.2.1:54321"},
    {"port": "tcp://192.0.2.1", "register_base": 0},
    {"exchange": "separate", "unit": 12},
]


@pytest.mark.parametrize("options", OTHERS, ids=["socket", "tcp", "separate"])
async def test_other_ways_to_the_gripper_work_too(options: dict[str, Any]) -> None:
    case = replace(RTU, options={**RTU.options, **options})
    async with Session(case) as session:
        await session.start()
        for goal in ([0.6], [0.2]):
            assert session.near(await session.reach(goal), goal)
        session.wire.faults = Faults(drop=0.05, delay=0.05, split=0.05, delay_time=0.003)
        for _ in range(50):
            await session.cycle(Reference.at([0.5]))
        session.wire.faults = Faults()
        session.wire.unplug()
        with pytest.raises((BusError, NotConnected)):
            await drive(session, 20)
        await session.driver.close()
        session.wire.replug()
        await session.start()
        assert session.near(await session.reach([0.3]), [0.3])


async def test_a_gripper_without_function_23_is_driven_by_16_and_3() -> None:
    emulator = {**RTU.options["emulator"], "functions": (3, 6, 16)}
    async with Session(replace(RTU, options={**RTU.options, "emulator": emulator})) as session:
        await session.start()
        assert session.near(await session.reach([0.4]), [0.4])
        for _ in range(30):
            await session.cycle(Reference.at([0.4]))
        assert 23 not in {pdu[0] for pdu in session.emulator.requests[-20:]}


async def test_an_activation_that_nobody_asked_for_is_ended() -> None:
    async with Session(RTU) as session:
        await session.start()
        await session.reach([0.4])
        session.wire.power_cycle()
        await session.driver.move(Reference.at([0.5]))
        with pytest.raises(DeviceFault, match="lost its activation"):
            await session.driver.sense()
        where = session.emulator.axis.position
        await asyncio.sleep(0.3)
        assert not session.emulator.status().activated
        assert session.emulator.axis.position == pytest.approx(where, abs=1.0)


async def test_a_slow_network_is_bridged_where_the_deadline_allows_it() -> None:
    options = {**RTU.options, "port": "socket://192.0.2.1:54321"}
    async with Session(replace(RTU, options=options, deadline=0.4)) as session:
        await session.start()
        session.wire.faults = Faults(delay=1.0, delay_time=0.02)
        for goal in ([0.6], [0.2]):
            assert session.near(await session.reach(goal), goal)
        assert session.driver.counters()["timeouts"] == 0


async def test_two_grippers_share_a_line() -> None:
    second = replace(RTU, options={**RTU.options, "unit": 10})
    async with BusPool() as pool:
        async with (
            Session(RTU, pool=pool, name="left") as left,
            Session(second, pool=pool, name="right") as right,
        ):
            await left.start()
            await right.start()
            assert len(pool.buses) == 1
            there = await asyncio.gather(left.reach([0.3]), right.reach([0.7]))
            assert left.near(there[0], [0.3])
            assert right.near(there[1], [0.7])
            await left.driver.close()
            assert right.near(await right.reach([0.5]), [0.5])
        assert pool.buses == ()


async def test_one_exchange_does_a_whole_cycle() -> None:
    async with Session(RTU) as session:
        await session.start()
        await session.reach([0.4])
        heard = len(session.emulator.requests)
        before = session.driver.counters()["transactions"]
        for n in range(20):
            await session.driver.sense()
            await session.driver.move(Reference.at([0.4 + 0.01 * n]))
        assert heard > 0
        assert session.driver.counters()["transactions"] - before <= 21


async def test_closing_on_an_object_is_a_grasp_and_on_nothing_is_none() -> None:
    async with Session(RTU) as session:
        await session.start()
        state = await session.reach([0.82])
        assert state.grasped == (False,)
        await session.reach([0.1])
        session.emulator.axis.obstacle = VirtualObject(120, 40.0)
        for _ in range(100):
            held = await session.cycle(Reference.at([0.82]))
            assert held is not None
            if held.grasped == (True,):
                break
            await asyncio.sleep(0.01)
        assert held.grasped == (True,)
        assert held.current[0] > 0.1


async def test_a_held_object_stays_held_when_asked_to_stay() -> None:
    async with Session(RTU) as session:
        await session.before(closed_on_something)
        state = await session.start()
        assert state.grasped == (True,)
        effort = session.emulator.axis.effort
        for _ in range(20):
            await session.cycle(Reference.at(state.position))
        assert session.emulator.axis.effort == effort > 0
        await session.reach([0.1])
        assert session.emulator.axis.effort <= 0


async def test_an_inactive_gripper_is_activated_only_when_allowed() -> None:
    options = {**RTU.options, "home": "on_demand", "emulator": {"activated": False, "haste": 9.0}}
    async with Session(replace(RTU, options=options)) as session:
        await session.connect()
        with pytest.raises(DeviceFault, match="not activated") as caught:
            await session.driver.activate()
        assert "rtee recover" in caught.value.hint
        assert session.emulator.activations == 0
        await session.driver.recover()
        assert session.emulator.activations == 0
        await session.driver.activate()
        assert session.emulator.activations == 1


async def test_an_activation_can_be_cancelled() -> None:
    emulator = {"activation_time": 60.0}
    async with Session(replace(RTU, options={**RTU.options, "emulator": emulator})) as session:
        await session.connect()
        task = asyncio.create_task(session.driver.activate())
        await asyncio.sleep(0.1)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert not session.emulator.status().activated


async def test_an_activation_that_takes_too_long_is_ended() -> None:
    slow = {"emulator": {"activation_time": 60.0}, "activation_timeout": 0.3}
    async with Session(replace(RTU, options={**RTU.options, **slow})) as session:
        await session.connect()
        with pytest.raises(DeviceFault, match="activation did not finish in time"):
            await session.driver.activate()
        assert not session.emulator.status().activated


async def test_the_best_rate_is_that_of_the_wire() -> None:
    async with BusPool() as pool:
        driver = Robotiq2FDriver(RTU.spec(), pool)
        await driver.configure()
        exchange = 30 * 10 / 115200 + 2 * 0.00175
        assert driver.capabilities.best_rate == pytest.approx(1 / exchange)
        await driver.close()


@pytest.mark.parametrize(
    ("model", "silence"), [("hand_e", 0.00175), ("hand_e_c10", 0.010)], ids=["hand_e", "c10"]
)
async def test_a_c10_gets_the_silence_that_its_coupling_needs(model: str, silence: float) -> None:
    case = replace(HAND_E, options={**HAND_E.options, "model": model})
    async with BusPool() as pool:
        driver = Robotiq2FDriver(case.spec(), pool)
        await driver.configure()
        exchange = 30 * 10 / 115200 + 2 * silence
        assert driver.capabilities.best_rate == pytest.approx(1 / exchange)
        assert driver.capabilities.identity["model"] == MODELS[model].name
        await driver.close()


def test_options_are_checked() -> None:
    for options, message in [
        ({"model": "hand_f"}, "option 'model'"),
        ({"prot": "/dev/x"}, "unknown option 'prot'; did you mean 'port'"),
        ({"unit": 0}, "option 'unit'"),
        ({"home": "always"}, "option 'home'"),
        ({"emulator": 3}, "option 'emulator'"),
    ]:
        with pytest.raises(ConfigError, match=message):
            Robotiq2FDriver(replace(RTU, options=options).spec(), BusPool())
