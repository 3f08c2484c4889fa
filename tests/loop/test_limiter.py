"""The limiter trusts nobody: any set-points, at any time."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.loop.motion import Limiter, MotionLimits

LIMITS = MotionLimits((0.0, -1.0), (1.0, 1.0), (2.0, 0.5), (20.0, 5.0), (400.0, 100.0))
DT = 0.01
ANYTHING = st.one_of(
    st.floats(-3, 3), st.sampled_from([math.nan, math.inf, -math.inf, 0.0, 1.0, -1.0, 1e300])
)
WANTED = st.lists(st.tuples(ANYTHING, ANYTHING), min_size=1, max_size=80)
START = st.tuples(st.floats(-0.5, 1.5), st.floats(-1.5, 1.5))


@given(WANTED, START)
def test_nothing_that_leaves_it_exceeds_a_limit(
    wanted: list[tuple[float, float]], start: tuple[float, float]
) -> None:
    limiter = Limiter(LIMITS, DT)
    for i, position in enumerate(start):
        limiter.seed(i, position)
    here, speed = list(start), [0.0, 0.0]
    for target in wanted:
        limiter.apply(target)
        for i, position in enumerate(limiter.position):
            assert math.isfinite(position)
            velocity = (position - here[i]) / DT
            assert abs(velocity) <= LIMITS.velocity[i] * (1 + 1e-5)
            assert abs(velocity - speed[i]) <= LIMITS.acceleration[i] * DT * (1 + 1e-5)
            assert position <= max(LIMITS.upper[i], here[i]) + 1e-12
            assert position >= min(LIMITS.lower[i], here[i]) - 1e-12
            here[i], speed[i] = position, velocity


@given(START, st.tuples(st.floats(0, 1), st.floats(-1, 1)))
def test_any_target_is_reached_without_passing_it(
    start: tuple[float, float], target: tuple[float, float]
) -> None:
    limiter = Limiter(LIMITS, DT)
    for i, position in enumerate(start):
        limiter.seed(i, position)
    for _ in range(2000):
        limiter.apply(target)
        for i in range(2):
            low, high = sorted((start[i], target[i]))
            assert low - 1e-9 <= limiter.position[i] <= high + 1e-9
    assert limiter.position == pytest.approx(list(target), abs=1e-9)
    assert not limiter.apply(limiter.position)


def test_a_step_limit_bounds_every_tick() -> None:
    limiter = Limiter(LIMITS, DT, max_step=0.001)
    limiter.seed(0, 0.0)
    limiter.seed(1, 0.0)
    before = 0.0
    for _ in range(50):
        assert limiter.apply((1.0, 0.0))
        assert limiter.limited == [True, False]
        assert limiter.position[0] - before <= 0.001 + 1e-12
        before = limiter.position[0]
    assert before > 0.03


def test_nan_stops_and_is_never_kept() -> None:
    limiter = Limiter(LIMITS, DT)
    limiter.seed(0, 0.2)
    limiter.seed(1, 0.0)
    for _ in range(20):
        limiter.apply((0.9, 0.0))
    for _ in range(50):
        limiter.apply((math.nan, math.nan))
    stopped = list(limiter.position)
    limiter.apply((math.nan, math.nan))
    assert limiter.position == stopped
    assert limiter.velocity == [0.0, 0.0]
    with pytest.raises(ValueError, match="finite"):
        limiter.seed(0, math.nan)
