"""Fingers that feel: contacts stop them, enough of them squeeze, and slips are answered."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from loop.hands import make_hand, make_library
from rtee.commands import SetActive
from rtee.errors import GoalRejected
from rtee.hand.config_schema import GraspSettings
from rtee.hand.model import Hand
from rtee.loop.controller import Controller
from rtee.loop.free_motion import FreeMotion
from rtee.loop.grip import ELSEWHERE, Grip
from rtee.loop.measured import Measured
from rtee.loop.planning import make_plan
from rtee.loop.reflexes import _LegReactions
from rtee.loop.settings import LoopSettings
from rtee.loop.tip_levers import TipLevers
from rtee.messages import GOAL, RESULT
from rtee.messages.goals import goal_of
from rtee.types import (
    Event,
    FirstContact,
    Goal,
    Named,
    OnContact,
    Result,
)

INDEX, THUMB = 0, 2
NAN = math.nan
STIFFNESS = 20.0
FRICTION = 0.05


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    return make_hand(tmp_path_factory.mktemp("small"))


class World:
    """The small hand with walls in the way of its actuators, and springs for motors."""

    def __init__(
        self,
        hand: Hand,
        walls: dict[int, float],
        *,
        tips: bool = False,
        every: int = 1,
        efforts: bool = True,
        friction: float = FRICTION,
        **grasp: object,
    ) -> None:
        self.hand, self.walls, self.tips, self.every = hand, walls, tips, every
        self.ticks, self.efforts, self.friction = 0, efforts, friction
        self.settings = LoopSettings(rate=500.0, grasp=GraspSettings(**grasp))  # type: ignore[arg-type]
        self.controller = Controller(hand, self.settings)
        self.position = hand.rest.tolist()
        self.asked = hand.rest.tolist()
        self.time = 0.0
        self.events: list[Event] = []
        self.results: list[Result] = []
        self.controller.apply(SetActive(dict.fromkeys(hand.actuator_names, True)), 0.0)
        self.tick()

    def tick(self) -> None:
        self.time += self.settings.period
        self.ticks += 1
        fresh = self.ticks % self.every == 0
        controller = self.controller
        effort, touch = [], [0.0, 0.0]
        for i, reference in enumerate(controller.reference_position):
            wall = self.walls.get(i, math.inf)
            if fresh:
                # What a slow device measures, it was asked for an exchange before.
                there = reference if self.every == 1 else self.asked[i]
                self.position[i] = min(there, wall)
                self.asked[i] = reference
            speed = controller.reference_velocity[i]
            push = STIFFNESS * (reference - self.position[i])
            limit = controller.reference_effort[i]
            effort.append(min(push + math.copysign(self.friction, speed) * (speed != 0.0), limit))
            if self.position[i] >= wall:
                touch[0 if i < THUMB else 1] = max(push, 0.2)
        n = len(effort)
        if not self.efforts:
            effort = [NAN] * n
        measured = Measured(self.position, effort, [NAN] * n, [fresh] * n, [-1] * n)
        if self.tips:
            measured.touch = touch
        controller.step(self.time, measured)
        for item in controller.outbox.items:
            if isinstance(item, Event):
                self.events.append(item)
            elif isinstance(item, Result):
                self.results.append(item)
        controller.outbox.items.clear()

    def accept(self, **goal: object) -> None:
        made = goal_of("PinchTight", ("index", "thumb"), **goal)  # type: ignore[arg-type]
        plan = make_plan(made, self.hand, make_library(self.hand), self.settings)
        self.controller.accept(plan, self.time)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / self.settings.period)):
            self.tick()

    def until_result(self) -> Result:
        for _ in range(10_000):
            self.tick()
            if self.results:
                return self.results.pop()
        raise AssertionError("the goal never ended")

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


def every(word: OnContact) -> dict[str, OnContact]:
    return {"": word}


@pytest.mark.parametrize("tips", [True, False])
def test_a_finger_that_touches_stops_and_the_other_goes_on(small: Hand, tips: bool) -> None:
    world = World(small, {INDEX: 0.6}, tips=tips)
    world.accept(on_contact=every(OnContact.STOP), speed=0.3)
    reference = world.controller.reference_position
    while world.position[INDEX] < 0.6:
        world.tick()
    ticks = 0
    while "contact" not in world.kinds():
        world.tick()
        ticks += 1
    # With sensors, the evidence is there at once; efforts have to rise above the threshold first.
    assert ticks <= (2 if tips else 40)
    assert reference[INDEX] == pytest.approx(0.6, abs=1e-3)
    assert reference[THUMB] < 0.8
    result = world.until_result()
    assert result.touched == ("index",)
    assert result.stalled
    assert not result.grasped
    assert reference[INDEX] == pytest.approx(0.6, abs=1e-3)
    assert reference[THUMB] == pytest.approx(0.8, abs=0.01)


def test_without_a_word_fingers_press_on_until_they_stall(small: Hand) -> None:
    world = World(small, {INDEX: 0.6}, tips=True)
    world.accept(speed=0.3)
    result = world.until_result()
    assert result.grasped
    assert result.touched == ()
    assert world.kinds() == []
    assert world.controller.reference_position[INDEX] == pytest.approx(1.0, abs=0.02)


def test_each_finger_may_have_a_word_of_its_own(small: Hand) -> None:
    world = World(small, {INDEX: 0.6, THUMB: 0.5}, tips=True)
    world.accept(on_contact={"index": OnContact.HOLD, "thumb": OnContact.STOP}, speed=0.3)
    result = world.until_result()
    assert set(result.touched) == {"index", "thumb"}
    assert result.grasped_fingers == ("index",)
    efforts = world.controller.reference_effort
    assert efforts[INDEX] < 0.2 * small.actuators[INDEX].effort
    assert efforts[THUMB] == small.actuators[THUMB].effort


def test_the_word_of_hand_yaml_counts_unless_a_goal_has_one(small: Hand) -> None:
    world = World(small, {INDEX: 0.6}, tips=True, on_contact=OnContact.STOP)
    world.accept(speed=0.3)
    assert world.until_result().touched == ("index",)
    goal = Goal(Named("open"))
    plan = make_plan(goal, small, make_library(small), world.settings)
    world.controller.accept(plan, world.time)
    result = world.until_result()
    assert result.reached, "hands that open touch nothing on purpose"
    assert result.touched == ()
    world.accept(on_contact=every(OnContact.HOLD), speed=0.3)
    assert world.until_result().grasped_fingers == ("index",)


def test_a_squeeze_waits_for_the_other_finger_then_builds_up_together(small: Hand) -> None:
    world = World(small, {INDEX: 0.3, THUMB: 0.7}, tips=True)
    world.accept(on_contact=every(OnContact.SQUEEZE), speed=0.3)
    efforts, limits = world.controller.reference_effort, [a.effort for a in small.actuators]
    while world.kinds().count("contact") < 2:
        if "contact" in world.kinds():
            assert efforts[INDEX] < 0.2 * limits[INDEX]
            assert world.controller.reference_position[INDEX] == pytest.approx(0.3, abs=1e-3)
        world.tick()
        assert not world.results
    shares = []
    while efforts[THUMB] < limits[THUMB]:
        world.tick()
        shares.append(efforts[INDEX] / limits[INDEX])
    assert shares == sorted(shares)
    assert len(shares) == pytest.approx(0.3 / world.settings.period, abs=2)
    result = world.until_result()
    assert set(result.grasped_fingers) == {"index", "thumb"}


def test_a_squeeze_of_a_slow_device_that_lags_from_the_first_look_on_has_efforts(
    small: Hand,
) -> None:
    """At the first measurement after the goal, the reference is far ahead already."""
    world = World(small, {INDEX: 0.3, THUMB: 0.7}, every=40, efforts=False)
    world.accept(on_contact=every(OnContact.SQUEEZE), speed=1.0)
    for _ in range(400):
        world.tick()
        assert all(math.isfinite(effort) for effort in world.controller.reference_effort)


def test_a_squeeze_that_meets_no_other_finger_holds_lightly_and_grasps_nothing(
    small: Hand,
) -> None:
    world = World(small, {INDEX: 0.3}, tips=True)
    world.accept(on_contact=every(OnContact.SQUEEZE), speed=0.5)
    result = world.until_result()
    assert result.touched == ("index",)
    assert result.stalled
    assert not result.grasped


def held(small: Hand, **goal: object) -> World:
    world = World(small, {INDEX: 0.3, THUMB: 0.7}, tips=True, grip_after=0.5, grip_effort=0.2)
    world.accept(on_contact=every(OnContact.SQUEEZE), speed=0.5, **goal)
    assert world.until_result().grasped
    return world


def test_holding_settles_to_the_least_effort_of_hand_yaml(small: Hand) -> None:
    world = held(small)
    world.run(15.0)
    for i in (INDEX, THUMB):
        limit = small.actuators[i].effort
        assert world.controller.reference_effort[i] == pytest.approx(0.2 * limit)
    assert "slip" not in world.kinds()


def test_what_creeps_is_held_harder_and_not_eased_again(small: Hand) -> None:
    world = held(small)
    world.run(8.0)
    before = world.controller.reference_effort[INDEX]
    world.walls[INDEX] += 0.006
    world.run(0.05)
    after = world.controller.reference_effort[INDEX]
    assert after == pytest.approx(before + 0.25 * small.actuators[INDEX].effort)
    assert world.kinds().count("slip") == 1
    world.run(5.0)
    assert world.controller.reference_effort[INDEX] == pytest.approx(after)


def test_effort_never_rises_above_that_of_the_goal(small: Hand) -> None:
    world = held(small, effort={"index_base": 1.0})
    for _ in range(20):
        world.walls[INDEX] += 0.006
        world.run(0.3)
        assert world.controller.reference_effort[INDEX] <= 1.0
    assert 0 < world.kinds().count("slip") < 20


def test_a_touch_stops_all_fingers_at_the_first_contact(small: Hand) -> None:
    world = World(small, {THUMB: 0.2}, tips=True)
    plan = make_plan(
        Goal(Named("PinchTight", ("index", "thumb")), FirstContact()),
        small,
        make_library(small),
        world.settings,
    )
    assert plan.speed == 0.05
    world.controller.accept(plan, world.time)
    result = world.until_result()
    assert result.touched == ("thumb",)
    assert not result.grasped
    where = world.position[INDEX]
    world.run(0.5)
    assert world.position[INDEX] == pytest.approx(where, abs=1e-6)
    assert where < 0.9


@pytest.mark.samples("0.06-1", "0.4-5", "1.2-20")
@pytest.mark.parametrize("ticks", [1, 5, 20])
@pytest.mark.parametrize("friction", [0.06, 0.4, 1.2])
def test_an_effort_at_its_limit_is_not_that_of_free_motion(
    tmp_path: Path, friction: float, ticks: int
) -> None:
    """A first touch begins with less effort than friction takes: more of it is no contact."""
    hand, lever = make_hand(tmp_path, length=0.04), 0.08
    goal = Goal(Named("PinchTight", ("index", "thumb")), FirstContact())
    for wall in (math.inf, 0.6):
        world = World(hand, {INDEX: wall}, friction=friction, every=ticks)
        plan = make_plan(goal, hand, make_library(hand), world.settings)
        world.controller.accept(plan, world.time)
        pushes, speed = [0.0], 0.0
        while not world.results:
            world.tick()
            pushes.append(STIFFNESS * (world.asked[INDEX] - world.position[INDEX]))
            speed = max(speed, world.controller.reference_velocity[INDEX])
        result = world.results.pop()
        if math.isinf(wall):
            assert (result.reached, result.touched) == (True, ()), result.position
            continue
        assert result.touched == ("index",)
        # The push grows by this much in an exchange; the device is one behind, and two show it.
        growth = STIFFNESS * speed * ticks * world.settings.period
        assert world.position[INDEX] == wall
        assert max(pushes) <= world.settings.grasp.contact_force * lever + 3.0 * growth


def test_a_touch_may_take_as_long_as_its_slow_way(small: Hand) -> None:
    world = World(small, {THUMB: 0.75}, tips=True)
    goal = Goal(Named("PinchTight", ("index", "thumb")), FirstContact())
    settings = structs.replace(world.settings, goal_timeout=2.0)
    # At a twentieth of 2 rad/s, the thumb takes 7.5 s to its wall.
    world.controller.accept(make_plan(goal, small, make_library(small), settings), world.time)
    result = world.until_result()
    assert not result.timed_out
    assert result.touched == ("thumb",)
    given = make_plan(replace(goal, timeout=3.0), small, make_library(small), settings)
    assert given.timeout == 3.0, "a timeout that was asked for stands"


def test_a_touch_by_a_timed_action_has_time_for_each_way(small: Hand) -> None:
    settings = LoopSettings(goal_timeout=2.0)
    plan = make_plan(Goal(Named("drill"), FirstContact()), small, make_library(small), settings)
    ways = 1.5 / 3.0 + 1.0 / 2.0 + 1.0 / 2.0  # [rad] / [rad/s], the longest of each leg
    assert plan.timeout == pytest.approx(3 * 2.0 + 0.7 + ways * (1.0 / 0.05 - 1.0))


def test_a_slow_goal_may_take_as_long_as_it_is_slow(small: Hand) -> None:
    settings, library = LoopSettings(goal_timeout=2.0), make_library(small)
    fast = make_plan(Goal(Named("drill")), small, library, settings).timeout
    slow = make_plan(Goal(Named("drill"), speed=0.01), small, library, settings).timeout
    ways = 1.5 / 3.0 + 1.0 / 2.0 + 1.0 / 2.0  # [rad] / [rad/s], the longest of each leg
    assert fast == pytest.approx(3 * 2.0 + 0.7)
    assert slow == pytest.approx(fast + ways * 99.0)
    creeping = make_plan(Goal(Named("fist"), speed=1e-300), small, library, settings)
    assert creeping.timeout == pytest.approx(2.0 + 86400.0), "a day at most"
    given = make_plan(Goal(Named("fist"), speed=0.01, timeout=3.0), small, library, settings)
    assert given.timeout == 3.0


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ({"on_contact": {"ring": OnContact.STOP}}, "on_contact of an unknown finger"),
        ({"max_force": 3.0}, "a largest force needs an initial force"),
        ({"opening": 0.01, "force": 4.0, "max_force": 3.0}, "must be at least the force, 4 N"),
        ({"opening": 0.01, "force": 4.0, "max_force": NAN}, "not nan"),
        ({"touch": True, "opening": 0.01}, "a touch takes no opening"),
        ({"touch": True, "force": 1.0}, "a touch takes no force"),
        ({"touch": True, "intensity": 0.5}, "give an intensity or a touch, not both"),
        ({"action": "", "elements": ("ring",), "touch": True}, "unknown finger 'ring'"),
        ({"action": "", "touch": True}, "no action closes the fingertips of 'small'"),
        ({"touch": True, "tip_speed": 0.01}, "has no opening: give the speed as a share"),
        ({"touch": True, "tip_speed": 0.0}, "the speed must be above 0 m/s, not 0"),
        ({"touch": True, "tip_speed": -0.01}, "above 0 m/s, not -0.01"),
        ({"touch": True, "tip_speed": NAN}, "above 0 m/s, not nan"),
        ({"touch": True, "tip_speed": 0.01, "speed": 0.5}, "as a share or in m/s, not both"),
    ],
)
def test_what_cannot_be_is_refused(small: Hand, asked: dict[str, Any], reason: str) -> None:
    with pytest.raises(GoalRejected, match=reason):
        make_plan(
            goal_of(**{"action": "fist", **asked}), small, make_library(small), LoopSettings()
        )


def test_goals_and_results_cross_the_network() -> None:
    goal = Goal(Named("a"), on_contact={"": OnContact.HOLD, "thumb": OnContact.STOP})
    assert GOAL.decode(GOAL.encode(goal)) == goal
    result = Result("1", "a", touched=("thumb", "index"))
    assert RESULT.decode(RESULT.encode(result)).touched == ("thumb", "index")


@pytest.mark.parametrize("bent", [0.0, 0.5, 1.2])
def test_a_lever_is_that_of_the_present_posture(tmp_path: Path, bent: float) -> None:
    levers = TipLevers(make_hand(tmp_path, length=0.04))
    position = [0.7, bent, 0.0, 0.01]
    # Two links of 40 mm with the bend between them: the law of cosines.
    assert levers.of(0, 0.0, position) == pytest.approx(0.08 * math.cos(0.5 * bent))
    assert levers.of(1, 1.0, position) == pytest.approx(0.04)
    assert levers.of(3, 2.0, position) == pytest.approx(1.0), "a slider moves its tip as far"


def test_levers_are_renewed_one_in_a_tick_and_not_at_once(tmp_path: Path) -> None:
    levers = TipLevers(make_hand(tmp_path, length=0.04))
    straight, bent = [0.0, 0.0, 0.0, 0.0], [0.0, 1.2, 0.0, 0.0]
    long = levers.of(0, 1.0, straight)
    assert levers.of(0, 1.05, bent) == long, "too early"
    levers.of(1, 1.2, bent)
    assert levers.of(0, 1.2, bent) == long, "another one was renewed in this tick"
    assert levers.of(0, 1.21, bent) == pytest.approx(0.08 * math.cos(0.6))


@pytest.mark.parametrize("force", [1.0, 2.0, 4.0])
def test_without_an_opening_a_contact_is_a_force_at_the_fingertip(
    tmp_path: Path, force: float
) -> None:
    world = World(make_hand(tmp_path, length=0.04), {INDEX: 0.6}, contact_force=force)
    world.accept(on_contact=every(OnContact.STOP), speed=0.2)
    lever, pushes = 0.08, [0.0]
    while "contact" not in world.kinds():
        reference = world.controller.reference_position[INDEX]
        pushes.append(STIFFNESS * (reference - world.position[INDEX]))
        world.tick()
    # The push grows by this much in a tick, and two measurements are wanted.
    growth = STIFFNESS * max(world.controller.reference_velocity) * world.settings.period
    growth = max(growth, pushes[-1] - pushes[-2])
    assert force * lever <= pushes[-1] + growth
    assert pushes[-1] <= 1.1 * force * lever + 3.0 * growth


def test_from_crossed_fingertips_a_goal_presses_as_where_fingers_touch_elsewhere() -> None:
    grip = Grip(
        (0,), (0.0,), (1.0,), (0.0, 1.0), (0.1, 0.0), ((0.1,), (0.1,)), (0.0,), (1.0,), (0,), (1,),
        around=True,
    )  # fmt: skip
    reactions = _LegReactions({}, grip=grip, widest=-math.inf, width=0.02)
    for position, share in ((1.5, 1.0 / (1.0 + ELSEWHERE)), (0.6, 0.5)):  # crossed; 40 mm apart
        measured = Measured([position], [NAN], [NAN], [True], [-1])
        assert reactions.share(measured) == pytest.approx(share)


positive = st.floats(0.01, 1.0)


@given(dry=positive, viscous=positive, inertia=positive, push=st.floats(0.3, 2.0))
def test_free_motion_is_learned_and_a_push_stands_out(
    dry: float, viscous: float, inertia: float, push: float
) -> None:
    free = FreeMotion(10.0, 2.0, 20.0)

    def effort(speed: float, gain: float) -> float:
        return dry + viscous * speed + inertia * gain / 20.0

    for k in range(300):
        speed, gain = 1.0 + 0.5 * math.sin(k / 10.0), 2.5 * math.cos(k / 10.0)
        if k >= 50:
            assert free.knows(speed, gain)
            assert free.excess(effort(speed, gain), speed, gain, 0.2) <= 1.0
        free.learn(effort(speed, gain), speed, gain)
    assert free.expected(1.0, 0.0) == pytest.approx(effort(1.0, 0.0), abs=0.05)
    assert free.excess(effort(1.0, 0.0) + push, 1.0, 0.0, 0.2) > 1.0
    assert free.excess(effort(1.0, 0.0) - push, 1.0, 0.0, 0.2) < 0.0, "pulled, not stopped"
    late = effort(1.0, 2.5)  # a servo's effort for an acceleration that is over by now
    assert free.excess(late, 1.0, 0.0, 0.2, recent=2.5) <= 1.0


@given(st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(-5.0, 5.0), st.floats(-50.0, 50.0))))
def test_the_model_stays_within_the_effort_limit(
    samples: list[tuple[float, float, float]],
) -> None:
    free = FreeMotion(3.0, 2.0, 20.0)
    for effort, speed, gain in samples:
        free.learn(effort, speed, gain)
        assert abs(free.expected(speed, gain)) <= 3.0
