"""A force that is asked for: a light approach, the build-up after contact, sensors; openings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from rtee.actions.library import ActionLibrary
from rtee.commands import Abort, SetActive
from rtee.hand.load import load_configured
from rtee.log.dataclass_json import from_json, to_json
from rtee.loop.closing import slowed
from rtee.loop.controller import Controller
from rtee.loop.free_motion import LearnedMotion
from rtee.loop.grip import Grip, grip_at
from rtee.loop.measured import GRIP_FORCE, MET, Measured
from rtee.loop.planning import make_plan
from rtee.loop.pressing import ForceEstimate, Tare, ceilings
from rtee.loop.settings import loop_settings
from rtee.sample import TickRecord
from rtee.types import (
    Around,
    Event,
    FirstContact,
    Force,
    Goal,
    Intensity,
    Named,
    OnContact,
    Opening,
    Result,
    Shortfall,
)

FOLDER = Path(__file__).parents[2] / "config" / "robotiq_2f_85"
NAN = float("nan")
STIFFNESS = 200.0
"""Of its motor against what stops it [N·m/rad]."""


class Gripper:
    """A hand with one motor that holds something, with sensors at its tips if wanted.

    Args:
        width: Width of what it holds [m]; 0: nothing.
        reads: What the sensors read for every newton by the levers; ``NaN``: there are none.
        friction: Effort below which nothing moves [N·m].
        stops_short: How far before its reference it stands still [rad].
        amperes: Current for every unit of effort, which is not measured then [A/(N·m)].
        impact: What the sensors read more for 20 ticks from the contact on [N].
        learned: What is known of its free motion.
        folder: The hand's; a 2F-85, if not given.

    Attributes:
        opposite: What the sensors of the other fingers read for every newton of the first one's.
        stiffness: Of its motor against what stops it [N·m/rad].
    """

    def __init__(
        self,
        width: float = 0.0,
        reads: float = NAN,
        friction: float = 0.0,
        stops_short: float = 0.0,
        amperes: float = NAN,
        impact: float = 0.0,
        learned: Mapping[str, LearnedMotion] | None = None,
        folder: Path = FOLDER,
    ) -> None:
        self.hand, config = load_configured(folder)
        self.library = ActionLibrary.load(self.hand, folder / "actions")
        self.settings = structs.replace(
            loop_settings(config, rate=500.0), free_motion=learned or {}
        )
        self.controller = Controller(self.hand, self.settings)
        self.reads, self.friction, self.stops_short = reads, friction, stops_short
        self.opposite: tuple[float, ...] = (1.0,)
        self.stiffness = STIFFNESS
        self.amperes = amperes
        self.impact, self.since_contact = impact, 0
        self.grip = self.plan(Goal(Named("Grasp"), Opening(width))).grip
        assert self.grip is not None
        self.contact = math.inf
        if width:
            self.contact = self.grip.position_at(self.grip.intensity_at(width))[0]
        self.time = self.position = self.effort = self.force = 0.0
        self.results: list[Result] = []
        self.events: list[Event] = []
        self.controller.apply(SetActive({self.hand.actuator_names[0]: True}), 0.0)
        self.tick()

    def plan(self, goal: Goal):  # type: ignore[no-untyped-def]
        return make_plan(goal, self.hand, self.library, self.settings)

    def accept(self, goal: Goal) -> None:
        self.controller.accept(self.plan(goal), self.time)

    def do(self, goal: Goal) -> Result:
        self.accept(goal)
        for _ in range(20_000):
            self.tick()
            if self.results:
                return self.results.pop()
        raise AssertionError("the goal never ended")

    @property
    def reference(self) -> float:
        return self.controller.reference_position[0]

    @property
    def limit(self) -> float:
        return self.controller.reference_effort[0]

    def tick(self) -> None:
        self.time += self.settings.period
        if self.limit >= self.friction:
            there = self.reference - math.copysign(self.stops_short, self.reference - self.position)
            self.position = min(there, self.contact)
        push = self.stiffness * (self.reference - self.position)
        self.effort = max(-self.limit, min(push, self.limit))
        touch: list[float] = []
        self.force = 0.0
        if self.position >= self.contact and self.effort > 0.0:
            assert self.grip is not None
            [(_, _, lever)] = self.grip.squeezing(self.grip.intensity[-1] / 2.0)
            self.force = self.effort / lever
            self.since_contact += 1
        if self.reads == self.reads:
            hit = self.impact if 0 < self.since_contact <= 20 else 0.0
            felt = self.reads * self.force + hit
            touch = [felt, *(other * felt for other in self.opposite)]
        measured = Measured([self.position], [self.effort], [NAN], [True], [-1], touch=touch)
        if self.amperes == self.amperes:
            free = 0.3 * (self.controller.reference_velocity[0] > 0.0)
            measured.effort, measured.current = [NAN], [self.amperes * (self.effort + free)]
        self.take(measured)

    def take(self, measured: Measured) -> None:
        self.controller.step(self.time, measured)
        for item in self.controller.outbox.items:
            if isinstance(item, Result):
                self.results.append(item)
            elif isinstance(item, Event):
                self.events.append(item)
        self.controller.outbox.items.clear()


def grasp(width: float, force: float | None = None) -> Goal:
    return Goal(Named("Grasp"), Around(width), effort=Force(force))


def test_an_approach_takes_little_effort_and_the_force_comes_after_the_contact() -> None:
    gripper = Gripper(0.04, reads=1.0)
    gripper.accept(grasp(0.04, 40.0))
    wanted = gripper.plan(grasp(0.04, 40.0)).effort[0]
    closing = light = False
    while gripper.position < gripper.contact:
        gripper.tick()
        light = light or gripper.limit < 0.2 * wanted
        closing = closing or light
        assert not closing or gripper.limit < 0.2 * wanted
    assert light
    limits = []
    while not gripper.results:
        gripper.tick()
        limits.append(gripper.limit)
        assert gripper.force <= 1.05 * 40.0
    assert gripper.results.pop().grasped
    rising = [b - a for a, b in pairwise(limits)]
    assert max(rising) < 0.1 * wanted, "in steps of a ramp"


@pytest.mark.parametrize("reads", [0.7, 1.0, 1.5])
def test_sensors_on_both_sides_correct_the_force(reads: float) -> None:
    gripper = Gripper(0.04, reads=reads)
    result = gripper.do(grasp(0.04, 40.0))
    assert result.force_source == "tip forces"
    for _ in range(1000):
        gripper.tick()
        assert reads * gripper.force <= 1.05 * 40.0
    assert reads * gripper.force == pytest.approx(40.0, rel=0.02)


@pytest.mark.parametrize(("reads", "share"), [(0.8, 0.94), (1.25, 1.06)])
def test_a_force_that_leaves_the_requested_one_is_brought_back(reads: float, share: float) -> None:
    gripper = Gripper(0.04, reads=1.0)
    gripper.do(grasp(0.04, 40.0))
    gripper.reads = reads  # the object has shifted, so that the levers are others
    for _ in range(1000):
        gripper.tick()
    felt = reads * gripper.force / 40.0
    assert min(share, 1.0) - 0.01 <= felt <= max(share, 1.0) + 0.01


def test_a_force_is_not_lowered_where_more_may_be_the_pull_of_a_slipping_object() -> None:
    gripper = Gripper(0.04, reads=1.0)
    gripper.do(Goal(Named("Grasp"), Around(0.04), effort=Force(40.0, 80.0)))
    before, gripper.reads = gripper.force, 1.1
    for _ in range(1000):
        gripper.tick()
    assert gripper.force == pytest.approx(before, rel=0.02)


def test_the_impact_of_the_contact_does_not_pass_for_the_force() -> None:
    gripper = Gripper(0.04, reads=1.0, impact=60.0)
    result = gripper.do(grasp(0.04, 40.0))
    assert result.grasped
    assert result.force == pytest.approx(40.0, rel=0.05)


def test_what_was_not_measured_is_none() -> None:
    gripper = Gripper()
    result = gripper.do(Goal(Named("Grasp"), Opening(0.04)))
    assert (result.within, round(result.opening or 0.0, 3)) == (
        None,
        0.04,
    )  # no width was asked for
    gripper.accept(grasp(0.04, 40.0))
    gripper.tick()
    (name,) = gripper.hand.actuator_names
    gripper.controller.apply(Abort("the cable is out", (name,)), gripper.time)
    gripper.tick()
    (lost,) = gripper.results
    assert (lost.aborted, lost.within, lost.opening, lost.force) == (True, None, None, None)


@pytest.mark.parametrize("reads", [0.01, 20.0])
def test_a_broken_sensor_changes_the_force_by_a_factor_of_two_at_most(reads: float) -> None:
    gripper = Gripper(0.04, reads=reads)
    gripper.do(grasp(0.04, 40.0))
    wanted = gripper.plan(grasp(0.04, 40.0)).effort[0]
    for _ in range(2000):
        gripper.tick()
    assert 0.45 * wanted <= gripper.limit <= 2.05 * wanted


def test_a_result_says_why_the_force_is_less_than_the_requested_one() -> None:
    enough = Gripper(0.04, reads=1.0).do(grasp(0.04, 40.0))
    assert (enough.force_asked, enough.shortfall) == (40.0, Shortfall.NONE)
    weak = Gripper(0.04, reads=0.3).do(grasp(0.04, 40.0))  # with twice the effort, too
    assert weak.grasped
    assert weak.force == pytest.approx(24.0, rel=0.05)
    assert (weak.force_asked, weak.shortfall) == (40.0, Shortfall.EFFORT_LIMIT)
    soft = Gripper(0.04, reads=1.0)
    soft.stiffness = 2.0  # of the servo
    ended = soft.do(grasp(0.04, 40.0))
    assert ended.grasped
    assert ended.force < 30.0
    assert ended.shortfall is Shortfall.END_OF_MOTION
    soft = Gripper(0.04, reads=1.0)
    soft.stiffness = 2.0
    early = soft.do(replace(grasp(0.04, 40.0), timeout=2.0))
    assert (early.timed_out, early.grasped, early.shortfall) == (True, True, Shortfall.NONE)
    # The force is lowered on what is much wider than expected, whatever the motor could exert.
    lowered = Gripper(0.06).do(Goal(Named("Grasp"), Around(0.04, wider=0.05), effort=Force(40.0)))
    assert lowered.grasped
    assert lowered.force is not None
    assert lowered.force < 30.0
    assert lowered.shortfall is Shortfall.NONE


@pytest.mark.parametrize(("every", "share"), [(25, 0.3), (50, 0.1), (50, 0.3)])
def test_friction_is_no_contact_however_rarely_positions_come(every: int, share: float) -> None:
    gripper = Gripper()
    friction = share * gripper.hand.actuators[0].effort
    gripper.accept(Goal(Named("Grasp"), FirstContact()))
    position = shown = 0.0
    for tick in range(20_000):
        if gripper.results:
            break
        gripper.time += gripper.settings.period
        if gripper.limit >= friction:
            position = gripper.reference
        fresh = tick % every == 0
        if fresh:
            shown = position
        gripper.take(Measured([shown], [NAN], [NAN], [fresh], [-1], touch=[]))
    (result,) = gripper.results
    assert not result.touched
    assert position > 0.5


def test_fingers_from_all_around_may_press_four_times_as_hard_as_their_tips() -> None:
    gripper = Gripper(0.04, reads=20.0)
    plan = gripper.plan(grasp(0.04, 40.0))
    around = replace(plan, grip=replace(plan.grip, around=True))
    gripper.controller.accept(around, gripper.time)
    for _ in range(4000):
        gripper.tick()
    assert gripper.limit == pytest.approx(0.25 * plan.effort[0], rel=0.05)


def test_friction_that_nobody_knows_is_overcome_on_the_way() -> None:
    gripper = Gripper(0.04, friction=2.0)
    result = gripper.do(grasp(0.04, 40.0))
    assert result.within
    assert gripper.limit == pytest.approx(gripper.plan(grasp(0.04, 40.0)).effort[0])


def test_a_goal_that_opens_after_a_grasp_does_not_press_on_its_way_back() -> None:
    gripper = Gripper(0.04)
    assert gripper.do(Goal(Named("Grasp"), effort={gripper.hand.actuator_names[0]: 2.0})).grasped
    assert gripper.force > 10.0
    gripper.accept(Goal(Named("Grasp"), Intensity(0.1)))
    gripper.tick()
    assert gripper.limit == gripper.hand.actuators[0].effort
    for _ in range(20):
        gripper.tick()
        assert gripper.reference <= gripper.contact + 1e-9
        assert gripper.force < 1.0


@pytest.mark.parametrize("force", [15.0, 80.0])
@pytest.mark.parametrize("reads", [1.0, NAN])
def test_a_grasp_of_what_is_held_changes_its_force_in_place(force: float, reads: float) -> None:
    gripper = Gripper(0.04, reads=reads)
    assert gripper.do(grasp(0.04, 40.0)).grasped
    gripper.accept(grasp(0.04, force))
    least = math.inf
    while not gripper.results:
        gripper.tick()
        # It neither opens nor lets go on the way: a part would fall.
        assert gripper.position == gripper.contact
        least = min(least, gripper.force)
    assert least > 0.9 * min(force, 40.0)
    result = gripper.results.pop()
    assert result.grasped
    assert result.within
    assert gripper.force == pytest.approx(force, rel=0.05)


def test_a_grasp_after_the_part_is_gone_opens_again() -> None:
    gripper = Gripper(0.04, reads=1.0)
    gripper.do(grasp(0.04, 40.0))
    gripper.contact = math.inf
    while "grasp_lost" not in [event.kind for event in gripper.events]:
        gripper.tick()
    gripper.accept(grasp(0.04, 20.0))
    before = gripper.position
    for _ in range(100):
        gripper.tick()
    assert gripper.position < before


@pytest.mark.parametrize("reads", [1.0, NAN])
def test_fingertips_that_meet_one_another_are_no_object(reads: float) -> None:
    gripper = Gripper(0.0003, reads=reads)
    result = gripper.do(grasp(0.004, 20.0))
    assert (result.grasped, result.within) == (False, False)
    assert result.opening == abs(round(result.opening, 9))  # neither -2.8e-17 nor -0.0
    assert result.reached  # within the tolerance
    assert result.unknown == (reads == 1.0)  # by efforts alone, they have just arrived
    assert result.grasped_fingers == result.touched == ()
    strict = Goal(Named("Grasp"), Intensity(tolerance=1e-9))
    assert Gripper(0.0003, reads=reads).do(strict).outcome == "closed"
    assert Gripper(0.0007, reads=0.0).do(grasp(0.004, 20.0)).outcome == "empty"
    assert Gripper(0.01, reads=0.0).do(strict).outcome == "stalled"


@pytest.mark.parametrize(("reads", "opposite"), [(0.05, 1.0), (1.0, 0.0)])
def test_one_side_or_a_faint_force_holds_nothing_that_is_known(
    reads: float, opposite: float
) -> None:
    gripper = Gripper(0.04, reads=reads)
    gripper.opposite = (opposite,)
    result = gripper.do(grasp(0.04, 40.0))
    assert (result.grasped, result.unknown) == (False, True)


def test_what_one_side_alone_still_touches_is_lost() -> None:
    gripper = Gripper(0.04, reads=1.0)
    assert gripper.do(grasp(0.04, 40.0)).grasped
    before, gripper.opposite = gripper.time, (0.0,)  # one motor moves both sides, and stands still
    for _ in range(100):
        gripper.tick()
    [lost] = [event for event in gripper.events if event.kind == "grasp_lost"]
    assert 0.04 < lost.stamp - before < 0.2


@pytest.mark.parametrize(
    ("opposite", "lost"),
    [((1.0, 0.0), True), ((1.0, 1.0), False), ((0.0, 0.9), False)],
)
def test_what_another_finger_of_the_motor_takes_over_has_turned(
    opposite: tuple[float, ...], lost: bool
) -> None:
    gripper = Gripper(0.074, reads=0.5, folder=FOLDER.parent / "onrobot_3fg15")
    gripper.opposite = (0.0, 1.0)
    assert gripper.do(grasp(0.074, 72.0)).grasped
    gripper.opposite = opposite
    for _ in range(100):
        gripper.tick()
    assert ("grasp_lost" in [event.kind for event in gripper.events]) is lost


@pytest.mark.parametrize("reads", [1.0, NAN])
@pytest.mark.parametrize(("further", "lost"), [(0.03, False), (0.12, True)])
def test_fingers_that_go_on_past_where_they_grasped_have_lost_it(
    reads: float, further: float, lost: bool
) -> None:
    gripper = Gripper(0.04, reads=reads)
    assert gripper.do(grasp(0.04, 40.0)).grasped
    gripper.contact += further  # they press on as before, on what has turned between them
    for _ in range(200):
        gripper.tick()
    assert gripper.force > 30.0
    assert ("grasp_lost" in [event.kind for event in gripper.events]) is lost


def test_a_gripper_that_its_force_does_not_move_holds_nothing() -> None:
    gripper = Gripper(friction=4.0)
    result = gripper.do(Goal(Named("Grasp"), effort={gripper.hand.actuator_names[0]: 3.0}))
    assert (result.stalled, result.grasped) == (True, False)


def test_a_goal_that_closes_further_does_not_let_go() -> None:
    gripper = Gripper(0.04)
    name = gripper.hand.actuator_names[0]
    assert gripper.do(Goal(Named("Grasp"), effort={name: 2.0})).grasped
    before = gripper.force
    gripper.accept(Goal(Named("Grasp"), effort={name: 3.0}))
    for _ in range(200):
        gripper.tick()
        assert gripper.force >= 0.99 * before


@pytest.mark.parametrize("amperes", [0.05, 2.0])
def test_a_device_that_measures_nothing_but_currents_feels_what_it_touches(amperes: float) -> None:
    gripper = Gripper(0.04, amperes=amperes)
    gripper.accept(Goal(Named("Grasp"), speed=0.3, on_contact={"": OnContact.STOP}))
    pressed = 0.0
    while not gripper.results:
        gripper.tick()
        pressed = max(pressed, gripper.force)
    assert gripper.results.pop().touched == ("finger_1", "finger_2")
    assert gripper.reference == pytest.approx(gripper.contact, abs=1e-3)
    assert pressed < 10.0
    # The effort limits of a force are in other units than the current that free motion takes.
    squeezing = Gripper(0.04, amperes=amperes)
    assert squeezing.do(grasp(0.04, 40.0)).stalled
    wanted = squeezing.plan(grasp(0.04, 40.0)).effort[0]
    assert squeezing.limit == pytest.approx(wanted)


@pytest.mark.parametrize(("off", "reached"), [(3e-4, True), (1e-3, False)])
def test_an_opening_is_judged_in_millimetres(off: float, reached: bool) -> None:
    # 1 mm are 0.009 rad there, less than what counts as reached of other goals.
    gripper = Gripper(stops_short=off / 0.111)
    result = gripper.do(Goal(Named("Grasp"), Opening(0.04), timeout=5.0))
    assert result.opening == pytest.approx(0.04 + off, abs=1.5e-4)
    assert result.reached == reached
    assert result.succeeded == reached


def test_the_force_between_the_tips_needs_both_sides() -> None:
    grip = Grip(
        (0,), (0.0,), (1.0,), (0.0, 1.0), (0.1, 0.0), ((0.1,), (0.1,)), (0.0,), (1.0,), (0,), (1,)
    )
    assert grip.tip_force([5.0, 4.0]) == 4.5, "one side also bears the object"
    assert grip.tip_error([5.0, 4.0]) == pytest.approx(0.05 * 4.5 + 0.5)
    assert grip.tip_force([5.0, 1.0]) == pytest.approx(1.15), "the rest is pressed by itself"
    assert grip.tip_force([5.0, 0.0]) == 0.0
    for missing in ([math.nan, 5.0], [5.0, math.nan], [5.0]):
        assert math.isnan(grip.tip_force(missing))


def test_a_state_tells_the_force_that_the_result_tells() -> None:
    grip = Grip(
        (0,), (0.0,), (1.0,), (0.0, 1.0), (0.1, 0.0), ((0.1,), (0.1,)), (0.0,), (1.0,), (0,), (1,)
    )
    one = np.ones(1)
    record = TickRecord(
        0.5 * one, one, one, one, one, tick=1, stamp=0.0, wall_ns=0,
        grasped=np.zeros(1, np.int8), fresh=one > 0.0, reference_position=0.5 * one,
        reference_velocity=one, reference_effort=one, channels={},
    )  # fmt: skip
    assert grip_at(grip, record)[1] == pytest.approx(10.0), "with weight and friction"
    known = replace(record, channels={GRIP_FORCE: np.array((4.0, 2.0))})
    assert grip_at(grip, known)[1:3] == (4.0, 2.0)
    bent = replace(record, channels={MET: np.array((0.2,))})
    assert grip_at(grip, bent)[0] == pytest.approx(0.08), "where the fingers met it"


def bending(*levers: float) -> Grip:
    """Return the grip of a motor that bends two fingers, with levers at even steps to 1 rad."""
    steps = np.linspace(0.0, 1.0, len(levers))
    return Grip(
        (0,), (0.0,), (1.0,), tuple(steps.tolist()), tuple((0.1 - 0.05 * steps).tolist()),
        tuple((lever,) for lever in levers), (0.0,), (1.0,), (0,), (1,),
    )  # fmt: skip


def test_a_lever_that_has_changed_since_the_contact_makes_the_force_less_sure() -> None:
    grip, met = bending(0.1, 0.08, 0.01), [0.0]
    assert grip.force([0.5], [1.0], [1.0], [], True)[:2] == pytest.approx((12.5, 1.875))
    force, error, _ = grip.force([0.5], [1.0], [1.0], [], True, met)
    assert (force, error) == pytest.approx((12.5, 1.875 + 2.5)), "10 N with the lever of before"
    force, error, _ = grip.force([0.5], [NAN], [1.0], [], True, met)
    assert (force, error) == pytest.approx((12.5, 0.25 * 12.5 + 2.5)), "by effort limits, too"
    assert grip.force([1.0], [1.0], [1.0], [], True)[0] == pytest.approx(100.0)
    force, error, source = grip.force([1.0], [1.0], [1.0], [], True, met)
    assert (math.isnan(force), math.isnan(error), source) == (True, True, "")
    assert grip.force([1.0], [1.0], [1.0], [], True, [NAN])[0] == pytest.approx(100.0)
    # Sensors need no lever.
    assert grip.force([1.0], [1.0], [1.0], [5.0, 5.0], True, met)[:2] == (5.0, 0.25)


def test_an_opening_says_how_far_it_may_be_off() -> None:
    bends = bending(0.1, 0.1)
    rigid = replace(bends, inertia=(1.0,))
    two = replace(
        rigid, indices=(0, 1), rest=(0.0, 0.0), target=(1.0, 1.0),
        lever=((0.05, 0.05),) * 2, inertia=(1.0, 1.0),
    )  # fmt: skip
    assert rigid.opening_error([0.5]) == pytest.approx(5e-4)
    assert bends.opening_error([0.5]) == pytest.approx(5e-4 + 7e-3 * 0.1), "its springs give way"
    assert two.opening_error([0.5, 0.5]) == pytest.approx(3e-3)
    assert two.opening_error([0.4, 0.6]) == pytest.approx(3e-3), "the opening is the same"
    assert math.isnan(bends.opening_error([NAN]))


@pytest.mark.heavy
def test_fingers_that_press_together_approach_with_no_more_than_the_force_takes() -> None:
    folder = FOLDER.with_name("leap_hand")
    hand, config = load_configured(folder)
    settings = loop_settings(config, rate=500.0)
    controller = Controller(hand, settings)
    controller.apply(SetActive(dict.fromkeys(hand.actuator_names, True)), 0.0)
    size = len(hand.actuators)
    time, position = 0.0, hand.rest.tolist()

    def tick() -> None:
        nonlocal time, position
        time += settings.period
        nothing = [0.0] * size
        controller.step(time, Measured(position, nothing, [NAN] * size, [True] * size, [-1] * size))
        position = list(controller.reference_position)

    tick()
    library = ActionLibrary.load(hand, folder / "actions")
    plan = make_plan(grasp(0.03, 0.5), hand, library, settings)
    assert len(plan.effort) > 1, "of several joints"
    controller.accept(plan, time)
    time_began, limits = time, []
    while not any(isinstance(item, Result) for item in controller.outbox.items):
        tick()
        limits.append([controller.reference_effort[i] for i in plan.effort])
    allowed = ceilings(hand, dict(plan.effort), plan.effort)
    assert np.min(limits, axis=0) == pytest.approx([allowed[i] for i in plan.effort])
    assert all(allowed[i] < hand.actuators[i].effort for i in plan.effort)
    # The way around has taught what free motion takes; only the speed is told, beforehand.
    [told] = [item for item in controller.outbox.items if isinstance(item, Event)]
    assert (told.kind, told.stamp) == ("slowed", time_began)
    assert "meet the object at 8.03 mm/s instead of 10 mm/s" in told.text
    assert plan.grip is not None
    estimate = ForceEstimate(hand, plan.grip, Tare())
    efforts, one = [plan.effort.get(i, 0.0) for i in range(size)], list(plan.effort)[:1]
    every = estimate.by_efforts(efforts, position)
    assert 0.0 < estimate.by_efforts(efforts, position, one) < every, "others may speed up"
    assert estimate.by_efforts(efforts, position, list(plan.effort)) == pytest.approx(every)
    text = slowed(replace(plan, lag=1.0), hand)
    assert "at 3 mm/s instead of 10 mm/s: faster, the impact of fingers that lag 1 s" in text


class Pinch:
    """Finger and thumb of a HERI II, one actuator each, that close on 20 mm with 6 N.

    Attributes:
        finger: Index of the finger's actuator.
        thumb: That of the thumb's.
        stops: Where something stops actuators, by index [rad].
        most: Largest effort against what stops them, by index [N·m].
        slow: Share of its reference's motion with which something that yields lets one go on.
        reads: What sensors read for every newton by the levers; ``NaN``: there are none.
    """

    def __init__(self, reads: float = NAN) -> None:
        folder = FOLDER.with_name("heri_ii")
        self.hand, config = load_configured(folder)
        self.settings = loop_settings(config, rate=500.0)
        self.controller = Controller(self.hand, self.settings)
        goal = Goal(Named("PinchTight", ("finger_2", "thumb")), Around(0.02), effort=Force(6.0))
        library = ActionLibrary.load(self.hand, folder / "actions")
        self.plan = make_plan(goal, self.hand, library, self.settings)
        self.finger, self.thumb = self.plan.effort
        self.stops: dict[int, float] = {}
        self.most: dict[int, float] = {}
        self.slow, self.reads = 0.0, reads
        size = len(self.hand.actuators)
        self.time, self.position, self.effort = 0.0, self.hand.rest.tolist(), [0.0] * size
        self.force = 0.0
        self.results: list[Result] = []
        self.events: list[Event] = []

    def at(self, width: float, i: int) -> float:
        """Return where an actuator is at an opening [rad]."""
        assert self.plan.grip is not None
        return self.plan.grip.position_at(self.plan.grip.intensity_at(width))[i]

    @property
    def limits(self) -> list[float]:
        return [self.controller.reference_effort[i] for i in (self.finger, self.thumb)]

    def tick(self) -> None:
        assert self.plan.grip is not None
        size = len(self.hand.actuators)
        touch = []
        if self.reads == self.reads:
            touch = [self.reads * self.force] * len(self.hand.fingers)
        measured = Measured(
            self.position, self.effort, [NAN] * size, [True] * size, [-1] * size, touch=touch
        )
        self.controller.step(self.time, measured)
        for item in self.controller.outbox.items:
            if isinstance(item, Result):
                self.results.append(item)
            elif isinstance(item, Event):
                self.events.append(item)
        self.controller.outbox.items.clear()
        if not self.time:
            self.controller.apply(
                SetActive(dict.fromkeys(self.hand.actuator_names, True)), self.time
            )
            self.controller.accept(self.plan, self.time)
        self.time += self.settings.period
        reference, limits = self.controller.reference_position, self.controller.reference_effort
        there = list(reference)
        for i, stop in self.stops.items():
            there[i] = min(there[i], stop + self.slow * max(there[i] - stop, 0.0))
        # Friction, and a servo of 20 N·m/rad against what stops it.
        self.effort = [
            min(0.03 * (t > p) + 20.0 * (r - t), limit, self.most.get(i, math.inf))
            for i, (t, p, r, limit) in enumerate(
                zip(there, self.position, reference, limits, strict=True)
            )
        ]
        self.position = there
        self.force = min(
            self.effort[i] / lever if i in self.stops else 0.0
            for _, i, lever in self.plan.grip.squeezing(self.plan.grip.intensity_of(there))
        )


@pytest.mark.parametrize("opposed", [True, False])
def test_a_side_at_its_end_opposes_the_one_that_touches_if_something_is_there(
    opposed: bool,
) -> None:
    pinch = Pinch()
    pinch.stops = {pinch.finger: pinch.at(0.02, pinch.finger)}
    if opposed:  # the thumb meets a soft object where its motion ends
        pinch.stops[pinch.thumb] = pinch.plan.legs[-1].targets[pinch.thumb]
    else:  # alone, the finger meets no more than its friction
        pinch.most = {pinch.finger: 0.2}
    while not pinch.results and pinch.time < 20.0:
        pinch.tick()
    [result] = pinch.results
    assert result.grasped is opposed
    assert result.unknown is not opposed
    if opposed:
        assert result.force == pytest.approx(6.0, rel=0.05)


def held_at(gives: float) -> Result:
    """Return the result of a pinch of 20 mm that gives way under the finger at a speed [rad/s]."""
    pinch = Pinch()
    pinch.stops = {pinch.finger: pinch.at(0.02, pinch.finger)}
    pinch.stops[pinch.thumb] = pinch.plan.legs[-1].targets[pinch.thumb]
    while not pinch.results and pinch.time < 20.0:
        pinch.tick()
        touched = pinch.position[pinch.finger] >= pinch.stops[pinch.finger]
        pinch.stops[pinch.finger] += gives * pinch.settings.period * touched
    [result] = pinch.results
    return result


def test_what_goes_on_giving_way_is_not_said_to_be_held() -> None:
    stays, gives = held_at(0.0), held_at(0.02)
    assert (stays.grasped, gives.grasped, gives.unknown) == (True, False, True)
    assert gives.force == pytest.approx(6.0, rel=0.1)  # the force alone would not tell
    assert gives.duration > stays.duration
    assert held_at(0.002).grasped  # it creeps as slowly as soft things do


def test_what_presses_on_a_finger_that_waits_is_the_other_side_however_freely_it_moves() -> None:
    pinch = Pinch()
    assert pinch.plan.grip is not None
    [lever] = [w for _, i, w in pinch.plan.grip.squeezing(0.5) if i == pinch.finger]
    pinch.stops = {pinch.finger: pinch.at(0.028, pinch.finger)}
    pinch.most = {pinch.finger: 0.2}
    meets, borne = pinch.at(0.028, pinch.thumb), 0.0
    while pinch.time < 5.0 and "thumb" not in [event.source for event in pinch.events]:
        pinch.tick()
        # The thumb pushes the object against the finger, and meets no more than its friction.
        borne = 10.0 * max(pinch.position[pinch.thumb] - meets, 0.0)
        pinch.effort[pinch.finger] = max(pinch.effort[pinch.finger], borne)
    assert 0.9 * 6.0 < borne / lever < 1.1 * 6.0


def test_joints_that_follow_at_two_thirds_of_their_references_press_on_the_way_around() -> None:
    pinch = Pinch()
    # What lies askew meets both long before the path around it ends, and yields.
    pinch.stops = {i: pinch.at(0.04, i) for i in (pinch.finger, pinch.thumb)}
    pinch.slow, forces = 0.65, []
    while pinch.time < 20.0 and not pinch.events:
        pinch.tick()
        forces.append(pinch.force)
    assert max(forces) < 6.0


def test_effort_limits_rise_slowly_while_references_lead_far_ahead() -> None:
    pinch = Pinch(reads=0.2)  # it touches the object elsewhere than its levers assume
    pinch.stops = {i: pinch.at(0.02, i) for i in (pinch.finger, pinch.thumb)}
    while pinch.time < 20.0 and not pinch.force:
        pinch.tick()
    limits = []
    while pinch.time < 20.0 and not pinch.results:
        limits.append(pinch.limits)
        pinch.tick()
    rise = np.diff(limits, axis=0).max(axis=0)
    assert pinch.results[0].force == pytest.approx(6.0, rel=0.1)
    assert np.all(rise <= 0.1 * np.max(limits, axis=0))


class Stepping(Gripper):
    """A 2F-85 that follows a slow reference in steps, as one that has a least speed does.

    It measures positions in counts, 25 times a second, and a current that it takes while it moves.
    """

    LEAST_SPEED = 0.2
    """The least speed of its motor [rad/s]: twice that of the touch."""
    COUNT = 0.0036
    """A count of its position [rad]."""

    def tick(self) -> None:
        self.ticks = getattr(self, "ticks", -1) + 1
        self.time += self.settings.period
        there, way = getattr(self, "there", 0.0), self.LEAST_SPEED * self.settings.period
        gap = min(self.reference, self.contact) - there
        # It sets out once it is five counts behind, and stops when it has caught up.
        self.going = abs(gap) > (0.0 if getattr(self, "going", False) else 5.0 * self.COUNT)
        if self.going:
            there += max(-way, min(gap, way))
        self.there = there
        fresh = self.ticks % 20 == 0
        if fresh:
            self.position = round(there / self.COUNT) * self.COUNT
            pressed = there >= self.contact and self.reference - there > 5.0 * self.COUNT
            self.amps = 0.4 if pressed else 0.1 if self.going else 0.0
        amps = getattr(self, "amps", 0.0)
        measured = Measured([self.position], [NAN], [NAN], [fresh], [-1], current=[amps])
        self.take(measured)


class Sticking(Gripper):
    """A 2F-85 whose servo stands still, with effort, until it is some counts behind.

    A slow reference moves it in steps, between which it seems to press.
    """

    COUNT = 0.0015
    """A count of its position [rad]."""

    def tick(self) -> None:
        self.time += self.settings.period
        there = min(self.reference, self.contact)
        lag = there - self.position
        if abs(lag) > 3.0 * self.COUNT:
            self.position = round(there / self.COUNT) * self.COUNT
        pressed = self.position >= self.contact - self.COUNT
        push = STIFFNESS * (self.reference - self.contact) if pressed else 0.0
        self.effort = min(max(push, 0.05 if lag > self.COUNT else 0.0), self.limit)
        measured = Measured([self.position], [self.effort], [NAN], [True], [-1])
        self.take(measured)


@pytest.mark.parametrize("kind", [Stepping, Sticking])
def test_a_gripper_that_moves_in_steps_touches_nothing_in_the_air(kind: type[Gripper]) -> None:
    gripper = kind()
    for number in range(4):
        result = gripper.do(Goal(Named("Grasp"), FirstContact()))
        assert (result.touched, result.reached) == ((), True), number
        gripper.do(Goal(Named("open")))
    # The first time, it says that it does not know yet what free motion takes.
    assert [event.kind for event in gripper.events] == ["contact_unknown"]
    # What it has learned is of use to the next run.
    kept = from_json(to_json(gripper.controller.learned_motion["finger_joint"]), LearnedMotion)
    assert kept.sound
    again = kind(learned={"finger_joint": kept})
    assert again.do(Goal(Named("Grasp"), FirstContact())).touched == ()
    assert again.events == []


@pytest.mark.parametrize("width", [0.01, 0.03, 0.06])
def test_it_touches_what_is_there_once_it_has_moved_freely(width: float) -> None:
    gripper = Stepping()
    gripper.do(Goal(Named("Grasp"), FirstContact()))
    gripper.do(Goal(Named("open")))
    assert gripper.grip is not None
    gripper.contact = gripper.grip.position_at(gripper.grip.intensity_at(width))[0]
    result = gripper.do(Goal(Named("Grasp"), FirstContact()))
    assert result.touched
    assert result.opening == pytest.approx(width, abs=2e-3)


def test_every_free_motion_teaches_what_a_contact_is_not() -> None:
    gripper = Stepping()
    gripper.do(Goal(Named("Grasp"), speed=0.1))  # a goal that reacts to nothing
    gripper.do(Goal(Named("open")))
    gripper.do(Goal(Named("Grasp"), FirstContact()))
    assert gripper.events == []
