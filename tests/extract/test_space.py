from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from extract.models import Model, box
from rtee.extract.space import make_space, real_limits, rounded, widened_limits
from rtee.hand.model import Hand

TIP = box((0.01, 0.01, 0.01))


def chain(folder: Path, *joints: tuple[str, float, float]) -> Hand:
    model, parent = Model(), "base"
    for i, (kind, lower, upper) in enumerate(joints):
        model.link(f"l{i}", TIP).joint(f"j{i}", parent, f"l{i}", kind=kind, limits=(lower, upper))
        parent = f"l{i}"
    return model.finger("finger", parent).load(folder)


def test_widened_limits_contain_the_real_ones(tmp_path: Path) -> None:
    hand = chain(
        tmp_path,
        ("revolute", -0.2, 0.5),
        ("revolute", 0, 4.0),
        ("prismatic", 0.01, 0.03),
        ("prismatic", -0.02, 0),
        ("continuous", 0, 0),
    )
    lower, upper = widened_limits(hand)
    np.testing.assert_allclose(lower, [-math.pi, -math.pi, -0.01, -0.04, -math.pi])
    np.testing.assert_allclose(upper, [math.pi, 4.0, 0.05, 0.02, math.pi])


def test_a_continuous_actuator_is_searched_over_one_turn(tmp_path: Path) -> None:
    lower, upper = real_limits(chain(tmp_path, ("continuous", 0, 0)))
    assert (lower[0], upper[0]) == (-math.pi, math.pi)


def test_coordinates_and_postures_are_inverse(tmp_path: Path) -> None:
    hand = chain(tmp_path, ("revolute", -0.2, 0.5), ("prismatic", 0, 0.1), ("revolute", 0, 1))
    space = make_space(hand, [2, 0], real_limits(hand))
    y = np.array([0.25, 0.75])
    u = space.posture(y)
    assert u[1] == hand.rest[1]
    np.testing.assert_allclose(space.coordinates(u), y)
    np.testing.assert_allclose(space.posture(space.rest), hand.rest)


@given(st.lists(st.floats(0, 1), min_size=2, max_size=2))
def test_rounded_postures_stay_within_the_limits(shares: list[float]) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        hand = chain(
            Path(folder), ("revolute", -0.123456789, 0.98765432149), ("revolute", 1e-7, 0.1)
        )
    u = hand.lower + np.array(shares) * (hand.upper - hand.lower)
    stored = rounded(hand, u)
    assert (stored >= hand.lower).all()
    assert (stored <= hand.upper).all()
    # At a limit, a unit and a half may be missing: tips that just touch there would not before it.
    at_limit = (stored == hand.lower) | (stored == hand.upper)
    assert (np.abs(stored - u) <= np.where(at_limit, 2.1e-6, 5.1e-7)).all()
    np.testing.assert_array_equal(rounded(hand, stored), stored)
