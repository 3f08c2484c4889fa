"""The rules of contact: what evidence comes to, one rule after the other."""

from __future__ import annotations

import math

import pytest

from rtee.loop import contact_rules as rules

NAN = math.nan


@pytest.mark.parametrize(
    ("forces", "every", "expected"),
    [
        ([0.2, 0.0], False, True),
        ([0.2, 0.0], True, False),
        ([0.2, 0.3], True, True),
        ([0.05, 0.0], False, False),
        ([0.2, NAN], False, None),  # the other one is not measured
        ([], False, None),
    ],
)
def test_forces_on_fingers(forces: list[float], every: bool, expected: bool | None) -> None:
    assert rules.any_touch(forces, 0.1, every=every) is expected


@pytest.mark.parametrize(
    ("sides", "expected"),
    [
        ([[0.2], [0.3]], True),
        ([[0.2, 0.3], [0.0]], False),  # two fingers of one side hold nothing
        ([[0.2], [NAN, 0.2]], True),
        ([[0.2], [NAN]], None),
        ([[0.2], []], None),
    ],
)
def test_both_sides(sides: list[list[float]], expected: bool | None) -> None:
    assert rules.both_sides_touch(sides, 0.1) is expected


def test_a_finger_that_is_not_measured_may_be_the_one_that_touches() -> None:
    assert rules.one_touches([False, True, None]) is True
    assert rules.one_touches([False, None]) is None
    assert rules.one_touches([False, False]) is False
    assert rules.one_touches([]) is None


def test_what_gains_on_its_reference_touches_nothing() -> None:
    assert rules.catches_up(moved=0.02, led=0.01)
    assert not rules.catches_up(moved=0.01, led=0.01)
    assert not rules.catches_up(moved=0.0, led=0.0), "an actuator at rest presses"
    assert not rules.catches_up(moved=-0.001, led=0.01), "it was pushed back"


def test_an_effort_near_its_limit_may_be_bound_by_it() -> None:
    assert rules.is_bound(0.95, 1.0)
    assert rules.is_bound(-0.95, 1.0), "either direction"
    assert rules.is_bound(0.028, 0.015), "devices round small limits up"
    assert not rules.is_bound(0.85, 1.0)
    assert not rules.is_bound(5.0, math.inf)
    assert not rules.is_bound(NAN, 1.0)


def test_forces_come_before_efforts_and_stalls() -> None:
    assert not rules.touches(False, pushes=True, blocked=True)
    assert rules.touches(True, pushes=False, blocked=False)
    assert rules.touches(None, pushes=True, blocked=False)
    assert rules.touches(None, pushes=False, blocked=True)
    assert not rules.touches(None, pushes=False, blocked=False)


@pytest.mark.parametrize(
    ("moved", "wanted", "left", "expected"),
    [
        (0.004, 0.005, 0.5, True),
        (0.001, 0.005, 0.5, False),
        (-0.004, 0.005, 0.5, False),
        (0.004, 0.0, 0.0, False),
        (0.004, 0.0002, 0.001, False),  # the reference has arrived, and the ball gives way
    ],
)
def test_keeping_pace(moved: float, wanted: float, left: float, expected: bool) -> None:
    assert rules.keeps_pace(moved=moved, wanted=wanted, left=left, tolerance=0.0045) is expected


@pytest.mark.parametrize(
    ("felt", "change", "expected"),
    [
        (None, {}, True),
        (None, {"effort": 0.9}, False),
        (None, {"effort": NAN}, False),
        (None, {"effort": NAN, "word": True}, True),
        (None, {"denied": True}, False),
        (None, {"moved": False}, False),  # friction alone may have stopped it
        (None, {"moved": False, "word": True}, True),
        (True, {"moved": False}, True),
        (None, {"away": True}, False),
        (False, {"word": True}, False),
        (True, {"effort": 0.0, "denied": True}, True),
        (True, {"away": True}, False),
    ],
)
def test_what_is_held(felt: bool | None, change: dict[str, object], expected: bool) -> None:
    usual = {
        "word": False, "denied": False, "away": False, "moved": True, "effort": 2.0, "least": 1.0,
    }  # fmt: skip
    assert rules.holds(felt, **(usual | change)) is expected  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("felt", "change", "expected"),
    [
        (None, {}, False),
        (False, {}, True),
        (True, {"word": False}, True),
        (None, {"word": True, "moved": 1.0}, False),
        (None, {"moved": 0.1, "effort": 0.1}, True),
        (None, {"moved": 0.1, "effort": 0.6}, False),  # it still presses
        (None, {"moved": 0.1, "effort": NAN}, True),
        (None, {"moved": 0.025, "effort": 0.1}, False),  # soft things give way as far
        (None, {"moved": 0.02, "push": 0.03, "effort": 0.1}, True),  # half of what is left
        (True, {"moved": 0.02, "push": 0.03, "effort": 0.1}, False),  # it creeps, and is felt
        (True, {"moved": 0.1, "push": 0.03, "effort": 0.1}, True),
    ],
)
def test_what_is_lost(felt: bool | None, change: dict[str, object], expected: bool) -> None:
    usual = {
        "word": None, "moved": 0.0, "push": 0.5, "tolerance": 0.01,
        "span": 1.0, "effort": 1.0, "least": 1.0,
    }  # fmt: skip
    assert rules.lost(felt, **(usual | change)) is expected  # type: ignore[arg-type]


def test_to_stand_still_shows_no_contact() -> None:
    assert not rules.shows(False, word=False, effort=0.5, hard=1.0)
    assert not rules.shows(False, word=False, effort=NAN, hard=1.0)
    assert rules.shows(False, word=False, effort=1.0, hard=1.0)
    assert rules.shows(False, word=True, effort=NAN, hard=1.0)
    assert rules.shows(True, word=False, effort=NAN, hard=1.0)


def test_an_opening_of_the_empty_hand_holds_nothing_that_is_known() -> None:
    assert rules.may_be_nothing(0.0004, 0.0005, word=False)
    assert not rules.may_be_nothing(0.0004, 0.0005, word=True)  # the device knows better
    assert not rules.may_be_nothing(0.002, 0.0005, word=False)
    assert not rules.may_be_nothing(NAN, 0.0005, word=False)


def test_fingers_that_meet_as_in_the_empty_hand_have_closed_past_what_they_held() -> None:
    assert rules.closed_past(0.0001, 0.005, 0.007)
    assert not rules.closed_past(0.006, 0.005, 0.007)
    assert not rules.closed_past(0.004, 0.005, 0.007)  # a soft object yields as far
    assert not rules.closed_past(0.0001, 0.005, 0.004)  # it was never told from the empty hand
    assert not rules.closed_past(NAN, NAN, 0.007)
    # The actuators of fingers that bend go on by millimetres, on a thin plate, too.
    assert not rules.closed_past(0.0014, 0.003, 0.0045, bends=True)
    assert rules.closed_past(0.0008, 0.003, 0.05, bends=True)


def test_a_fingertip_that_moves_by_more_than_a_slip_has_strayed() -> None:
    assert not rules.strays(0.0048)
    assert rules.strays(0.0068)
    assert not rules.strays(NAN)


def test_what_a_finger_hands_over_to_another_one_has_turned() -> None:
    # A box turns out of two of three fingers, and is caught by another pair.
    assert rules.handed_over([35.9, 0.0, 36.2], [36.5, 36.3, 0.0])
    assert rules.handed_over([35.9, 0.0, 36.2], [11.4, 11.3, 0.0])  # the share counts
    assert rules.handed_over([0.0, 39.8, 31.6], [27.3, 6.1, 28.2])  # likewise, by all three
    assert not rules.handed_over([36.0, 0.0, 35.9], [24.0, 25.0, 25.0])  # a third finger joins
    assert not rules.handed_over([24.0, 25.0, 25.0], [36.0, 0.0, 36.0])  # and leaves
    assert not rules.handed_over([36.0, 0.0, 0.0], [36.0, 36.0, 36.0])  # fingers that come later
    assert not rules.handed_over([20.0, 0.0, 20.0], [20.0, 60.0, 20.0])  # none gives up anything
    assert not rules.handed_over([10.0, 10.0], [0.0, 20.0])  # of two, one side holds nothing
    assert not rules.handed_over([35.9, 0.0, 36.2], [0.0, 0.0, 0.0])
    assert not rules.handed_over([35.9, 0.0, 36.2], [NAN, 36.0, 36.0])
    assert not rules.handed_over([], [36.5, 36.3, 0.0])


def test_a_small_share_of_the_force_is_faint() -> None:
    assert rules.faint(0.096, 3.1)  # a plate that slides out of one motor's fingers
    assert not rules.faint(0.48, 3.3)  # a ball that they hold
    assert rules.faint(0.0, 3.1)  # one side feels nothing


def test_a_force_falls_short_by_more_than_its_error_and_than_is_corrected() -> None:
    assert rules.falls_short(3.0, 0.5, 4.0)
    assert not rules.falls_short(3.0, 1.0, 4.0)
    assert not rules.falls_short(3.8, 0.1, 4.0)  # such a force is not raised again
    assert not rules.falls_short(math.nan, 0.1, 4.0)
    assert not rules.falls_short(3.0, math.nan, 4.0)
    assert not rules.falls_short(3.0, 0.5, math.nan)


def test_what_yields_at_the_end_of_a_grasp_gives_way() -> None:
    assert not rules.gives_way(0.00017)
    assert rules.gives_way(0.0003)
    assert not rules.gives_way(NAN)


def test_fingers_of_one_side_press_on_one_another() -> None:
    assert rules.both_press([3.9, 6.7])
    assert rules.both_press([0.7, 9.3])  # met elsewhere than its levers assume
    assert not rules.both_press([0.07, 4.0])
    assert rules.both_press([5.0])  # against what nothing moves


def test_the_other_side_presses_on_a_finger_that_bears_the_whole_force() -> None:
    assert rules.is_pressed([0.0, 2.1], 2.0)
    assert not rules.is_pressed([1.9, 0.0], 2.0)
    assert not rules.is_pressed([], 2.0)


def test_a_finger_at_its_end_may_oppose_what_it_does_not_feel() -> None:
    assert rules.may_oppose(None, left=0.001, tolerance=0.002)
    assert not rules.may_oppose(None, left=0.003, tolerance=0.002)  # it may still meet something
    assert not rules.may_oppose(False, left=0.0, tolerance=0.002)  # a sensor knows better
    assert not rules.may_oppose(None, left=NAN, tolerance=0.002)


def test_what_stops_a_finger_before_the_empty_hand_meets_itself_is_an_object() -> None:
    assert rules.came_as_far(0.80, 0.80, 0.05)
    assert rules.came_as_far(0.76, 0.80, 0.05)
    assert not rules.came_as_far(0.74, 0.80, 0.05)
    assert not rules.came_as_far(NAN, 0.80, 0.05)


def test_a_result_waits_until_the_force_has_settled() -> None:
    assert not rules.settled(steady=1.0, least=0.25, building=True)
    assert not rules.settled(steady=0.2, least=0.25, building=False)
    assert rules.settled(steady=0.25, least=0.25, building=False)


def test_a_slip_is_a_creep_a_drop_or_a_pull() -> None:
    assert rules.creeps(0.006, 0.01)
    assert not rules.creeps(0.004, 0.01)
    assert not rules.pulled(1.0, 1.0, 5.0, 5.0, 0.1)
    assert rules.pulled(0.6, 1.0, 5.0, 5.0, 0.1)
    assert rules.pulled(1.0, 1.0, 3.0, 5.0, 0.1)
    assert rules.pulled(1.0, 1.0, 6.0, 5.0, 0.1)
    assert not rules.pulled(1.0, 1.0, 0.15, 0.1, 0.1)  # noise of a sensor that feels little
    assert not rules.pulled(1.0, 1.0, NAN, NAN, 0.1)


def test_enough_fingers_are_one_on_each_side_or_so_many() -> None:
    sides = (frozenset({"index", "middle"}), frozenset({"thumb"}))
    everyone = {"index", "middle", "thumb"}
    assert not rules.enough_touch({"index", "middle"}, sides, everyone, 2)
    assert rules.enough_touch({"index", "thumb"}, sides, everyone, 2)
    assert rules.enough_touch({"index", "middle"}, (), everyone, 2)
    assert rules.enough_touch({"index"}, (), {"index"}, 2)
    assert rules.enough_touch({"claw"}, [frozenset({"jaw"}), frozenset({"claw"})], {"claw"}, 2)
    assert not rules.enough_touch(set(), (), everyone, 0)


@pytest.mark.parametrize(
    ("force", "still", "expected"),
    [
        (2.0, [True, True], True),
        (1.9, [True, True], False),
        (9.0, [True, False], False),  # it speeds up
        (NAN, [True], False),
    ],
)
def test_efforts_of_fingers_that_stand_still(
    force: float, still: list[bool], expected: bool
) -> None:
    assert rules.presses(force, 2.0, still) is expected


@pytest.mark.parametrize(
    ("effort", "weight", "share"),
    [
        (4.0, 1.0, 0.75),
        (-4.0, -1.0, 0.75),
        (1.0, 2.0, 0.0),
        (1.0, -1.0, 1.0),
        (0.0, 1.0, 0.0),
        (NAN, 1.0, 0.0),
    ],
)
def test_the_share_of_an_effort_that_presses(effort: float, weight: float, share: float) -> None:
    assert rules.pressing_share(effort, weight) == share
    assert rules.pressing_share(effort, NAN) == 0.0


@pytest.mark.parametrize(
    ("share", "now", "then", "rests"),
    [
        (1.0, 20.0, 10.0, True),  # as asked
        (0.9, 10.0, 10.0, False),  # too weak
        (1.2, 10.0, 10.0, True),  # the load pulls at the sensors
        (1.2, 12.0, 10.0, False),  # the fingers press more
        (1.2, NAN, NAN, True),
    ],
)
def test_a_force_rests_that_only_the_load_changes(
    share: float, now: float, then: float, rests: bool
) -> None:
    assert rules.force_rests(share, now, then) is rests
