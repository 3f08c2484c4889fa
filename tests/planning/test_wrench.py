"""What contacts resist, against values known by hand and against Qhull."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.spatial import ConvexHull

from rtee.planning.result import Contact
from rtee.planning.wrench import (
    EDGES,
    MOST_LOAD,
    PATCH,
    balanced,
    cones,
    least_squares,
    load,
    quality,
    wrenches,
)
from rtee.sample import FloatArray

RADIUS = 0.03


def _contact(point: FloatArray) -> Contact:
    """A contact on a ball around the origin."""
    inward = -point / np.linalg.norm(point)
    return Contact("tip", "finger", tuple(point), tuple(inward))


def _pinch(friction: float = 0.5) -> FloatArray:
    ends = [np.array([RADIUS, 0.0, 0.0]), np.array([-RADIUS, 0.0, 0.0])]
    return wrenches([_contact(end) for end in ends], friction, np.zeros(3), RADIUS)


def _around(number: int, count: int) -> FloatArray:
    generator = np.random.default_rng(number)
    points = generator.normal(size=(count, 3))
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    return wrenches([_contact(point) for point in points], 0.5, np.zeros(3), RADIUS)


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0), (0, 1, 0), (0.6, 0.0, 0.8), (-1, 2, -3)])
def test_edges_of_a_cone_have_its_slope(axis: tuple[float, float, float]) -> None:
    normal = np.array(axis) / np.linalg.norm(axis)
    edges = cones(normal[None], 0.4)[0]
    assert edges.shape == (EDGES, 3)
    assert edges @ normal == pytest.approx(np.ones(EDGES))
    assert np.linalg.norm(edges - normal, axis=1) == pytest.approx(np.full(EDGES, 0.4))


@pytest.mark.parametrize("dimensions", [2, 3, 6])
def test_quality_of_a_cross_polytope(dimensions: int) -> None:
    corners = np.vstack([np.eye(dimensions), -np.eye(dimensions)])
    assert quality(corners) == pytest.approx(1.0 / math.sqrt(dimensions))


@pytest.mark.parametrize("dimensions", [2, 3, 6])
def test_quality_of_a_cube(dimensions: int) -> None:
    corners = np.array(np.meshgrid(*[(-1.0, 1.0)] * dimensions)).T.reshape(-1, dimensions)
    assert quality(corners) == pytest.approx(1.0)


@pytest.mark.parametrize("friction", [0.2, 0.5, 1.0])
def test_quality_of_a_pinch_is_the_torque_about_its_line(friction: float) -> None:
    # Both contacts twist by 2/3 friction PATCH per newton, and nothing is resisted less.
    torsion = 2.0 / 3.0 * friction * PATCH / RADIUS
    assert quality(_pinch(friction)) == pytest.approx(torsion, rel=0.01)


@pytest.mark.parametrize("count", [2, 3, 4, 6, 8])
@pytest.mark.parametrize("number", range(4))
def test_quality_is_that_of_the_convex_hull(count: int, number: int) -> None:
    found = _around(10 * count + number, count)
    hull = ConvexHull(found, qhull_options="QJ")
    exact = max(0.0, float((-hull.equations[:, -1]).min()))
    # Qhull's joggled input moves the hull by about 1e-6.
    assert quality(found) == pytest.approx(exact, rel=0.02, abs=1e-5)


def test_contacts_on_one_side_hold_nothing() -> None:
    points = [np.array([RADIUS * math.cos(a), RADIUS * math.sin(a), 0.0]) for a in (0.0, 0.4, 0.8)]
    found = wrenches([_contact(point) for point in points], 0.5, np.zeros(3), RADIUS)
    assert not balanced(found)
    assert quality(found) == 0.0
    assert load(found, np.ones((len(found), 1)), np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])) == 0.0


def test_without_contacts_nothing_is_held() -> None:
    none = np.zeros((0, 6))
    assert not balanced(none)
    assert quality(none) == 0.0
    assert load(none, np.zeros((0, 1)), np.ones(6)) == 0.0


def test_edges_of_many_cones_are_those_of_each() -> None:
    normals = np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(0).normal(size=(20, 3))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    edges = cones(normals, 0.7)
    for normal, mine in zip(normals, edges, strict=True):
        assert mine @ normal == pytest.approx(np.ones(EDGES))
        assert np.linalg.norm(mine - normal, axis=1) == pytest.approx(np.full(EDGES, 0.7))
        assert mine.mean(axis=0) == pytest.approx(normal)  # all around


@pytest.mark.parametrize("number", range(10))
def test_least_squares_are_those_of_scipy(number: int) -> None:
    generator = np.random.default_rng(number)
    matrix, target = generator.normal(size=(8, 20)), generator.normal(size=8)
    if number % 2:
        matrix = np.abs(matrix)  # so that the target is out of reach
    found, residual = least_squares(matrix, target)
    assert (found >= 0.0).all()
    assert residual == pytest.approx(nnls(matrix, target)[1], abs=1e-7)


@pytest.mark.parametrize("number", range(10))
def test_least_squares_do_not_depend_on_where_they_begin(number: int) -> None:
    generator = np.random.default_rng(100 + number)
    matrix, target = generator.normal(size=(8, 20)), generator.normal(size=8)
    start = generator.uniform(0.0, 3.0, 20) * (generator.random(20) < 0.3)
    found, residual = least_squares(matrix, target, start)
    assert (found >= 0.0).all()
    assert residual == pytest.approx(nnls(matrix, target)[1], abs=1e-7)


@pytest.mark.parametrize(("friction", "grip"), [(0.5, 10.0), (0.25, 10.0), (0.5, 4.0)])
def test_a_pinch_carries_twice_friction_times_grip(friction: float, grip: float) -> None:
    # Each finger presses with up to `grip` newtons: the effort of its own actuator.
    found = _pinch(friction)
    per_finger = EDGES + 2
    torques = np.zeros((len(found), 2))
    torques[:per_finger, 0] = torques[per_finger:, 1] = 1.0 / grip
    weight = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    # An edge points along the weight, or nearly: the cone has eight of them.
    assert load(found, torques, weight) == pytest.approx(2.0 * friction * grip, rel=0.1)


def test_loads_are_told_up_to_a_limit() -> None:
    found = _pinch()
    weight = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    assert load(found, np.zeros((len(found), 0)), weight) == MOST_LOAD


@pytest.mark.parametrize("number", range(5))
def test_a_quality_below_the_least_is_only_told_to_be_below(number: int) -> None:
    found = _around(number, 12)
    exact = quality(found)
    assert exact > 0.0
    assert quality(found, 0.9 * exact) == exact
    assert exact - 1e-9 <= quality(found, 1.5 * exact) < 1.5 * exact


def test_of_several_weights_the_one_that_is_carried_least_counts() -> None:
    # The fingers' own actuators press with up to 10 N, and nothing limits what they stand.
    found = _pinch()
    torques = np.zeros((len(found), 2))
    torques[: EDGES + 2, 0] = torques[EDGES + 2 :, 1] = 0.1
    down = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    pulls = np.array([down, [0.0, 1.0, -1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -0.5, 0.0, 0.0, 0.0]])
    together = load(found, torques, pulls)
    # Loads are found to 6 %.
    assert together == pytest.approx(min(load(found, torques, p) for p in pulls), rel=0.13)
    assert together < 0.8 * load(found, torques, down)
    assert load(found, torques, down, 100.0) < 100.0
    assert load(found, torques, down, 1.0) == load(found, torques, down)
