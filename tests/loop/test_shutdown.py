"""Stop, disable, dead clients and the end of the loop: what is configured happens, in time."""

from __future__ import annotations

import math

import anyio
import anyio.lowlevel
import numpy as np
import pytest

from rtee.buses.pool import BusPool
from rtee.commands import Abort, StreamTargets
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.errors import BusTimeout, GoalRejected, RteeError
from rtee.hand.config_schema import Behaviour, SafetySettings
from rtee.hand.model import Hand
from rtee.loop.clock import ManualClock
from rtee.loop.handloop import HandLoop, bring_to_rest
from rtee.loop.observer import Observer
from rtee.loop.settings import LoopSettings
from rtee.sample import ActuatorState, TickRecord
from rtee.types import Goal, Lifecycle, Named, Reference

from .hands import Rig, Watcher, device, make_library, running

pytestmark = pytest.mark.anyio


class Listening(KinematicDriver):
    """Remembers what it was told last."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        self.told: list[str] = []
        self.last: Reference | None = None

    async def move(self, reference: Reference) -> None:
        self.told.append("move")
        self.last = reference
        await super().move(reference)

    async def stop(self) -> None:
        self.told.append("stop")
        await super().stop()

    async def disable(self) -> None:
        self.told.append("disable")
        await super().disable()


def listening(hand: Hand, **options: object) -> tuple[object, Listening]:
    settings = device(hand, **options)  # type: ignore[arg-type]
    return settings, Listening(settings.spec, BusPool())


async def stopped(rig: Rig, reason: str = "a test") -> list[tuple[str, bool]]:
    """Call stop while the loop ticks."""
    answers: list[tuple[str, bool]] = []

    async def stop() -> None:
        answers.extend(await rig.loop.stop(reason))

    async with anyio.create_task_group() as group:
        group.start_soon(stop)
        await rig.run(0.01)
    return answers


class Slow(Listening):
    """Takes a tenth of a second to stop, in which it measures nothing."""

    async def stop(self) -> None:
        for _ in range(100):  # ticks
            for _ in range(12):
                await anyio.lowlevel.checkpoint()
        await super().stop()


@pytest.mark.parametrize("what", ["goal", "jog", "stream"])
async def test_what_comes_during_a_stop_moves_nothing(hand: Hand, what: str) -> None:
    settings = device(hand)
    driver = Slow(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        at = [plant.position for plant in driver.plants]
        async with anyio.create_task_group() as group:
            group.start_soon(rig.loop.stop)
            await rig.run(0.005)
            match what:
                case "goal":
                    rig.loop.submit(Goal(Named("fist")))
                case "jog":
                    rig.loop.jog({"index_base": 1.0})
                case _:
                    rig.loop.streams.begin("s", 50.0)
                    rig.loop.streams.sample(StreamTargets("s", 0.0, {"index_base": 1.0}))
            await rig.run(0.2)
        assert "stop" in rig.watcher.kinds()
        assert [result.cancelled for result in rig.watcher.results] == [True] * (what == "goal")
        await rig.run(0.5)
        assert [plant.position for plant in driver.plants] == at
        moved = np.ptp([record.reference_position for record in rig.watcher.records], axis=0)
        assert not moved.any(), "nor may the reference, which no device follows meanwhile"
        rig.watcher.results.clear()
        assert (await rig.do("Trig", "index")).reached


@pytest.mark.parametrize("request_", ["stop", "disable"])
async def test_what_was_to_be_recovered_is_not_after_a_stop(hand: Hand, request_: str) -> None:
    """A device that is recovered may home, and so moves."""
    settings = device(hand)
    driver = Slow(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        await rig.loop.disable()
        await rig.run(0.05)
        driver.told.clear()
        refused: list[str] = []

        async def recover() -> None:
            try:
                await rig.loop.recover()
            except RteeError as error:
                refused.append(str(error))

        async with anyio.create_task_group() as group:
            group.start_soon(rig.loop.stop)  # the device is busy with it
            await rig.run(0.005)
            group.start_soon(recover)
            await rig.run(0.005)
            group.start_soon(getattr(rig.loop, request_))
            await rig.run(0.5)
        assert driver.told[0] == "stop"
        assert refused == ["'recover' was interrupted"]
        assert next(iter(rig.loop.devices.values())).lifecycle is Lifecycle.INACTIVE


async def test_a_stop_before_the_device_is_connected_leaves_it_inactive(hand: Hand) -> None:
    """It might home at once, and so move after the stop."""

    class Booting(Listening):
        async def configure(self) -> None:
            await ready.wait()
            await super().configure()

    ready = anyio.Event()
    settings = device(hand)
    driver = Booting(settings.spec, BusPool())
    watcher, clock = Watcher(), ManualClock(1000.0)
    driver.now = clock.now
    loop = HandLoop(hand, make_library(hand), LoopSettings(), [(settings, driver)], now=clock.now)
    loop.add_observer(watcher)
    async with loop:
        rig = Rig(loop, clock, watcher)
        await rig.run(0.05)
        assert await loop.stop() == [("dummy", False)]
        ready.set()
        await rig.run(0.2)
        one = loop.devices["dummy"]
        assert one.lifecycle is Lifecycle.INACTIVE
        await loop.recover()
        await rig.run(0.01)
        assert one.active


async def test_stop_is_confirmed_and_the_hand_stays_where_it_is(hand: Hand) -> None:
    settings, driver = listening(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        rig.loop.submit(Goal(Named("fist")))
        await rig.run(0.3)
        assert await stopped(rig) == [("dummy", True)]
        result = rig.watcher.results.pop()
        assert result.cancelled
        assert result.reason == "a test"
        assert "stop" in driver.told
        at = [plant.position for plant in driver.plants]
        await rig.run(0.5)
        assert [plant.position for plant in driver.plants] == pytest.approx(at, abs=1e-9)
        assert rig.loop.snapshot().reference_position == pytest.approx(at, abs=1e-9)
        assert "stop" in rig.watcher.kinds()
        assert (await rig.do("open")).reached


async def test_stop_names_the_devices_that_did_not_confirm(hand: Hand) -> None:
    left, one = listening(hand, name="left", actuators=("index_base", "index_tip"))
    right, other = listening(hand, name="right", actuators=("thumb_base", "thumb_slide"))
    async with running(hand, None, [(left, one), (right, other)]) as rig:
        one.unplug()
        await rig.run(0.05)
        assert await stopped(rig) == [("left", False), ("right", True)]
        event = next(e for e in rig.watcher.events if e.kind == "stop")
        assert "not confirmed by left" in event.text
        assert event.severity == "error"


async def test_a_stop_that_was_swallowed_is_not_confirmed(hand: Hand) -> None:
    """The driver's stop doesn't raise, as it must not; but the device answers no more."""

    class Gone(Listening):
        async def sense(self) -> ActuatorState:
            if "stop" in self.told:
                self.unplug()
            return await super().sense()

    settings = device(hand)
    driver = Gone(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        assert await stopped(rig) == [("dummy", False)]


@pytest.mark.parametrize("behaviour", [Behaviour.STOP, Behaviour.HOLD, Behaviour.DISABLE])
async def test_what_was_not_heard_is_said_again(hand: Hand, behaviour: Behaviour) -> None:
    """A single frame that gets lost at the end must not leave a device without its last word."""

    class Deaf(Listening):
        deaf = False

        def _heard(self) -> None:
            self.deaf = not self.deaf
            if self.deaf:
                raise BusTimeout("dummy", "no answer")

        async def stop(self) -> None:
            self._heard()
            await super().stop()

        async def disable(self) -> None:
            self._heard()
            await super().disable()

        async def move(self, reference: Reference) -> None:
            self._heard()
            await super().move(reference)

    settings = device(hand)
    driver = Deaf(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        await rig.run(0.05)
        driver.told.clear()
        driver.deaf = False  # to what comes next
        assert await bring_to_rest(rig.loop, behaviour, "a test") == [("dummy", True)]
        assert driver.told[0] == {"hold": "move"}.get(behaviour.value, behaviour.value)


@pytest.mark.parametrize("how", ["raises", "hangs"])
async def test_stop_survives_a_driver_that_does_not(hand: Hand, how: str) -> None:
    class Bad(Listening):
        async def stop(self) -> None:
            self.told.append("stop")
            if how == "raises":
                raise RuntimeError("must not, does")
            await anyio.sleep_forever()

    settings = device(hand)
    driver = Bad(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        assert await rig.loop.stop() == [("dummy", False)]
        await rig.run(0.05)
        assert rig.loop.devices["dummy"].lifecycle is Lifecycle.ACTIVE
        assert driver.told[-1] == "move"


async def test_stop_interrupts_an_exchange_that_hangs(hand: Hand) -> None:
    class Slow(Listening):
        hang = False

        async def sense(self) -> ActuatorState:
            if self.hang:
                self.hang = False
                await anyio.sleep_forever()
            return await super().sense()

    settings = device(hand, deadline=1000.0)
    driver = Slow(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        driver.hang = True
        await rig.run(0.05)
        assert await rig.loop.stop() == [("dummy", True)]


@pytest.mark.parametrize("into", [0.001, 0.02, 0.035, 0.045])
async def test_a_slow_device_has_its_time_to_stop(hand: Hand, into: float) -> None:
    """A stop ended with the time that it had left to the exchange before it, and was not sent."""

    class Slow(Listening):
        async def sense(self) -> ActuatorState:
            await anyio.sleep(0.03)
            return await super().sense()

        async def stop(self) -> None:
            await anyio.sleep(0.06)
            await super().stop()

    settings = device(hand, deadline=1.0)
    driver = Slow(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        await rig.run(0.3)
        await anyio.sleep(into)
        assert await rig.loop.stop() == [("dummy", True)]
        assert driver.told.count("stop") == 1


async def test_stop_interrupts_homing(hand: Hand) -> None:
    class Homing(Listening):
        homed = 0

        async def activate(self) -> None:
            self.homed += 1
            if self.homed == 1:
                self.doing = "homing the thumb"
                try:
                    await anyio.sleep_forever()
                finally:
                    self.doing = ""
            await super().activate()

    settings = device(hand)
    driver = Homing(settings.spec, BusPool())
    from rtee.loop.clock import ManualClock
    from rtee.loop.handloop import HandLoop

    from .hands import make_library

    clock = ManualClock(100.0)
    driver.now = clock.now
    loop = HandLoop(hand, make_library(hand), LoopSettings(), [(settings, driver)], now=clock.now)
    watcher = Watcher()
    loop.add_observer(watcher)
    async with loop:
        for _ in range(20):
            await clock.settle()
            loop.tick(clock.next())
        assert loop.devices["dummy"].lifecycle is Lifecycle.INACTIVE
        assert loop.statuses()[0].message == "homing the thumb"
        assert "device 'dummy' is homing the thumb" in [event.text for event in watcher.events]
        with pytest.raises(GoalRejected, match="device 'dummy' is inactive: homing the thumb"):
            loop.submit(Goal(Named("open")))
        assert await loop.stop() == [("dummy", True)]
        assert "homing" not in loop.statuses()[0].message
        for _ in range(50):
            await clock.settle()
            loop.tick(clock.next())
        assert loop.devices["dummy"].lifecycle is Lifecycle.INACTIVE
        assert driver.homed == 1
        async with anyio.create_task_group() as group:
            group.start_soon(loop.recover)
            for _ in range(5):
                await clock.settle()
                loop.tick(clock.next())
        assert loop.devices["dummy"].lifecycle is Lifecycle.ACTIVE


@pytest.mark.parametrize("behaviour", list(Behaviour))
async def test_a_dead_client(hand: Hand, behaviour: Behaviour) -> None:
    settings = LoopSettings(safety=SafetySettings(on_client_lost=behaviour))
    configured, driver = listening(hand)
    async with running(hand, settings, [(configured, driver)]) as rig:
        rig.loop.submit(Goal(Named("fist"), client="a script"))
        await rig.run(0.3)
        rig.loop.client_lost("a script")
        await rig.run(2.0)
        assert "client_lost" in rig.watcher.kinds()
        assert rig.watcher.results[0].cancelled
        at = rig.loop.snapshot().position
        match behaviour:
            case Behaviour.HOLD:
                assert 0.1 < at[0] < 1.4
                assert "stop" not in driver.told
            case Behaviour.STOP:
                assert 0.1 < at[0] < 1.4
                assert "stop" in driver.told
            case Behaviour.OPEN:
                assert at == pytest.approx(hand.rest.tolist(), abs=0.01)
            case Behaviour.DISABLE:
                assert driver.told[-1] == "disable"
                assert rig.loop.devices["dummy"].lifecycle is Lifecycle.INACTIVE


async def test_holding_does_not_drop_what_is_held(hand: Hand) -> None:
    async with running(hand, objects={"index": 0.4}) as rig:
        await rig.do("Trig", "index")
        await rig.run(0.3)
        rig.loop.client_lost("a script")
        await rig.run(1.0)
        assert rig.driver.plants[0].target == 1.5
        assert rig.driver.plants[0].effort > 0.5


async def at_rest(rig: Rig, behaviour: Behaviour, *, ticking: bool = True) -> dict[str, bool]:
    answers: dict[str, bool] = {}

    async def rest() -> None:
        answers.update(await bring_to_rest(rig.loop, behaviour, "the end", ticking=ticking))

    async with anyio.create_task_group() as group:
        group.start_soon(rest)
        while not answers:
            await rig.run(0.01) if ticking else await rig.clock.settle()
    return answers


@pytest.mark.parametrize("behaviour", list(Behaviour))
async def test_the_last_command_is_the_configured_one(hand: Hand, behaviour: Behaviour) -> None:
    settings, driver = listening(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        rig.loop.submit(Goal(Named("fist")))
        await rig.run(0.4)
        assert await at_rest(rig, behaviour) == {"dummy": True}
        last = [plant.target for plant in driver.plants]
        position = [plant.position for plant in driver.plants]
    match behaviour:
        case Behaviour.HOLD:
            assert driver.told[-1] == "move"
            assert last == pytest.approx(position, abs=0.1)
        case Behaviour.STOP:
            assert "stop" in driver.told
        case Behaviour.OPEN:
            assert driver.told[-1] == "move"
            assert last == pytest.approx(hand.rest.tolist(), abs=0.01)
        case Behaviour.DISABLE:
            assert driver.told[-1] == "disable"
    assert all(math.isfinite(x) for x in last)


@pytest.mark.parametrize("behaviour", list(Behaviour))
async def test_without_ticks_the_end_comes_all_the_same(hand: Hand, behaviour: Behaviour) -> None:
    settings, driver = listening(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        rig.loop.submit(Goal(Named("fist")))
        await rig.run(0.4)
        driver.told.clear()
        assert await at_rest(rig, behaviour, ticking=False) == {"dummy": True}
        expected = {
            Behaviour.HOLD: ["move"],
            Behaviour.STOP: ["stop"],
            Behaviour.OPEN: ["stop"],
            Behaviour.DISABLE: ["disable"],
        }[behaviour]
        assert driver.told == expected


async def test_a_hand_that_cannot_open_is_stopped(hand: Hand) -> None:
    settings, driver = listening(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        assert (await rig.do("fist")).reached
        driver.told.clear()
        answers: dict[str, bool] = {}

        async def rest() -> None:
            answers.update(await bring_to_rest(rig.loop, Behaviour.OPEN, "the end"))

        async with anyio.create_task_group() as group:
            group.start_soon(rest)
            await rig.run(0.05)
            rig.loop.controller.apply(Abort("a fault", hand.actuator_names), rig.clock.now())
            while not answers:
                await rig.run(0.01)
        assert rig.watcher.results[-1].aborted
        assert "stop" in driver.told


async def test_the_end_keeps_a_grip(hand: Hand) -> None:
    settings, driver = listening(hand, objects={"index": 0.4})
    async with running(hand, None, [(settings, driver)]) as rig:
        await rig.do("Trig", "index")
        await rig.run(0.3)
        await at_rest(rig, Behaviour.HOLD)
        await rig.run(0.1)
        assert driver.last is not None
        assert driver.last.position[0] == 1.5
        assert driver.last.position[2] == 0.0


@pytest.mark.parametrize("how", ["unplugged", "raises", "hangs"])
@pytest.mark.parametrize("behaviour", list(Behaviour))
async def test_the_stop_path_cannot_throw(hand: Hand, behaviour: Behaviour, how: str) -> None:
    class Bad(Listening):
        bad = False

        async def _misbehave(self) -> None:
            if self.bad and how == "raises":
                raise RuntimeError("a bug")
            if self.bad and how == "hangs":
                await anyio.sleep_forever()

        async def move(self, reference: Reference) -> None:
            await self._misbehave()
            await super().move(reference)

        async def stop(self) -> None:
            await self._misbehave()

        async def disable(self) -> None:
            await self._misbehave()

    settings = device(hand)
    driver = Bad(settings.spec, BusPool())
    async with running(hand, None, [(settings, driver)]) as rig:
        driver.bad = True
        if how == "unplugged":
            driver.unplug()
            await rig.run(0.05)
        assert await at_rest(rig, behaviour, ticking=False) == {"dummy": False}


async def test_the_end_is_shielded_from_cancellation(hand: Hand) -> None:
    settings, driver = listening(hand)
    async with running(hand, None, [(settings, driver)]) as rig:
        with anyio.CancelScope() as scope:
            scope.cancel()
            answers = await bring_to_rest(rig.loop, Behaviour.STOP, "cancelled", ticking=False)
        assert answers == [("dummy", True)]


async def test_an_idle_hand_goes_limp_and_wakes_where_it_is(hand: Hand) -> None:
    settings = LoopSettings(safety=SafetySettings(idle_disable=2.0))
    configured, driver = listening(hand)
    async with running(hand, settings, [(configured, driver)]) as rig:
        await rig.run(1.5)
        assert (await rig.do("Trig", "index", intensity=0.5)).reached
        await rig.run(1.5)
        assert "disable" not in driver.told, "the time counts from the end of the motion"
        await rig.run(1.0)
        assert driver.told[-1] == "disable"
        assert rig.watcher.kinds().count("idle") == 1
        with pytest.raises(GoalRejected, match="recover"):
            rig.loop.submit(Goal(Named("open")))
        await rig.run(3.0)
        assert rig.watcher.kinds().count("idle") == 1
        driver.plants[0].position = 0.9
        async with anyio.create_task_group() as group:
            group.start_soon(rig.loop.recover)
            await rig.run(0.5)
        assert driver.plants[0].position == 0.9
        assert (await rig.do("open")).reached


async def test_a_hand_that_holds_something_is_not_idle(hand: Hand) -> None:
    settings = LoopSettings(safety=SafetySettings(idle_disable=0.5))
    configured, driver = listening(hand, objects={"index": 0.4})
    async with running(hand, settings, [(configured, driver)]) as rig:
        assert (await rig.do("Trig", "index")).grasped
        await rig.run(5.0)
        assert "disable" not in driver.told
        driver.remove_object()
        await rig.run(2.0)
        assert driver.told[-1] == "disable"


async def test_a_goal_that_runs_at_the_end_gets_its_result(hand: Hand) -> None:
    async with running(hand) as rig:
        rig.loop.submit(Goal(Named("fist")))
        await rig.run(0.2)
    assert rig.watcher.results[0].cancelled
    assert rig.watcher.results[0].reason == "the loop ended"


async def test_an_observer_that_fails_is_dropped_and_the_hand_goes_on(hand: Hand) -> None:
    class Failing(Observer):
        ticks = 0

        def on_tick(self, record: TickRecord) -> None:
            self.ticks += 1
            if self.ticks == 10:
                raise ValueError("a bug")

    async with running(hand) as rig:
        failing = Failing()
        rig.loop.add_observer(failing)
        assert (await rig.do("fist")).reached
        assert failing.ticks == 10
        assert "observer_failed" in rig.watcher.kinds()


async def test_a_goal_taken_after_the_last_tick_has_its_result_too(hand: Hand) -> None:
    async with running(hand) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",)), goal_id="late"))
        rig.loop.end()
        assert [goal.goal_id for goal, _ in rig.watcher.goals] == ["late"]
        (result,) = rig.watcher.results
        assert (result.goal_id, result.cancelled, result.reason) == ("late", True, "the loop ended")
        with pytest.raises(GoalRejected, match="ended"):
            rig.loop.submit(Goal(Named("Trig", ("index",))))
    assert len(rig.watcher.results) == 1
