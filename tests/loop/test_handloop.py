"""A whole hand on the kinematic driver, its time moved by hand."""

from __future__ import annotations

import pytest

from rtee.hand.model import Hand
from rtee.types import EventKind, Goal, Lifecycle, Named

from .hands import NAMES, running

pytestmark = pytest.mark.anyio


async def test_first_reference_is_the_measured_pose(hand: Hand) -> None:
    start = {"index_base": 0.7, "thumb_base": -0.3, "thumb_slide": 0.02}
    async with running(hand, start=start) as rig:
        await rig.run(0.1)
        sent = [plant.target for plant in rig.driver.plants]
        assert sent == [0.7, 0.0, -0.3, 0.02]
        assert [plant.position for plant in rig.driver.plants] == [0.7, 0.0, -0.3, 0.02]
        assert rig.loop.devices["dummy"].lifecycle is Lifecycle.ACTIVE


async def test_a_goal_may_come_before_the_first_tick(hand: Hand) -> None:
    async with running(hand, ticks=0) as rig:
        assert (await rig.do("Trig", "index")).reached


async def test_goal_is_reached(hand: Hand) -> None:
    async with running(hand) as rig:
        result = await rig.do("Trig", "index")
        assert result.reached
        assert not any((result.stalled, result.grasped, result.aborted, result.timed_out))
        assert result.position["index_base"] == pytest.approx(1.5, abs=0.01)
        progress = [f.progress for f in rig.watcher.feedback]
        assert progress == sorted(progress)
        assert progress[0] == 0.0
        assert progress[-1] == 1.0
        assert set(result.position) == set(NAMES)
        assert rig.watcher.goals[0][0] == Goal(Named("Trig", ("index",)), goal_id=result.goal_id)


async def test_a_loop_that_did_not_run_says_so_and_ends_its_goal_without_a_jump(hand: Hand) -> None:
    async with running(hand) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(0.1)
        before = list(rig.loop.controller.reference_position)
        missed = round(5.0 * rig.clock.rate)
        rig.loop.tick(rig.clock.next(missed=missed))
        after = rig.loop.controller.reference_position
        limits = [spec.velocity / rig.clock.rate for spec in hand.actuators]
        moved = [abs(new - old) for new, old in zip(after, before, strict=True)]
        assert all(step <= limit for step, limit in zip(moved, limits, strict=True))
        [event] = [each for each in rig.watcher.events if each.kind == EventKind.LOOP_PAUSED]
        assert "did not run for 5.0 s" in event.text
        [result] = rig.watcher.results
        assert (result.aborted, result.reason) == (True, "the loop did not run for 5.0 s")
        rig.loop.tick(rig.clock.next(missed=round(0.9 * rig.clock.rate)))
        assert rig.watcher.kinds().count(EventKind.LOOP_PAUSED) == 1


@pytest.mark.parametrize("where", ["lower", "upper"])
async def test_a_hand_moved_while_the_loop_did_not_run_gets_no_reference_from_before(
    hand: Hand, where: str
) -> None:
    """Devices may have gone limp meanwhile, and people have moved them."""
    async with running(hand) as rig:
        rig.loop.submit(Goal(Named("fist")))
        await rig.run(0.3)
        moved = [getattr(spec, where) for spec in hand.actuators]
        for plant, position in zip(rig.driver.plants, moved, strict=True):
            plant.position = plant.target = position
        rig.loop.tick(rig.clock.next(missed=round(10.0 * rig.clock.rate)))
        rig.loop.submit(Goal(Named("open")))  # asked for before the devices are read again
        for _ in range(100):
            await rig.run(1 / rig.clock.rate)
            assert [plant.target for plant in rig.driver.plants] == pytest.approx(moved)
        fist, early = rig.watcher.results
        assert (fist.aborted, early.reached) == (True, False)
        assert fist.reason == early.reason
        rig.watcher.results.clear()
        assert (await rig.do("open")).reached


async def test_what_is_held_while_the_loop_did_not_run_stays_held(hand: Hand) -> None:
    async with running(hand, objects={"index_base": 0.5}) as rig:
        assert (await rig.do("Trig", "index")).grasped
        await rig.run(1.0)
        before = list(rig.loop.controller.reference_position)
        rig.loop.tick(rig.clock.next(missed=round(10.0 * rig.clock.rate)))
        await rig.run(0.5)
        assert rig.loop.controller.reference_position == before
        assert rig.loop.controller.reference_position[0] > 0.75 + 0.1, "it still presses"


async def test_a_hand_moved_before_the_first_tick_starts_where_it_is(hand: Hand) -> None:
    """Hands wait for one another's devices to connect and to home, which takes seconds."""
    async with running(hand, ticks=0) as rig:
        for plant, spec in zip(rig.driver.plants, hand.actuators, strict=True):
            plant.position = plant.target = spec.upper
        first = rig.clock.next(missed=3000)
        first.missed = 0  # the clock begins with it
        rig.loop.tick(first)
        for _ in range(20):
            await rig.run(1 / rig.clock.rate)
            upper = [spec.upper for spec in hand.actuators]
            assert [plant.target for plant in rig.driver.plants] == upper
        assert rig.loop.controller.reference_position == upper
