from __future__ import annotations

import numpy as np
import pytest

from rtee.extract.descent import Objective, Slope, descend
from rtee.extract.polish import polish
from rtee.extract.resolution import FINE
from rtee.sample import FloatArray


def bowl(centre: FloatArray, scales: FloatArray) -> Objective:
    def function(y: FloatArray) -> tuple[float, Slope]:
        step = y - centre
        return float(scales @ step**2), lambda: 2.0 * scales * step

    return function


def pieces(slopes: FloatArray, offsets: FloatArray) -> Objective:
    """Return the maximum of linear functions."""

    def function(y: FloatArray) -> tuple[float, Slope]:
        values = slopes @ y + offsets
        i = int(np.argmax(values))
        return float(values[i]), lambda: slopes[i].copy()

    return function


def test_descent_finds_the_bottom_of_a_bowl() -> None:
    centre = np.array([0.3, 0.6, 0.8, 0.1])
    function = bowl(centre, np.array([1.0, 100.0, 5.0, 20.0]))
    found = descend(function, np.full(4, 0.5), evaluations=200, resolution=FINE)
    np.testing.assert_allclose(found.y, centre, atol=1e-4)


def test_descent_stays_in_the_box_and_slides_along_its_faces() -> None:
    function = bowl(np.array([-1.0, 0.4, 2.0]), np.array([1.0, 30.0, 1.0]))
    found = descend(function, np.full(3, 0.5), evaluations=200, resolution=FINE)
    np.testing.assert_allclose(found.y, [0.0, 0.4, 1.0], atol=1e-4)


def test_descent_respects_a_smaller_box() -> None:
    function = bowl(np.array([0.9, 0.9]), np.ones(2))
    bounds = (np.array([0.0, 0.1]), np.array([0.5, 0.2]))
    np.testing.assert_allclose(
        descend(function, np.ones(2), evaluations=50, bounds=bounds, resolution=FINE).y,
        [0.5, 0.2],
        atol=FINE.coordinate,
    )


def test_descent_counts_and_limits_its_evaluations() -> None:
    calls = 0
    inner = pieces(np.random.default_rng(0).normal(size=(30, 5)), np.zeros(30))

    def function(y: FloatArray) -> tuple[float, Slope]:
        nonlocal calls
        calls += 1
        return inner(y)

    found = descend(function, np.full(5, 0.5), evaluations=25)
    assert found.evaluations == calls <= 25 + 10


def test_descent_stops_where_it_is_good_enough() -> None:
    function = bowl(np.array([0.2, 0.2]), np.ones(2))
    found = descend(function, np.ones(2), evaluations=100, enough=0.5)
    assert found.value <= 0.5
    assert found.evaluations < 6


@pytest.mark.parametrize("seed", range(8))
def test_polishing_reaches_the_vertex_of_a_kinked_valley(seed: int) -> None:
    scipy_optimize = pytest.importorskip("scipy.optimize")
    random = np.random.default_rng(seed)
    slopes, offsets = random.normal(size=(12, 4)), 0.2 * random.normal(size=12)
    best = scipy_optimize.linprog(
        [0, 0, 0, 0, 1],
        A_ub=np.column_stack([slopes, -np.ones(12)]),
        b_ub=-offsets,
        bounds=[(0, 1)] * 4 + [(None, None)],
    ).fun
    found = polish(pieces(slopes, offsets), np.full(4, 0.5), evaluations=120)
    assert found.value == pytest.approx(best, abs=2e-3)


def test_polishing_improves_where_descent_stalls() -> None:
    slopes = np.array([[1.0, 20.0], [1.0, -20.0], [-3.0, 0.0]])
    offsets = np.array([-10.0, 10.0, 0.3])
    function = pieces(slopes, offsets)
    found = polish(function, np.array([0.9, 0.45]), evaluations=60)
    assert found.value == pytest.approx(0.075, abs=1e-4)
