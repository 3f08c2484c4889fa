"""Goals on a running hand: what is refused, how they end, and that nothing is ever forgotten."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import pytest

from rtee.errors import ActionError, GoalRejected, UnknownAction
from rtee.hand.config_schema import ProfileKind, ProfileSettings
from rtee.hand.model import Hand
from rtee.loop.planning import make_plan
from rtee.loop.settings import LoopSettings
from rtee.messages.goals import goal_of
from rtee.types import Goal, Intensity, Named, Result, Stage

from .hands import NAMES, Rig, make_library, running

pytestmark = pytest.mark.anyio
NAN = float("nan")


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ({"intensity": 1.2}, "intensity must be 0 to 1, not 1.2"),
        ({"intensity": NAN}, "intensity must be 0 to 1, not nan"),
        ({"intensity": -0.1}, "intensity must be 0 to 1"),
        ({"speed": 0.0}, "speed must be above 0"),
        ({"speed": NAN}, "speed must be above 0"),
        ({"tolerance": NAN}, "tolerance must be above 0"),
        ({"tolerance": math.inf}, "tolerance must be above 0"),
        ({"timeout": 0.0}, "timeout must be above 0"),
        ({"timeout": NAN}, "timeout must be above 0"),
        ({"effort": {"indx_base": 1.0}}, "did you mean 'index_base'"),
        ({"effort": {"index_base": 5.0}}, "at most 2, not 5"),
        ({"effort": {"index_base": NAN}}, "at most 2, not nan"),
        ({"stage": Stage.PRE_GRASP}, "has no stages.* leave 'pre_grasp' out"),
        ({"stage": Stage.GRASP}, "'Trig' has no stages: only pinches .* leave 'grasp' out"),
        ({"action": "drill", "elements": (), "stage": Stage.GRASP}, "has no stages"),
        ({"action": "open", "elements": (), "stage": Stage.GRASP}, "has no stages"),
        ({"action": "drill", "elements": (), "intensity": 0.5}, "always runs at intensity 1"),
        ({"action": ""}, "the goal names no action: only"),
    ],
)
async def test_bad_goals_are_refused_with_a_reason(
    hand: Hand, asked: dict[str, Any], reason: str
) -> None:
    async with running(hand) as rig:
        with pytest.raises(GoalRejected, match=reason):
            rig.loop.submit(goal_of(**{"action": "Trig", "elements": ("index",), **asked}))
        await rig.run(0.02)
        assert not rig.watcher.goals
        assert rig.driver.plants[0].target == 0.0


async def test_unknown_actions_and_elements_are_refused(hand: Hand) -> None:
    async with running(hand) as rig:
        with pytest.raises(UnknownAction, match="did you mean"):
            rig.loop.submit(Goal(Named("Trigg", ("index",))))
        with pytest.raises(ActionError):
            rig.loop.submit(Goal(Named("Trig", ("index", "thumb"))))
        with pytest.raises(ActionError):
            rig.loop.submit(Goal(Named("Trig", ("index",), kind="timed")))


async def test_intensity_scales_from_rest_and_not_from_zero(hand: Hand) -> None:
    async with running(hand) as rig:
        result = await rig.do("Trig", "thumb", intensity=0.5)
        assert result.reached
        rest = hand.actuator("thumb_base").rest
        assert result.position["thumb_base"] == pytest.approx(rest + 0.5 * (1.0 - rest), abs=0.01)


async def test_intensity_zero_is_the_rest_posture_of_what_is_involved(hand: Hand) -> None:
    async with running(hand, start={"index_base": 0.9, "thumb_base": 0.4}) as rig:
        result = await rig.do("Trig", "index", intensity=0.0)
        assert result.reached
        assert result.position["index_base"] == pytest.approx(0.0, abs=0.01)
        assert result.position["thumb_base"] == pytest.approx(0.4)


async def test_names_are_found_however_they_are_spelled(hand: Hand) -> None:
    async with running(hand) as rig:
        assert (await rig.do("pinch_tight", "thumb", "index")).action == "PinchTight"


async def test_every_hand_opens(hand: Hand) -> None:
    async with running(hand, start={"index_base": 0.9, "thumb_slide": 0.03}) as rig:
        result = await rig.do("open")
        assert result.reached
        where = [result.position[name] for name in NAMES]
        assert where == pytest.approx(hand.rest.tolist(), abs=0.01)


async def test_a_new_goal_replaces_the_running_one_smoothly(hand: Hand) -> None:
    async with running(hand) as rig:
        first = Goal(Named("Trig", ("index",)))
        rig.loop.submit(first)
        await rig.run(0.25)
        second = Goal(Named("Trig", ("index",)), Intensity(0.1))
        rig.loop.submit(second)
        replaced = await rig.result()
        assert (replaced.goal_id, replaced.preempted) == (first.goal_id, True)
        assert not replaced.reached
        result = await rig.result()
        assert (result.goal_id, result.reached) == (second.goal_id, True)
        path = np.array([record.reference_position for record in rig.watcher.records])
        acceleration = np.diff(path, n=2, axis=0) * rig.clock.rate**2
        limits = np.array([actuator.acceleration for actuator in hand.actuators])
        assert (np.abs(acceleration) <= limits * (1 + 1e-4) + 1e-5).all()
        jerk = np.diff(acceleration, axis=0) * rig.clock.rate
        limits = np.array([actuator.jerk for actuator in hand.actuators])
        # Between two ticks acceleration follows the jerk limit, sampled twice: at most double.
        assert (np.abs(jerk) <= 2 * limits).all()


async def test_what_the_new_goal_leaves_out_stops(hand: Hand) -> None:
    async with running(hand) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(0.3)
        await rig.do("Trig", "thumb", speed=0.5)
        await rig.result()
        stopped = rig.loop.snapshot().reference_position[0]
        assert 0.1 < stopped < 1.4
        await rig.run(0.5)
        assert rig.loop.snapshot().reference_position[0] == stopped


async def test_goals_between_two_ticks_all_get_a_result(hand: Hand) -> None:
    async with running(hand) as rig:
        goals = [Goal(Named("Trig", ("index",)), Intensity(k / 10)) for k in range(10)]
        for goal in goals:
            rig.loop.submit(goal)
        await rig.run(0.01)
        assert [g.goal_id for g, _ in rig.watcher.goals] == [g.goal_id for g in goals]
        ended = [r.goal_id for r in rig.watcher.results]
        assert ended == [g.goal_id for g in goals[:-1]]
        assert all(r.preempted for r in rig.watcher.results)


async def test_cancel_holds_the_measured_posture(hand: Hand) -> None:
    async with running(hand) as rig:
        goal = Goal(Named("Trig", ("index",)))
        rig.loop.submit(goal)
        await rig.run(0.25)
        rig.loop.cancel(goal.goal_id)
        before = rig.loop.snapshot()
        rig.loop.tick(rig.clock.next())
        result = rig.watcher.results.pop()
        assert result.cancelled
        assert not result.reached
        await rig.run(0.6)
        after = rig.loop.snapshot()
        assert after.position == pytest.approx(after.reference_position, abs=0.005)
        assert after.reference_position[0] < before.reference_position[0] + 0.3
        assert (after.reference_velocity == 0.0).all()


async def test_cancel_of_another_or_a_finished_goal_does_nothing(hand: Hand) -> None:
    async with running(hand) as rig:
        goal = Goal(Named("Trig", ("index",)))
        rig.loop.submit(goal)
        rig.loop.cancel("somebody else's")
        result = await rig.result()
        assert result.reached
        rig.loop.cancel(goal.goal_id)
        await rig.run(0.05)
        assert not rig.watcher.results


async def test_a_goal_that_takes_too_long_times_out(hand: Hand) -> None:
    async with running(hand) as rig:
        result = await rig.do("Trig", "index", speed=0.02, timeout=0.2)
        assert result.timed_out
        assert not result.reached
        assert result.duration == pytest.approx(0.2, abs=0.01)
        stopped = rig.loop.snapshot().reference_position[0]
        await rig.run(0.5)
        assert rig.loop.snapshot().reference_position[0] < stopped + 0.02


async def test_the_slowest_goal_has_a_timeout_and_a_velocity(hand: Hand) -> None:
    goal = goal_of("slide", speed=math.ulp(0.0), intensity=0.0)
    assert math.isfinite(make_plan(goal, hand, make_library(hand), LoopSettings()).timeout)
    async with running(hand) as rig:
        rig.loop.submit(goal_of("slide", speed=math.ulp(0.0)))
        await rig.run(0.05)
        assert min(rig.loop.controller.max_velocity) > 0.0


async def test_the_default_timeout_is_the_hands(hand: Hand) -> None:
    settings = LoopSettings(goal_timeout=0.1)
    async with running(hand, settings) as rig:
        assert (await rig.do("Trig", "index")).timed_out


async def test_speed_scales_the_velocity_limits(hand: Hand) -> None:
    async with running(hand) as rig:
        await rig.do("Trig", "index", speed=0.2)
        fastest = max(abs(r.reference_velocity[0]) for r in rig.watcher.records)
        assert 0.5 < fastest <= 0.2 * 3.0 * (1 + 1e-6)
        assert rig.driver.plants[0].max_velocity == pytest.approx(0.6)


async def test_metres_are_not_mixed_with_radians(hand: Hand) -> None:
    """0.01 would be a quarter of the slide's range: it is reached only near its target."""
    async with running(hand) as rig:
        result = await rig.do("fist", tolerance=0.01)
        assert result.reached
        assert abs(result.position["thumb_slide"] - 0.04) <= 0.05 * 0.04


async def test_a_tighter_tolerance_takes_longer(hand: Hand) -> None:
    filtered = LoopSettings(profile=ProfileSettings(ProfileKind.FILTER))
    async with running(hand, filtered) as rig:
        loose = await rig.do("Trig", "index", tolerance=0.1)
        await rig.do("open")
        tight = await rig.do("Trig", "index", tolerance=0.001)
        assert loose.reached
        assert tight.reached
        assert loose.error <= 0.1
        assert tight.error <= 0.001
        assert loose.duration < tight.duration


@pytest.mark.parametrize("kind", list(ProfileKind))
async def test_every_profile_reaches(hand: Hand, kind: ProfileKind) -> None:
    if kind is ProfileKind.JERK_LIMITED:
        pytest.importorskip("ruckig")
    async with running(hand, LoopSettings(rate=200.0, profile=ProfileSettings(kind))) as rig:
        result = await rig.do("fist")
        assert result.reached
        assert result.error <= 0.01


async def test_pre_grasp_stops_before_contact_and_grasp_goes_on(hand: Hand) -> None:
    async with running(hand) as rig:
        before = await rig.do("PinchTight", "index", "thumb", stage=Stage.PRE_GRASP)
        assert before.reached
        assert before.position["index_base"] == pytest.approx(0.75, abs=0.01)
        after = await rig.do("PinchTight", "index", "thumb", stage=Stage.GRASP)
        assert after.reached
        assert after.position["index_base"] == pytest.approx(1.0, abs=0.01)


async def test_pre_grasp_keeps_a_smaller_intensity(hand: Hand) -> None:
    async with running(hand) as rig:
        goal = {"stage": Stage.PRE_GRASP, "intensity": 0.3}
        result = await rig.do("PinchTight", "index", "thumb", **goal)
        assert result.position["index_base"] == pytest.approx(0.3, abs=0.01)


async def test_timed_actions_keep_their_margins_and_tell_each_step(hand: Hand) -> None:
    async with running(hand) as rig:
        result = await rig.do("drill")
        assert result.reached
        feedback = rig.watcher.feedback
        assert list(feedback[0].inner_progress) == ["close", "press", "let_go"]
        order = list(dict.fromkeys(f.inner for f in feedback))
        assert order == ["close", "press", "let_go"]
        assert feedback[-1].inner_progress == {"close": 1.0, "press": 1.0, "let_go": 1.0}
        overall = [f.progress for f in feedback]
        assert overall == sorted(overall)
        started = rig.watcher.goals[0][1]
        moved = [r for r in rig.watcher.records if r.reference_position[0] != 0.0]
        assert moved[0].stamp - started == pytest.approx(0.1, abs=0.003)
        thumb = [r.stamp for r in rig.watcher.records if r.reference_velocity[2] < 0]
        closed = next(f.stamp for f in feedback if f.inner == "let_go")
        assert thumb[0] - closed == pytest.approx(0.3, abs=0.003)


async def test_references_are_sent_and_goals_seen_while_a_timed_action_waits(hand: Hand) -> None:
    async with running(hand) as rig:
        rig.loop.submit(Goal(Named("drill")))
        while not rig.watcher.feedback or rig.watcher.feedback[-1].inner != "press":
            await rig.run(0.01)
        while rig.watcher.feedback[-1].inner != "let_go":
            await rig.run(0.01)
        sent = rig.loop.devices["dummy"].status().exchanges
        await rig.run(0.1)
        assert rig.loop.devices["dummy"].status().exchanges >= sent + 99
        rig.loop.submit(Goal(Named("open")))
        rig.loop.tick(rig.clock.next())
        assert rig.watcher.results.pop().preempted
        assert (await rig.result()).reached


async def test_cancel_in_a_wait_is_immediate(hand: Hand) -> None:
    async with running(hand) as rig:
        goal = Goal(Named("drill"))
        rig.loop.submit(goal)
        await rig.run(0.05)
        rig.loop.cancel(goal.goal_id)
        rig.loop.tick(rig.clock.next())
        assert rig.watcher.results.pop().cancelled
        await rig.run(0.3)
        assert rig.loop.snapshot().reference_position[0] == 0.0


async def test_progress_never_falls_and_stays_between_zero_and_one(hand: Hand) -> None:
    async with running(hand, start={"index_base": 1.2}) as rig:
        rig.loop.submit(Goal(Named("fist")))
        await rig.run(0.2)
        for name in ("open", "fist", "drill", "open"):
            rig.loop.submit(Goal(Named(name)))
            await rig.run(0.17)
        await rig.result()
        await rig.run(1.0)
        by_goal: dict[str, list[float]] = {}
        for feedback in rig.watcher.feedback:
            by_goal.setdefault(feedback.goal_id, []).append(feedback.progress)
        assert len(by_goal) == 5
        for progress in by_goal.values():
            assert progress == sorted(progress)
            assert 0.0 <= progress[0] <= progress[-1] <= 1.0


async def test_feedback_comes_at_its_rate(hand: Hand) -> None:
    async with running(hand, LoopSettings(feedback_rate=20.0)) as rig:
        result = await rig.do("Trig", "index")
        most = 20 * result.duration + 3
        assert 0.5 * most < len(rig.watcher.feedback) <= most


async def test_any_sequence_of_calls_gives_every_goal_one_result(hand: Hand) -> None:
    """Cancel, pre-empt, jog, hold and stop at random times."""
    rng = random.Random(5)
    async with running(hand, LoopSettings(rate=200.0)) as rig:
        sent: list[str] = []
        running_goal = ""
        for _ in range(120):
            match rng.randrange(6):
                case 0 | 1 | 2:
                    action = rng.choice(["fist", "open", "drill", "slide"])
                    goal = Goal(Named(action), speed=rng.uniform(0.3, 1.0))
                    rig.loop.submit(goal)
                    sent.append(running_goal := goal.goal_id)
                case 3:
                    rig.loop.cancel(running_goal)
                case 4:
                    spec = hand.actuator("index_base")
                    rig.loop.jog(
                        {"index_base": rng.uniform(spec.lower, spec.upper)}, rng.uniform(0.1, 3)
                    )
                case 5:
                    rig.loop.hold("a test")
            await rig.run(rng.uniform(0.005, 0.3))
        await rig.run(6.0)
        assert [r.goal_id for r in rig.watcher.results] == sent
        assert {_end(r) for r in rig.watcher.results} >= {"reached", "preempted", "cancelled"}
        _check_limits(hand, rig)


def _end(result: Result) -> str:
    names = ("aborted", "cancelled", "preempted", "timed_out", "reached", "stalled")
    return next(name for name in names if getattr(result, name))


def _check_limits(hand: Hand, rig: Rig) -> None:
    path = np.array([record.reference_position for record in rig.watcher.records])
    rate = rig.clock.rate
    velocity = np.diff(path, axis=0) * rate
    acceleration = np.diff(velocity, axis=0) * rate
    assert (path >= hand.lower).all()
    assert (path <= hand.upper).all()
    for i, actuator in enumerate(hand.actuators):
        assert np.abs(velocity[:, i]).max() <= actuator.velocity * (1 + 1e-5)
        assert np.abs(acceleration[:, i]).max() <= actuator.acceleration * (1 + 1e-4)


async def test_jog_moves_what_it_names_and_nothing_else(hand: Hand) -> None:
    async with running(hand) as rig:
        rig.loop.jog({"index_base": 0.5}, 0.4)
        await rig.run(0.2)
        rig.loop.jog({"thumb_base": 1.0})
        await rig.run(2.0)
        sent = rig.loop.snapshot().reference_position
        assert sent.tolist() == [0.5, 0.0, 1.0, 0.0]
        assert max(abs(r.reference_velocity[0]) for r in rig.watcher.records) <= 0.4 * (1 + 1e-6)


@pytest.mark.parametrize(
    ("positions", "velocity", "reason"),
    [
        ({"index": 0.5}, None, "unknown actuator 'index'"),
        ({"index_base": NAN}, None, "must be a number"),
        (
            {"thumb_base": 45.0},
            None,
            "45 of 'thumb_base' is outside its limits .* to 1 rad",
        ),
        ({"index_base": 0.1}, NAN, "velocity must be above 0"),
        ({"index_base": 0.1}, 0.0, "velocity must be above 0"),
    ],
)
async def test_bad_jogs_are_refused(
    hand: Hand, positions: dict[str, float], velocity: float | None, reason: str
) -> None:
    async with running(hand) as rig:
        with pytest.raises(GoalRejected, match=reason):
            rig.loop.jog(positions, velocity)


async def test_execute_returns_the_result_and_cancels_when_cancelled(hand: Hand) -> None:
    import anyio

    async with running(hand) as rig, anyio.create_task_group() as group:
        results: list[Result] = []

        async def do(action: str) -> None:
            results.append(await rig.loop.execute(Goal(Named(action))))

        group.start_soon(do, "fist")
        await rig.run(2.0)
        assert results[0].reached
        with anyio.CancelScope() as scope:

            async def give_up() -> None:
                await rig.run(0.1)
                scope.cancel()
                await rig.run(0.01)

            group.start_soon(give_up)
            await rig.loop.execute(Goal(Named("open")))
        await rig.run(0.01)
        assert rig.watcher.results[-1].cancelled


async def test_the_progress_of_a_short_way_of_a_slide_is_its_own(hand: Hand) -> None:
    async with running(hand, LoopSettings(rate=100)) as rig:
        rig.loop.submit(
            Goal(Named("slide"), Intensity(0.2))
        )  # 8 mm, less than 0.01 rad as a number
        result = await rig.result()
        assert result.reached
        progress = [feedback.progress for feedback in rig.watcher.feedback]
        assert progress == sorted(progress)
        assert len([share for share in progress if 0.01 < share < 0.9]) >= 2
