"""When an object counts as held."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rtee.sample import FloatArray
from rtee.trials.holding import TURN, reports_loss, turned
from rtee.types import Event, Result


def about(axis: int, angle: float) -> FloatArray:
    """Return a rotation about an axis of the frame ``(3, 3)``."""
    turn = np.eye(3)
    one, other = (axis + 1) % 3, (axis + 2) % 3
    turn[one, one] = turn[other, other] = math.cos(angle)
    turn[one, other], turn[other, one] = -math.sin(angle), math.sin(angle)
    return turn


@pytest.mark.parametrize(
    ("shape", "axis", "seen"),
    [
        ("box:0.02x0.02x0.1", 2, True),
        ("drill", 0, True),
        ("cylinder:0.01x0.1", 2, False),
        ("cylinder:0.01x0.1", 0, True),
        ("sphere:0.03", 1, False),
    ],
)
def test_a_turn_counts_where_it_can_be_seen(shape: str, axis: int, seen: bool) -> None:
    assert turned(shape, np.eye(3), about(axis, 2.0 * TURN)) == pytest.approx(
        2.0 * TURN if seen else 0.0, abs=1e-6
    )


def test_a_hand_has_lost_an_object_when_all_fingers_have() -> None:
    result = Result("1", "Grasp", grasped=True, grasped_fingers=("index", "thumb"))
    one = Event("grasp_lost", "thumb", "", 0.0, "warning")
    other = Event("grasp_lost", "index, middle", "", 0.1, "warning")
    assert not reports_loss(result, [one, Event("contact", "index", "", 0.0)])
    assert reports_loss(result, [one, other])
