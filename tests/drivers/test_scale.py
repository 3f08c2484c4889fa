"""Counts and SI units."""

from __future__ import annotations

import math

import pytest

from rtee.drivers.scale import LinearScale

FALLING = LinearScale((10.0, 210.0), (0.5, -0.5))


def test_both_points_and_the_line_between_them() -> None:
    assert [FALLING.to_si(raw) for raw in (10, 110, 210)] == [0.5, 0.0, -0.5]
    assert [FALLING.to_raw(si) for si in (0.5, 0.0, -0.5)] == [10.0, 110.0, 210.0]
    assert FALLING.to_si(310) == pytest.approx(-1.0)
    assert FALLING.gain == pytest.approx(-1.0 / 200.0)


@pytest.mark.parametrize(
    ("si", "count"), [(0.0024, 110), (0.0026, 109), (9.0, 10), (math.inf, 10), (-math.inf, 210)]
)
def test_a_count_is_the_nearest_one_that_the_device_takes(si: float, count: int) -> None:
    assert FALLING.to_count(si) == count


def test_a_device_may_take_more_than_what_lies_between_the_points() -> None:
    scale = LinearScale((3.0, 230.0), (0.0, 0.8), ends=(0.0, 255.0))
    assert scale.to_count(-1.0) == 0
    assert scale.to_count(0.8 * 252 / 227) == 255
    assert [scale.to_count(scale.to_si(count)) for count in range(256)] == list(range(256))
