"""A person's hand, by its points, moves a hand's actuators."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rtee.retarget import LAYOUTS, Layout, Retargeter, Side, TrackingError
from rtee.retarget.retargeter import _MEET
from rtee.testing.human_hand import HumanHand

HUMAN = HumanHand()
FIST = HUMAN.points((1.0,) * 5)


def held(
    retargeter: Retargeter, points: object, begin: float, frames: int = 30
) -> dict[str, float]:
    """Return the answer to points that stay, from a time on [s]."""
    return [retargeter.step(points, begin + k / 30) for k in range(1, frames + 1)][-1]


@pytest.mark.parametrize(
    ("hand", "finger"),
    [("leap_hand", "index"), ("schunk_svh", "middle"), ("ability_hand", "index")],
)
def test_tips_meet_where_the_persons_do(hand: str, finger: str) -> None:
    retargeter = Retargeter.of(hand)
    number = ("thumb", "index", "middle").index(finger)
    apart = held(retargeter, HUMAN.points(), 0.0)
    assert retargeter.gap(apart, "thumb", finger) > 0.05
    met = held(retargeter, HUMAN.points(pinch=(number, 0.018)), 1.0)
    assert abs(retargeter.gap(met, "thumb", finger)) < 0.001
    for actuator in retargeter.hand.actuators:
        assert actuator.lower <= met[actuator.name] <= actuator.upper


def test_the_way_into_a_pinch_and_out_has_no_jump() -> None:
    retargeter = Retargeter.of("leap_hand")
    far = _MEET[1] + 0.015  # beyond where the pinch begins to count
    distances = np.concatenate([np.linspace(far, 0.015, 85), np.linspace(0.015, far, 85)])
    answers = []
    for k, distance in enumerate(distances):
        points = HUMAN.points(pinch=(1, float(distance)))
        answers.append([*retargeter.step(points, k / 60).values()])
    # The person's tip moves 43 mm/s.
    assert np.abs(np.diff(answers[5:], axis=0)).max() < 0.1


def test_one_motor_closes_as_the_hand_does() -> None:
    retargeter = Retargeter.of("qb_softhand")
    opened = held(retargeter, HUMAN.points(), 0.0)["qbhand_synergy_joint"]
    closed = held(retargeter, FIST, 1.0)["qbhand_synergy_joint"]
    assert opened < 0.1
    assert closed > 0.5


def test_a_gripper_opens_as_far_as_the_nearest_tips() -> None:
    retargeter = Retargeter.of("wsg50")
    wide = retargeter.gap(held(retargeter, HUMAN.points(), 0.0), "left", "right")
    shut = held(retargeter, HUMAN.points(pinch=(3, 0.018)), 1.0)
    assert wide > 0.09
    assert abs(retargeter.gap(shut, "left", "right")) < 0.001


@pytest.mark.parametrize("side", [*Side])
def test_frames_and_sides_do_not_matter(side: Side) -> None:
    points = HUMAN.points((0.2, 0.5, 0.3, 0.6, 0.1))
    there = held(Retargeter.of("leap_hand"), points, 0.0)
    turn = np.linalg.qr(np.array([[1.0, 2.0, 3.0], [0.0, 1.0, -1.0], [2.0, 0.0, 1.0]]))[0]
    mirror = -1.0 if (np.linalg.det(turn) < 0.0) == (side is Side.RIGHT) else 1.0
    moved = mirror * points @ turn.T + 0.3
    again = held(Retargeter.of("leap_hand", side=side), moved, 0.0)
    assert again == pytest.approx(there, abs=1e-6)


def test_layouts_say_the_same() -> None:
    points = HUMAN.points((0.2, 0.5, 0.3, 0.6, 0.1))
    there = held(Retargeter.of("leap_hand"), points, 0.0, frames=3)
    for layout in (LAYOUTS["webxr"], LAYOUTS["manus"], LAYOUTS["mano"], LAYOUTS["leap"]):
        given = np.zeros((layout.count, 3))
        for row, part in enumerate(layout.order):
            given[list(part)] = points[row] / layout.unit
        if layout.name == "leap":
            # The wrist is not among its points, but the mean of the metacarpals' ends.
            given[[4, 9, 14, 19]] = 1e3 * points[0]
        again = held(Retargeter.of("leap_hand", layout=layout), given, 0.0, frames=3)
        assert again == pytest.approx(there, abs=1e-9)


def test_a_layout_that_names_no_hand() -> None:
    with pytest.raises(ValueError, match="21 points"):
        Layout("mine", ((0,),) * 20, 21)


BACKWARDS = FIST * [-1.0, 1.0, 1.0]
WITH_NAN = HUMAN.points()
WITH_NAN[7, 1] = np.nan


@pytest.mark.parametrize(
    ("points", "stamp", "said"),
    [
        (WITH_NAN, 2.0, "point 7"),
        (HUMAN.points()[:20], 2.0, "21 points"),
        (HUMAN.points() * 1000.0, 2.0, "metres"),
        ("nonsense", 2.0, "rows of 3 numbers"),
        (HUMAN.points(), 0.5, "later than the last"),
        (HUMAN.points(), np.nan, "later than the last"),
        (HUMAN.points(), "2", "later than the last one's, .*, not '2'"),
        (HUMAN.points(), None, "later than the last one's, .*, not None"),
    ],
)
def test_bad_points_move_nothing(points: object, stamp: Any, said: str) -> None:
    retargeter = Retargeter.of("leap_hand")
    before = held(retargeter, HUMAN.points((0.3,) * 5), 0.0)
    with pytest.raises(TrackingError, match=said):
        retargeter.step(points, stamp)
    assert retargeter.step(None, 2.0) == before


def test_a_hand_of_the_other_side_is_refused() -> None:
    retargeter = Retargeter.of("leap_hand")
    with pytest.raises(TrackingError, match="left hand"):
        retargeter.step(BACKWARDS, 0.0)
    Retargeter.of("leap_hand", side="left").step(BACKWARDS, 0.0)


def test_outliers_are_dropped_and_a_lost_hand_is_held() -> None:
    retargeter = Retargeter.of("leap_hand")
    before = held(retargeter, HUMAN.points((0.3,) * 5), 0.0)
    wrong = HUMAN.points((0.3,) * 5)
    wrong[8] += 0.3
    assert retargeter.step(wrong, 1.1) == before
    assert retargeter.dropped == 1
    assert retargeter.step(None, 1.2) == before
    # Found anew elsewhere: on the way there, not at once.
    after = retargeter.step(FIST, 3.0)
    spans = {a.name: a.upper - a.lower for a in retargeter.hand.actuators}
    assert 0.0 < max(abs(after[n] - before[n]) / spans[n] for n in after) < 0.3
