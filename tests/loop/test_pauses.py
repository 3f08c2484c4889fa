"""Pauses of a loop, silences of a device and stops in their midst: no hand moves by itself."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import anyio
import pytest

from rtee.buses.pool import BusPool
from rtee.buses.simulated_time import SimulatedTimeLoop
from rtee.errors import BusTimeout, RteeError
from rtee.hand.config_schema import Behaviour, SafetySettings
from rtee.hand.model import Hand
from rtee.loop.clock import Clock, Tick
from rtee.loop.handloop import HandLoop, bring_to_rest
from rtee.loop.settings import LoopSettings
from rtee.messages.goals import goal_of
from rtee.sample import ActuatorState
from rtee.types import Lifecycle

from .hands import Watcher, device, make_library
from .test_devices import Trouble

pytestmark = pytest.mark.anyio


class Slow(Trouble):
    """A device that takes its time [s], or answers at once."""

    sense_time = stop_time = configure_time = 0.0

    async def configure(self) -> None:
        if self.configure_time:
            await anyio.sleep(self.configure_time)
        await super().configure()

    async def sense(self) -> ActuatorState:
        if self.sense_time:
            await anyio.sleep(self.sense_time)
        return await super().sense()

    async def stop(self) -> None:
        if self.stop_time:
            await anyio.sleep(self.stop_time)
        await super().stop()

    @property
    def positions(self) -> list[float]:
        return [plant.position for plant in self.plants]

    def moved_by_hand(self, share: float) -> list[float]:
        """Put it, limp, at this share of its ranges, as people may; return the positions."""
        for plant in self.plants:
            spec = plant.spec
            plant.position = plant.target = spec.lower + share * (spec.upper - spec.lower)
        return self.positions


class PausingClock(Clock):
    """A clock whose ticks may stop for a while, as they do with their process."""

    last = resumes = 0.0
    missed = 0

    async def drive(self, function: Callable[[Tick], None]) -> None:
        def on_tick(tick: Tick) -> None:
            if tick.stamp < self.resumes:
                self.missed += 1
                return
            tick.missed, self.missed, self.last = self.missed, 0, tick.stamp
            function(tick)

        await super().drive(on_tick)

    async def pause(self, seconds: float, after: float = 0.0) -> None:
        """Stop the ticks; return so long after the next one, or before it [s].

        What arrives during a real pause is also handled before the next tick.
        """
        self.resumes = self.last + seconds - 0.5 / self.rate
        await anyio.sleep_until(self.last + seconds + after)


class Rig:
    """A hand on one slow device, whose loop drives itself in simulated time."""

    def __init__(self, loop: HandLoop, driver: Slow, clock: PausingClock) -> None:
        self.loop, self.driver, self.clock = loop, driver, clock
        self.watcher = Watcher()
        loop.add_observer(self.watcher)

    @property
    def lifecycle(self) -> Lifecycle:
        return self.loop.devices["dummy"].lifecycle

    async def fist(self) -> bool:
        return (await self.loop.execute(goal_of("fist"))).reached

    async def suspend(self, seconds: float, after: float) -> None:
        """Suspend the computer so long after a tick [s]; its clock stands still meanwhile."""
        await anyio.sleep_until(self.clock.last + 1 / self.clock.rate + after)
        loop = asyncio.get_running_loop()
        assert isinstance(loop, SimulatedTimeLoop)
        loop.suspended += seconds


@asynccontextmanager
async def pausing(
    hand: Hand, safety: SafetySettings | None = None, rate: float = 100.0, **options: object
) -> AsyncIterator[Rig]:
    settings = device(hand, rate=rate, **options)  # type: ignore[arg-type]
    driver = Slow(settings.spec, BusPool())
    of_loop = LoopSettings(rate=rate, safety=safety or SafetySettings())
    loop = HandLoop(hand, make_library(hand), of_loop, [(settings, driver)])
    rig = Rig(loop, driver, PausingClock(rate))
    async with loop, anyio.create_task_group() as group:
        group.start_soon(rig.clock.drive, loop.tick)
        await anyio.sleep(0.5)
        yield rig
        group.cancel_scope.cancel()


# --- after a pause ---------------------------------------------------------------------------


@pytest.mark.parametrize("first", ["stop", "answer"])
async def test_a_hand_moved_in_a_pause_stays_there_whatever_comes_before_the_next_tick(
    hand: Hand, first: str
) -> None:
    async with pausing(hand) as rig:
        rig.driver.sense_time = 0.002
        assert await rig.fist()
        if first == "answer":  # of an exchange that began before the pause
            rig.driver.sense_time = 2.995
            await anyio.sleep(1 / rig.clock.rate)
        await rig.clock.pause(3.0, -0.009)
        rig.driver.sense_time = 0.002
        at = rig.driver.moved_by_hand(0.3)
        if first == "stop":
            assert await rig.loop.stop() == [("dummy", True)]
        await anyio.sleep(1.0)
        assert rig.driver.positions == pytest.approx(at)


async def test_the_next_tick_after_a_pause_interrupts_no_stop(hand: Hand) -> None:
    async with pausing(hand) as rig:
        rig.driver.sense_time, rig.driver.stop_time = 0.005, 0.1
        await rig.clock.pause(2.0, -0.005)
        assert await rig.loop.stop() == [("dummy", True)]


async def test_a_pause_loses_no_slow_device(hand: Hand) -> None:
    async with pausing(hand, every=50, deadline=0.5) as rig:
        rig.driver.sense_time = 0.2  # longer than a device has to confirm a stop
        await anyio.sleep(1.0)
        await rig.clock.pause(2.0, 3.0)
        assert rig.loop.devices["dummy"].status().errors == 0
        assert rig.lifecycle is Lifecycle.ACTIVE
        assert await rig.fist()


async def test_a_hand_opens_for_a_client_that_was_lost_in_a_pause(hand: Hand) -> None:
    async with pausing(hand, SafetySettings(on_client_lost=Behaviour.OPEN)) as rig:
        rig.driver.sense_time = 0.004
        assert await rig.fist()
        await rig.clock.pause(5.0, -0.01)
        rig.loop.client_lost("gone")
        await anyio.sleep(3.0)
        assert rig.watcher.results[-1].action == "open"
        assert rig.watcher.results[-1].reached


async def test_a_stop_comes_before_an_opening_that_still_waits_for_its_device(hand: Hand) -> None:
    safety = SafetySettings(on_client_lost=Behaviour.OPEN)
    async with pausing(hand, safety, every=50, deadline=0.5) as rig:
        rig.driver.sense_time, rig.driver.stop_time = 0.004, 0.05  # the stop takes some ticks
        assert await rig.fist()
        await anyio.sleep(2.0)  # its motors lag behind their references
        at = rig.driver.positions
        await rig.clock.pause(5.0, -0.01)
        rig.loop.client_lost("gone")
        await anyio.sleep(0.012)  # the loop runs again, and its device is read each half second
        assert await rig.loop.stop() == [("dummy", True)]
        await anyio.sleep(3.0)
        assert rig.driver.positions == pytest.approx(at, abs=1e-3)


@pytest.mark.parametrize("after", [-0.01, 0.011])
async def test_a_run_that_ends_before_its_device_is_read_holds_no_posture_from_before_a_pause(
    hand: Hand, after: float
) -> None:
    async with pausing(hand) as rig:
        rig.driver.sense_time = 0.004
        assert await rig.fist()
        await rig.clock.pause(5.0, after)
        at = rig.driver.moved_by_hand(0.3)
        assert await bring_to_rest(rig.loop, Behaviour.HOLD, "a test") == [("dummy", True)]
        await anyio.sleep(0.5)
        assert rig.driver.positions == pytest.approx(at)


async def test_a_soft_object_that_yields_in_a_pause_stays_held(hand: Hand) -> None:
    async with pausing(hand, objects={"index_base": 0.5}) as rig:
        assert (await rig.loop.execute(goal_of("Trig", ("index",)))).grasped
        await rig.clock.pause(3.0, -0.01)
        plant = rig.driver.plants[0]
        assert plant.obstacle is not None
        plant.obstacle += 0.016  # more than a hundredth of its range
        await anyio.sleep(0.5)
        assert plant.position == plant.obstacle
        assert plant.effort > 0.1


# --- after the computer was suspended -----------------------------------------------------------


@pytest.mark.parametrize("after", [0.002, 0.008])
async def test_a_hand_moved_while_the_computer_was_suspended_stays_there(
    hand: Hand, after: float
) -> None:
    """After 2 ms, an exchange is under way, whose reference is from before."""
    async with pausing(hand) as rig:
        rig.driver.sense_time = 0.005
        assert await rig.fist()
        await rig.suspend(3.0, after)
        at = rig.driver.moved_by_hand(0.3)
        await anyio.sleep(1.0)
        assert rig.driver.positions == pytest.approx(at)
        [event] = [e for e in rig.watcher.events if e.kind == "loop_paused"]
        assert "did not run for 3.0 s" in event.text
        assert rig.lifecycle is Lifecycle.ACTIVE
        assert await rig.fist()


async def test_a_stop_goes_on_where_the_computer_was_suspended(hand: Hand) -> None:
    async with pausing(hand) as rig:
        rig.driver.stop_time = 0.1
        async with anyio.create_task_group() as group:
            group.start_soon(rig.suspend, 3600.0, 0.025)
            assert await rig.loop.stop() == [("dummy", True)]


async def test_a_goal_from_before_the_computer_was_suspended_has_ended(hand: Hand) -> None:
    async with pausing(hand) as rig:
        rig.loop.submit(goal_of("fist"))
        await anyio.sleep(0.1)
        await rig.suspend(3.0, 0.005)
        at = rig.driver.moved_by_hand(0.3)
        await anyio.sleep(1.0)
        assert rig.driver.positions == pytest.approx(at)
        assert rig.watcher.results[-1].aborted


async def test_a_run_that_ends_as_the_computer_wakes_up_holds_no_posture_from_before(
    hand: Hand,
) -> None:
    async with pausing(hand) as rig:
        rig.driver.sense_time = 0.004
        assert await rig.fist()
        await rig.suspend(3.0, 0.005)
        at = rig.driver.moved_by_hand(0.3)
        assert await bring_to_rest(rig.loop, Behaviour.HOLD, "a test") == [("dummy", True)]
        await anyio.sleep(0.5)
        assert rig.driver.positions == pytest.approx(at)


# --- stops and requests ----------------------------------------------------------------------


async def test_a_hand_moved_in_a_silence_of_its_device_stays_where_a_stop_finds_it(
    hand: Hand,
) -> None:
    async with pausing(hand, rate=200.0) as rig:
        rig.driver.sense_time = 0.002
        assert await rig.fist()
        await anyio.sleep(0.5)
        rig.driver.errors = [BusTimeout("wire", "lost")] * 1000
        await anyio.sleep(0.4)  # not yet a lost device
        at = rig.driver.moved_by_hand(0.75)
        rig.driver.errors = []
        assert await rig.loop.stop() == [("dummy", True)]
        await anyio.sleep(1.0)
        # Before the stop, an exchange may have sent a reference.
        assert rig.driver.positions == pytest.approx(at, abs=1e-3)


async def test_a_stop_gives_up_a_recovery_that_is_still_connecting(hand: Hand) -> None:
    """Its activation might home, and so move after the stop."""
    refused: list[str] = []
    async with pausing(hand) as rig, anyio.create_task_group() as group:

        async def recover() -> None:
            try:
                await rig.loop.recover()
            except RteeError as error:
                refused.append(str(error))

        rig.driver.unplug()
        await anyio.sleep(1.0)
        rig.driver.configure_time = 1.0
        rig.driver.plug()
        group.start_soon(recover)
        await anyio.sleep(0.3)
        await rig.loop.stop()
        await anyio.sleep(3.0)
        assert refused == ["'recover' was interrupted"]
        assert rig.lifecycle is Lifecycle.INACTIVE
        await rig.loop.recover()
        assert await rig.fist(), "only that recovery was given up"


@pytest.mark.parametrize("request_", ["stop", "recover"])
async def test_what_answers_at_once_still_gets_references_long_after_a_request(
    hand: Hand, request_: str
) -> None:
    """The deadline of a request must end with it."""
    async with pausing(hand, rate=20.0) as rig:
        if request_ == "recover":
            await rig.loop.disable()
        await getattr(rig.loop, request_)()
        await anyio.sleep(121.0)  # a recovery has two minutes
        assert await rig.fist()


async def test_an_answer_after_its_deadline_but_before_the_next_tick_counts(hand: Hand) -> None:
    async with pausing(hand, deadline=0.003) as rig:
        rig.driver.sense_time = 0.005
        assert await rig.fist()
        assert rig.loop.devices["dummy"].status().errors == 0


async def test_the_time_of_an_activation_is_no_silence(hand: Hand) -> None:
    async with pausing(hand, rate=1000.0) as rig:
        await rig.loop.devices["dummy"].disable(1.0)
        activate = rig.driver.activate

        async def home() -> None:
            await anyio.sleep(2.0)
            await activate()

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rig.driver, "activate", home)
            await rig.loop.recover()
        rig.driver.errors = [BusTimeout("wire", "lost")] * 3
        await anyio.sleep(0.1)
        assert rig.lifecycle is Lifecycle.ACTIVE
