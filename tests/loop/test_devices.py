"""What happens to a hand when its devices are slow, silent, broken or wrong."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace

import anyio
import numpy as np
import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.errors import (
    BusBroken,
    BusTimeout,
    CommandRejected,
    ConfigError,
    DeviceFault,
    DriverError,
    FrameError,
    GoalRejected,
    HandshakeError,
    RteeError,
)
from rtee.hand.config_schema import Behaviour, SafetySettings
from rtee.hand.model import Hand
from rtee.loop.handloop import HandLoop, bring_to_rest
from rtee.loop.settings import LoopSettings
from rtee.loop.supervisor import LOST_AFTER, Supervisor
from rtee.sample import ActuatorState
from rtee.types import DeviceStatus, Goal, Intensity, Lifecycle, Named, Reference

from .hands import Rig, Watcher, device, make_library, running

pytestmark = pytest.mark.anyio
INDEX = ("index_base", "index_tip")
THUMB = ("thumb_base", "thumb_slide")


class Trouble(KinematicDriver):
    """A kinematic device that can be made to misbehave.

    Attributes:
        errors: Raised by the next exchanges, one each.
        hang: How many event loop turns an exchange takes; infinite: it never comes back.
        deaf: Whether references get lost.
        astray: The actuator whose position is measured far away.
        arrived: The references that it got.
        log: The calls it got.
    """

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        self.errors: list[Exception] = []
        self.refuse: list[Exception] = []
        self.refuse_active: Exception | None = None
        self.hang: float = 0
        self.deaf = False
        self.astray: int | None = None
        self.arrived: list[Reference] = []
        self.log: list[str] = []

    async def configure(self) -> None:
        self.log.append("configure")
        if self.refuse:
            raise self.refuse.pop(0)
        await super().configure()

    async def activate(self) -> None:
        self.log.append("activate")
        if self.refuse_active is not None:
            raise self.refuse_active
        await super().activate()

    async def sense(self) -> ActuatorState:
        if math.isinf(self.hang):
            await anyio.sleep_forever()
        for _ in range(int(self.hang)):
            await asyncio.sleep(0)
        if self.errors:
            raise self.errors.pop(0)
        state = await super().sense()
        if self.astray is None:
            return state
        position = np.array(state.position)
        position[self.astray] = 1e6
        return replace(state, position=position)

    async def move(self, reference: Reference) -> None:
        self.log.append("move")
        if self.deaf:
            raise BusTimeout("dummy", "noise")
        self.arrived.append(reference)
        await super().move(reference)

    async def stop(self) -> None:
        self.log.append("stop")
        await super().stop()

    async def close(self) -> None:
        self.log.append("close")
        await super().close()


def trouble(hand: Hand, name: str = "dummy", **more: object) -> tuple[object, Trouble]:
    settings = device(hand, name, **more)  # type: ignore[arg-type]
    return settings, Trouble(settings.spec, BusPool())


def status(rig: Rig, name: str = "dummy") -> DeviceStatus:
    return rig.loop.devices[name].status()


async def test_lost_packets_are_counted_and_nothing_else_happens(hand: Hand) -> None:
    settings, driver = trouble(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        rig.loop.submit(Goal(Named("fist")))
        for k in range(100):
            driver.errors = [BusTimeout("wire", "lost") if k % 2 else FrameError("wire", "bad")]
            await rig.run(0.02)
        result = rig.watcher.results[0]
        assert result.reached
        assert status(rig).errors == 100
        assert status(rig).lifecycle is Lifecycle.ACTIVE
        stale = sum(not record.fresh.any() for record in rig.watcher.records)
        assert 100 <= stale <= 102


@pytest.mark.parametrize("seconds", [0.2, 0.7])
async def test_a_device_that_only_misses_references_catches_up_without_a_jump_or_is_lost(
    hand: Hand, seconds: float
) -> None:
    settings, driver = trouble(hand)
    arrived = driver.arrived
    async with running(hand, None, [(settings, driver)]) as rig:
        rig.loop.submit(Goal(Named("fist"), speed=0.5))
        await rig.run(0.3)
        before, driver.deaf = len(arrived) - 1, True
        await rig.run(seconds)
        driver.deaf = False
        if seconds > LOST_AFTER:
            assert "device_lost" in rig.watcher.kinds()
            await rig.run(1.0)
            assert len(arrived) == before + 1
            return
        assert (await rig.result()).reached
        steps = np.abs(np.diff([each.position for each in arrived[before:]], axis=0))
        top = np.array([0.5 * actuator.velocity for actuator in hand.actuators])
        assert (steps[0] <= 0.05 * top * (1 + 1e-6)).all()
        assert (steps[1:] <= top / rig.clock.rate * (1 + 1e-6)).all()


async def test_a_started_reference_that_did_not_arrive_is_where_the_next_one_starts(
    hand: Hand,
) -> None:
    settings, driver = trouble(hand)
    link = Supervisor(settings, driver, (0, 1, 2, 3), lambda _: None).connection
    await link.connect()
    first = Reference.at([0.1] * 4, max_velocity=[1.0] * 4)
    await link.exchange(first)
    link.restart([0], np.full(4, 0.5))
    driver.errors = [BusTimeout("dummy", "noise")]
    await link.exchange(Reference.at([0.9] * 4, max_velocity=[1.0] * 4))
    assert link.last(first).position.tolist() == [0.5, 0.1, 0.1, 0.1]


async def test_the_first_reference_after_missed_exchanges_is_where_they_started(hand: Hand) -> None:
    settings, driver = trouble(hand, deadline=1.0)
    async with running(hand, None, [(settings, driver)]) as rig:
        await rig.loop.devices["dummy"].disable(1.0)
        here = (await driver.sense()).position
        driver.arrived.clear()
        await rig.loop.recover()
        driver.errors = [BusTimeout("wire", "lost")] * 1000  # from its first exchange on
        rig.loop.submit(Goal(Named("fist")))
        await rig.run(0.3)
        assert not driver.arrived
        assert status(rig).lifecycle is Lifecycle.ACTIVE
        driver.errors = []
        await rig.run(1.0)
        assert driver.arrived[0].position == pytest.approx(here, abs=1e-9)
        steps = np.abs(np.diff([each.position for each in driver.arrived], axis=0))
        top = np.array([actuator.velocity for actuator in hand.actuators])
        assert (steps <= 2.0 * top / rig.clock.rate * (1 + 1e-6)).all()


async def test_the_first_reference_after_an_implausible_position_is_where_they_started(
    hand: Hand,
) -> None:
    settings, driver = trouble(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        await rig.loop.devices["dummy"].disable(1.0)
        driver.astray = 1
        await rig.loop.recover()
        driver.arrived.clear()
        await rig.run(0.1)
        rig.loop.submit(Goal(Named("Trig", ("thumb",))))
        await rig.run(1.0)
        assert not driver.arrived
        led = rig.loop.controller.reference_position
        driver.astray = None
        await rig.run(2.0)
        assert max(led) > 0.5
        assert np.abs(driver.arrived[0].position).max() < 0.01
        steps = np.abs(np.diff([each.position for each in driver.arrived], axis=0))
        top = np.array([actuator.velocity for actuator in hand.actuators])
        assert (steps <= 2.0 * top / rig.clock.rate * (1 + 1e-6)).all()


async def test_references_that_are_started_while_one_is_sent_are_where_the_next_one_starts(
    hand: Hand,
) -> None:
    settings, driver = trouble(hand)
    link = Supervisor(settings, driver, (0, 1, 2, 3), lambda _: None).connection
    await link.connect()
    last = Reference.at([1.0] * 4, max_velocity=[1.0] * 4)
    await link.exchange(last)
    sending, sent = anyio.Event(), anyio.Event()

    async def fail(reference: Reference) -> None:
        sending.set()
        await sent.wait()
        raise BusTimeout("dummy", "noise")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "move", fail)
        async with anyio.create_task_group() as group:
            group.start_soon(link.exchange, last)
            await sending.wait()
            link.restart([0, 1, 2, 3], np.full(4, 0.2))
            sent.set()
    await link.exchange(Reference.at([0.2] * 4, max_velocity=[1.0] * 4))
    assert driver.arrived[-1].position.tolist() == [0.2] * 4


async def test_refused_references_are_answers(hand: Hand) -> None:
    settings, driver = trouble(hand)

    async def refuse(reference: Reference) -> None:
        raise CommandRejected("dummy", "too far")

    async with running(hand, None, [(settings, driver)]) as rig:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(driver, "move", refuse)
            for _ in range(3):
                driver.errors = [BusTimeout("wire", "lost")]
                await rig.run(0.4)
        assert status(rig).lifecycle is Lifecycle.ACTIVE


@pytest.mark.parametrize("ends", ["goal", "stop", "run"])
async def test_after_lost_packets_the_device_catches_up_without_a_jump(
    hand: Hand, ends: str
) -> None:
    settings, driver = trouble(hand)
    sent: list[Reference] = []
    move = driver.move

    async def watched(reference: Reference) -> None:
        sent.append(reference)
        await move(reference)

    driver.move = watched  # type: ignore[method-assign]
    async with running(hand, None, [(settings, driver)]) as rig:
        rig.loop.submit(Goal(Named("fist"), speed=0.5))
        await rig.run(0.3)
        before = len(sent) - 1
        driver.errors = [BusTimeout("dummy", "noise")] * 400
        await rig.run(0.4)
        assert len(sent) == before + 1
        ahead = rig.loop.snapshot().reference_position - sent[-1].position
        assert ahead[0] > 0.3
        if ends == "stop":
            async with anyio.create_task_group() as group:
                group.start_soon(rig.loop.stop)
                await rig.run(0.01)
            await rig.run(0.2)
            assert sent[-1].position == pytest.approx([p.position for p in driver.plants])
            assert sent[-1].position == pytest.approx(sent[before].position, abs=0.06)
        elif ends == "run":
            driver.errors.clear()
            assert await bring_to_rest(rig.loop, Behaviour.HOLD, "a test") == [("dummy", True)]
            assert sent[-1].position == pytest.approx(sent[before].position, abs=0.06)
            return
        else:
            assert (await rig.result()).reached
        assert (sent[-1].position == rig.loop.snapshot().reference_position).all()
        top = np.array([0.5 * actuator.velocity for actuator in hand.actuators])
        steps = np.abs(np.diff([each.position for each in sent[before:]], axis=0))
        assert (steps[0] <= 0.05 * top * (1 + 1e-6)).all(), (
            "as far as within an exchange's deadline"
        )
        if ends == "goal":
            assert (steps[1:] <= top / rig.clock.rate * (1 + 1e-6)).all()


async def test_silence_is_a_lost_device_and_it_comes_back_inactive(hand: Hand) -> None:
    settings, driver = trouble(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        await rig.do("Trig", "index", intensity=0.5)
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(0.1)
        driver.errors = [BusTimeout("wire", "silent") for _ in range(1000)]
        result = await rig.result()
        assert result.aborted
        assert "lost" in result.reason
        assert status(rig).lifecycle is Lifecycle.UNCONFIGURED
        assert driver.log[-1] == "close"
        driver.errors.clear()
        driver.log.clear()
        await rig.run(1.0)
        assert status(rig).lifecycle is Lifecycle.INACTIVE
        assert status(rig).reconnects == 1
        assert driver.log == ["configure"]
        with pytest.raises(GoalRejected, match="device 'dummy' is inactive"):
            rig.loop.submit(Goal(Named("open")))
        assert "reconnected" in rig.watcher.kinds()


async def test_a_device_with_time_to_answer_is_lost_after_three_deadlines(hand: Hand) -> None:
    """A driver that gives up sooner than its deadline had a device lost while that had time."""
    settings, driver = trouble(hand, deadline=1.0)
    async with running(hand, None, [(settings, driver)]) as rig:
        await rig.do("Trig", "index", intensity=0.5)
        driver.errors = [BusTimeout("wire", "silent") for _ in range(10000)]
        await rig.run(2.9)
        assert status(rig).lifecycle is Lifecycle.ACTIVE
        await rig.run(0.2)
        assert status(rig).lifecycle is Lifecycle.UNCONFIGURED


async def test_after_recovery_the_reference_begins_where_the_hand_is(hand: Hand) -> None:
    settings, driver = trouble(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        await rig.do("Trig", "index", intensity=0.5)
        driver.unplug()
        await rig.run(0.1)
        driver.plug()
        await rig.run(1.0)
        for plant, position in zip(driver.plants, (0.2, 0.9, -0.4, 0.03), strict=True):
            plant.position = plant.target = position  # somebody moved it by hand
        driver.log.clear()
        async with anyio.create_task_group() as group:
            group.start_soon(rig.loop.recover)
            await rig.run(0.1)
        assert driver.log[0] == "activate"
        assert [plant.target for plant in driver.plants] == [0.2, 0.9, -0.4, 0.03]
        assert [plant.position for plant in driver.plants] == [0.2, 0.9, -0.4, 0.03]
        assert status(rig).lifecycle is Lifecycle.ACTIVE
        assert (await rig.do("open")).reached


@pytest.mark.parametrize("how", ["goal", "jog"])
async def test_what_is_recovered_moves_without_waiting_for_a_tick(hand: Hand, how: str) -> None:
    """A goal right after `recover` was refused, unless a tick came between them."""
    one = device(hand)
    driver = Trouble(one.spec, BusPool())
    name, target = hand.actuator_names[0], float(hand.upper[0]) / 2.0

    def move(rig: Rig) -> None:
        if how == "goal":
            rig.loop.submit(Goal(Named("Trig", ("index",)), Intensity(0.5)))
        else:
            rig.loop.jog({name: target})

    async with running(hand, None, [(one, driver)]) as rig:
        await rig.loop.disable()
        await rig.run(0.1)
        with pytest.raises(GoalRejected, match="recover"):
            move(rig)
        await rig.loop.recover()
        move(rig)
        await rig.run(2.0)
        assert driver.plants[0].position == pytest.approx(target)


async def test_a_device_may_be_configured_to_come_back_active(hand: Hand) -> None:
    settings, driver = trouble(hand, reconnect_active=True)
    async with running(hand, None, [(settings, driver)]) as rig:
        driver.unplug()
        await rig.run(0.1)
        assert status(rig).lifecycle is Lifecycle.UNCONFIGURED
        driver.plug()
        await rig.run(1.0)
        assert status(rig).lifecycle is Lifecycle.ACTIVE
        assert [plant.target for plant in driver.plants] == hand.rest.tolist()


async def test_what_is_recovered_between_two_ticks_starts_where_it_is_measured(
    hand: Hand,
) -> None:
    """As in a slow loop, which sees only that the device is active, as before."""
    settings, driver = trouble(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        assert (await rig.do("Trig", "index")).reached
        await rig.loop.disable()
        for plant in driver.plants:  # moved by hand meanwhile
            plant.position = plant.target = 0.5 * (plant.spec.lower + plant.spec.upper)
        await rig.loop.recover()
        for _ in range(50):
            await rig.run(1 / rig.clock.rate)
            assert [p.target for p in driver.plants] == [p.position for p in driver.plants]
        assert driver.plants[0].position == 0.75


async def test_attempts_to_reconnect_come_less_and_less_often(hand: Hand) -> None:
    settings, driver = trouble(hand)
    async with running(hand, LoopSettings(rate=100.0), [(settings, driver)]) as rig:
        driver.unplug()
        driver.log.clear()
        await rig.run(40.0)
        attempts = driver.log.count("configure")
        # 0.2, 0.4, 0.8, 1.6, 3.2, then every 5 s
        assert 10 <= attempts <= 13
        told = [e for e in rig.watcher.events if "unplugged" in e.text]
        assert len(told) == 1, "the same message is told once"


async def test_activation_that_fails_is_tried_less_and_less_often(hand: Hand) -> None:
    settings, driver = trouble(hand)
    driver.refuse_active = DriverError("dummy", "does not get enough voltage")
    async with running(hand, LoopSettings(rate=100.0), [(settings, driver)]) as rig:
        await rig.run(40.0)
        # 0.2, 0.4, 0.8, 1.6, 3.2, then every 5 s
        assert 10 <= driver.log.count("activate") <= 13
        told = [e for e in rig.watcher.events if "voltage" in e.text]
        assert len(told) == 1, "the same message is told once"
        assert "reconnected" not in rig.watcher.kinds()
        assert status(rig).reconnects == 0
        driver.refuse_active = None
        await rig.run(6.0)
        assert status(rig).lifecycle is Lifecycle.ACTIVE
        driver.unplug()
        await rig.run(0.1)
        driver.plug()
        await rig.run(0.3)
        assert status(rig).reconnects == 1, "once it was active, it is soon tried again"


async def test_a_hundred_unplugs_leave_no_task_behind(hand: Hand) -> None:
    settings, driver = trouble(hand, reconnect_active=True)
    async with running(hand, LoopSettings(rate=50.0), [(settings, driver)]) as rig:
        tasks = len(asyncio.all_tasks())
        for _ in range(100):
            driver.unplug()
            await rig.run(0.1)
            driver.plug()
            await rig.run(0.5)
            assert status(rig).lifecycle is Lifecycle.ACTIVE
        assert len(asyncio.all_tasks()) == tasks
        assert status(rig).reconnects == 100


async def test_a_device_that_is_not_there_at_first_is_activated_when_it_comes(hand: Hand) -> None:
    settings, driver = trouble(hand)
    driver.refuse = [BusBroken("wire", "no such port"), HandshakeError("dummy", "a", "b")]
    async with running(hand, None, [(settings, driver)]) as rig:
        assert status(rig).lifecycle is Lifecycle.UNCONFIGURED
        assert "no such port" in status(rig).message
        await rig.run(0.3)
        assert "expected a, found b" in status(rig).message
        await rig.run(1.0)
        assert status(rig).lifecycle is Lifecycle.ACTIVE
        assert (await rig.do("fist")).reached


async def test_a_users_mistake_is_raised_at_the_start_and_not_said_before(hand: Hand) -> None:
    settings, driver = trouble(hand)
    driver.refuse = [ConfigError("no such baud rate")]
    watcher = Watcher()
    loop = HandLoop(hand, make_library(hand), LoopSettings(), [(settings, driver)])
    loop.add_observer(watcher)
    async with loop:
        with pytest.raises(ConfigError, match="baud rate"):
            await loop.ready()
    assert watcher.events == []


async def test_a_fault_is_named_and_recovered_without_a_jump(hand: Hand) -> None:
    settings, driver = trouble(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(0.2)
        driver.fail("overload")
        result = await rig.result()
        assert result.aborted
        assert "overload" in result.reason
        now = status(rig)
        assert (now.lifecycle, now.fault_name, now.fault_code) == (Lifecycle.FAULT, "overload", 1)
        assert now.recoverable
        assert "recover" in now.hint
        await rig.run(1.0)
        assert rig.watcher.kinds().count("device_fault") == 1
        driver.log.clear()
        before = [plant.position for plant in driver.plants]
        async with anyio.create_task_group() as group:
            group.start_soon(rig.loop.recover, "dummy")
            await rig.run(0.05)
        assert status(rig).fault_name == ""
        assert [plant.position for plant in driver.plants] == before
        assert "recovered" in rig.watcher.kinds()
        assert (await rig.do("open")).reached


class NotHomed(Trouble):
    """It answers, and is only to be activated once it was recovered."""

    async def activate(self) -> None:
        if "recover" not in self.log:
            raise DeviceFault(self.spec.name, 2, "not homed")
        await super().activate()

    async def recover(self) -> None:
        self.log.append("recover")
        await super().recover()


async def test_what_was_disabled_in_fault_is_recovered_from_it(hand: Hand) -> None:
    settings = device(hand)
    driver = NotHomed(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        assert status(rig).fault_name == "not homed"
        async with anyio.create_task_group() as group:
            group.start_soon(rig.loop.disable)
            await rig.run(0.2)
        assert status(rig).lifecycle is Lifecycle.INACTIVE
        async with anyio.create_task_group() as group:
            group.start_soon(rig.loop.recover)
            await rig.run(0.2)
        assert driver.log.count("recover") == 1
        assert (status(rig).lifecycle, status(rig).fault_name) == (Lifecycle.ACTIVE, "")


async def test_a_fault_that_persists_is_told_who_recovers(hand: Hand) -> None:
    class Stubborn(Trouble):
        async def recover(self) -> None:
            raise DeviceFault("dummy", 7, "still hot", hint="let it cool")

    settings = device(hand)
    driver = Stubborn(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        driver.fail("hot")
        await rig.run(0.05)
        errors: list[RteeError] = []

        async def recover() -> None:
            try:
                await rig.loop.recover()
            except RteeError as error:
                errors.append(error)

        async with anyio.create_task_group() as group:
            group.start_soon(recover)
            await rig.run(0.05)
        assert "still hot" in str(errors[0])
        assert status(rig).lifecycle is Lifecycle.FAULT


async def test_what_the_device_refuses_aborts_the_goal_and_nothing_else(hand: Hand) -> None:
    class Refusing(Trouble):
        async def move(self, reference: Reference) -> None:
            if reference.position[0] > 0.5:
                raise CommandRejected(self.spec.name, "out of its range")
            await super().move(reference)

    settings = device(hand)
    driver = Refusing(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        result = await rig.do("Trig", "index")
        assert result.aborted
        assert "out of its range" in result.reason
        assert status(rig).lifecycle is Lifecycle.ACTIVE
        assert "rejected" in rig.watcher.kinds()
        assert (await rig.do("open")).reached


async def test_a_device_gets_its_reference_before_the_tick_is_recorded(hand: Hand) -> None:
    class Noting(Trouble):
        async def move(self, reference: Reference) -> None:
            for rig in rigs:
                sent.append((rig.loop.snapshot().tick, reference.position.tolist()))
            await super().move(reference)

    rigs: list[Rig] = []
    sent: list[tuple[int, list[float]]] = []
    settings = device(hand)
    async with running(hand, None, [(settings, Noting(settings.spec, BusPool()))]) as rig:
        rigs.append(rig)
        await rig.do("Trig", "index", intensity=0.2)
        recorded = {each.tick: each.reference_position.tolist() for each in rig.watcher.records}
        assert len(sent) > 100
        assert [recorded[tick + 1] for tick, _ in sent] == [position for _, position in sent]


async def test_a_bug_in_a_driver_does_not_end_the_loop(hand: Hand) -> None:
    settings, driver = trouble(hand, reconnect_active=True)
    async with running(hand, None, [(settings, driver)]) as rig:
        driver.errors = [ZeroDivisionError("a bug")]
        await rig.run(0.05)
        assert "device_lost" in rig.watcher.kinds()
        assert "a bug" in status(rig).message
        await rig.run(0.5)
        assert status(rig).lifecycle is Lifecycle.ACTIVE


async def test_a_hanging_exchange_is_given_up_at_its_deadline(hand: Hand) -> None:
    settings, driver = trouble(hand, deadline=0.03, reconnect_active=True)
    async with running(hand, None, [(settings, driver)]) as rig:
        driver.hang = math.inf
        await rig.run(0.1)
        now = status(rig)
        assert 2 <= now.errors <= 4
        assert now.overruns >= 80
        assert "deadline" in now.message
        driver.hang = 0
        await rig.run(0.1)
        assert status(rig).lifecycle is Lifecycle.ACTIVE
        assert rig.loop.snapshot().fresh.all()


async def test_an_answer_after_a_pause_brings_no_reference_from_before(hand: Hand) -> None:
    """A process that was stopped in an exchange wakes up for the answer first, then for a tick."""
    settings, driver = trouble(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        rig.loop.submit(Goal(Named("fist")))
        await rig.run(0.2)
        driver.hang = 3 * rig.clock.turns
        rig.loop.tick(rig.clock.next())  # the exchange begins
        late = rig.clock.next(missed=10_000)
        sent, errors = driver.log.count("move"), status(rig).errors
        for _ in range(4):
            await rig.clock.settle()
        assert driver.log.count("move") == sent
        assert status(rig).errors == errors + 1
        driver.hang = 0
        rig.loop.tick(late)
        await rig.run(0.1)
        assert driver.log.count("move") > sent, "it goes on"
        assert status(rig).lifecycle is Lifecycle.ACTIVE


async def test_a_hanging_connection_is_given_up(hand: Hand) -> None:
    class Hanging(Trouble):
        async def configure(self) -> None:
            self.log.append("configure")
            if self.log.count("configure") == 1:
                await anyio.sleep_forever()

    settings = device(hand)
    driver = Hanging(settings.spec, BusPool())
    clock_settings = LoopSettings(rate=10.0)
    from rtee.loop.clock import ManualClock

    clock = ManualClock(10.0)
    driver.now = clock.now
    loop = HandLoop(hand, make_library(hand), clock_settings, [(settings, driver)], now=clock.now)
    async with loop:
        for _ in range(230):
            await clock.settle()
            loop.tick(clock.next())
        assert loop.devices["dummy"].lifecycle is Lifecycle.ACTIVE


def two(hand: Hand, **more: object) -> tuple[list[tuple[object, Trouble]], Trouble, Trouble]:
    left = trouble(hand, "left", actuators=INDEX, **more)
    right = trouble(hand, "right", actuators=THUMB)
    return [left, right], left[1], right[1]


async def test_one_hand_may_have_several_devices(hand: Hand) -> None:
    devices, left, right = two(hand)
    async with running(hand, None, devices) as rig:
        result = await rig.do("fist")
        assert result.reached
        assert [p.target for p in left.plants] == [1.5, 1.2]
        assert [p.target for p in right.plants] == [1.0, 0.04]
        record = rig.loop.snapshot()
        assert record.position == pytest.approx([1.5, 1.2, 1.0, 0.04], abs=0.01)
        assert record.fresh.all()


async def test_a_slow_device_delays_no_other(hand: Hand) -> None:
    devices, left, _ = two(hand, deadline=10.0)
    async with running(hand, None, devices) as rig:
        await rig.run(1.0)
        before = status(rig, "right").exchanges, status(rig, "left").exchanges
        left.hang = 12 * 80  # it takes 80 ticks
        await rig.run(2.0)
        assert status(rig, "right").exchanges - before[0] == 2000
        slow = status(rig, "left").exchanges - before[1]
        assert 20 <= slow <= 27
        assert status(rig, "left").rate < 20
        fresh = [record.fresh.tolist() for record in rig.watcher.records[-400:]]
        assert all(flags[2] and flags[3] for flags in fresh)
        assert sum(flags[0] for flags in fresh) <= 8
        left.hang = 0
        await rig.run(0.2)
        assert (await rig.do("Trig", "thumb")).reached


async def test_each_device_is_exchanged_every_n_ticks(hand: Hand) -> None:
    devices, _, _ = two(hand, every=5)
    async with running(hand, None, devices) as rig:
        before = status(rig, "right").exchanges, status(rig, "left").exchanges
        await rig.run(1.0)
        assert status(rig, "right").exchanges - before[0] == 1000
        assert status(rig, "left").exchanges - before[1] == 200
        assert status(rig, "left").every == 5


async def test_the_best_rate_decides_and_asking_for_more_is_told(hand: Hand) -> None:
    from dataclasses import replace

    for every, expected in ((None, 8), (2, 2)):
        settings, driver = trouble(hand, every=every)
        driver.capabilities = replace(driver.capabilities, best_rate=130.0)
        async with running(hand, None, [(settings, driver)]) as rig:
            assert status(rig).every == expected
            assert ("device_rate" in rig.watcher.kinds()) == (every == 2)


@pytest.mark.parametrize("behaviour", list(Behaviour))
async def test_what_the_rest_of_the_hand_does_when_a_device_is_lost(
    hand: Hand, behaviour: Behaviour
) -> None:
    settings = LoopSettings(safety=SafetySettings(on_link_lost=behaviour))
    devices, left, right = two(hand)
    async with running(hand, settings, devices) as rig:
        rig.loop.submit(Goal(Named("fist")))
        await rig.run(0.3)
        left.unplug()
        result = await rig.result()
        assert result.aborted
        assert "left" in result.reason
        await rig.run(1.0)
        thumb = right.plants[0]
        after = status(rig, "right").lifecycle
        match behaviour:
            case Behaviour.HOLD | Behaviour.STOP:
                assert thumb.target == pytest.approx(thumb.position, abs=0.01)
                assert 0.0 < thumb.position < 0.9
                assert after is Lifecycle.ACTIVE
            case Behaviour.DISABLE:
                assert after is Lifecycle.INACTIVE
            case Behaviour.OPEN:
                # The whole hand can't be opened any more; what is left of it is.
                assert thumb.position == pytest.approx(0.0, abs=0.01)
        assert ("stop" in right.log) == (behaviour is Behaviour.STOP)


async def test_gains_are_set_while_it_runs(hand: Hand) -> None:
    async with running(hand) as rig:
        async with anyio.create_task_group() as group:
            group.start_soon(rig.loop.set_gains, {"time_constant": 0.5})
            await rig.run(0.01)
        assert rig.driver._time_constant == 0.5
        with pytest.raises(ConfigError, match="did you mean 'time_constant'"):
            await rig.loop.set_gains({"time_const": 1.0})
        with pytest.raises(ConfigError, match="must be a number"):
            await rig.loop.set_gains({"time_constant": math.nan})
        with pytest.raises(ConfigError, match="unknown device"):
            await rig.loop.set_gains({"time_constant": 1.0}, "dumy")
        with pytest.raises(DriverError, match="has no gain"):
            await rig.loop.devices["dummy"].set_gains({"kp": 1.0})
        with pytest.raises(ConfigError, match="unknown device"):
            await rig.loop.recover("dumy")


async def test_every_actuator_is_driven_once(hand: Hand) -> None:
    library = make_library(hand)
    left, right = trouble(hand, "left", actuators=INDEX), trouble(hand, "right", actuators=THUMB)
    both = trouble(hand, "both")
    for devices, reason in (
        ([left], "no device drives the actuator 'thumb_base'"),
        ([left, both], "driven by two devices, 'left' and 'both'"),
        ([], "no device drives"),
    ):
        with pytest.raises(ConfigError, match=reason):
            HandLoop(hand, library, LoopSettings(), devices)
    assert HandLoop(hand, library, LoopSettings(), [left, right]).statuses()[0].age == math.inf


async def test_a_position_that_is_no_longer_measured_keeps_its_last_value(hand: Hand) -> None:
    class Blind(Trouble):
        blind = False

        async def sense(self) -> ActuatorState:
            state = await super().sense()
            if self.blind:
                state.position[1] = math.nan
            return state

    settings = device(hand, start={"index_tip": 0.4})
    driver = Blind(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        driver.blind = True
        await rig.run(0.05)
        assert rig.loop.snapshot().position[1] == 0.4
        await rig.do("Trig", "thumb")
        assert rig.loop.snapshot().reference_position[1] == 0.4


async def test_a_device_that_never_measures_its_position_is_never_moved(hand: Hand) -> None:
    class Blind(Trouble):
        async def sense(self) -> ActuatorState:
            state = await super().sense()
            return ActuatorState.measured(state.position * math.nan, state.stamp)

    settings = device(hand)
    driver = Blind(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        await rig.run(0.1)
        with pytest.raises(GoalRejected, match="device 'dummy' has not measured its position"):
            rig.loop.submit(Goal(Named("open")))
        assert "move" not in driver.log


async def test_closing_is_final(hand: Hand) -> None:
    settings, driver = trouble(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        pass
    assert driver.log[-1] == "close"
    assert status(rig).lifecycle is Lifecycle.CLOSED
    with pytest.raises(RteeError, match="closed"):
        await rig.loop.recover()
    assert await rig.loop.stop() == [("dummy", False)]


async def test_a_state_of_the_wrong_size_is_the_drivers_error_and_not_the_loops(hand: Hand) -> None:
    class Wrong(Trouble):
        wrong = False

        async def sense(self) -> ActuatorState:
            state = await super().sense()
            return ActuatorState.measured([1.0, 2.0], state.stamp) if self.wrong else state

    settings = device(hand)
    driver = Wrong(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        driver.wrong = True
        await rig.run(0.1)
        assert "not one of 4 actuators" in status(rig).message
        assert rig.loop.snapshot().position.shape == (4,)
