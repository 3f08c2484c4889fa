"""Wrenches that contacts resist: closure, quality of a grasp, and the load it can carry.

A wrench is a force and a torque about the object's centre of mass, the torque divided by a length
(the object's greatest distance from there), so that both are forces [N]. All is done in numpy:

- A cone of friction is linearised by `EDGES` edges (Kerr and Roth, 1986). A contact is a small
  patch, not a point, so it also resists a torque about its normal: a soft finger (Howard and Kumar,
  1996), of a disc of even pressure ``2/3 friction PATCH`` per newton.
- The quality is that of Ferrari and Canny (1992), Q1: the radius of the largest ball around the
  origin inside the convex hull of the wrenches that contacts of unit normal force exert. With the
  support function ``h(d) = max_i w_i d``, it is the least ``h`` on the unit sphere. That is sought
  from many directions at once by descent on a smooth maximum; the best of them are led on to the
  facet of the hull near them by an active-set method. The result is the distance of a facet,
  and that of the nearest one in all but rare cases (`tests/planning` compare with Qhull).
- Whether the origin is inside, and whether a load is carried, are problems of non-negative least
  squares, solved by the method of Lawson and Hanson (1974, chapter 23).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from typing import Final

import numpy as np

from rtee.hand.halton import halton
from rtee.hand.linalg import cross
from rtee.planning.result import Contact
from rtee.sample import FloatArray

EDGES: Final = 8
"""Edges of a linearised cone of friction; its force is up to 8 % too small between two edges."""

_CIRCLE: Final = np.array(
    [
        (math.cos(2.0 * math.pi * i / EDGES), math.sin(2.0 * math.pi * i / EDGES))
        for i in range(EDGES)
    ]
)
"""Directions of these edges around the normal, unit vectors ``(EDGES, 2)``."""

PATCH: Final = 0.004
"""Radius of the contact patch of a fingertip [m]: that of a flattened rubber pad."""

GRAVITY: Final = 9.81
"""Acceleration of free fall [m/s²]."""

MOST_LOAD: Final = 50.0
"""Loads are computed up to this multiple of the object's weight; more does not limit a grasp."""

_STARTS: Final = 96
"""Directions from which the least support is sought: a few for each of the 64 orthants."""

_SHARPENING: Final = (8.0, 32.0, 128.0)
"""Sharpness of the smooth maximum, step by step."""

_DESCENT: Final = 6
"""Steps at each sharpness."""

_CLIMBS: Final = 6
"""Facets that are compared: the nearest that the descent leads to."""

_SAME: Final = 0.99
"""Directions with this cosine lead to the same facet."""

_PIVOTS: Final = 40
"""Steps to a facet; a polytope of six dimensions takes about twelve."""

_CLOSED: Final = 1e-6
"""Residual below which a system of unit vectors counts as solved."""

_LEAST_LOAD: Final = 0.05
"""A grasp that carries less than this share of the weight counts as carrying nothing."""

_HALVINGS: Final = 7
"""Halvings of the interval in which the load is sought, in logarithms: to 6 %."""


def cones(normals: FloatArray, friction: float) -> FloatArray:
    """Return the edges ``(k, EDGES, 3)`` of cones of friction about unit normals into the object.

    Each is of unit normal force.
    """
    # Crossed with the axis farthest from the normal, so that the product is never near zero. Of
    # equal ones x comes first, then y.
    size = np.abs(normals)
    least = size.min(axis=1)
    axes = np.where(size[:, 0] <= least, 0, np.where(size[:, 1] <= least, 1, 2))
    first = cross(np.eye(3)[axes], normals)
    first /= np.sqrt((first * first).sum(axis=1, keepdims=True))
    second = cross(normals, first)
    return normals[:, None] + friction * (_CIRCLE @ np.stack([first, second], axis=1))


def wrenches(
    contacts: Sequence[Contact], friction: float, centre: FloatArray, length: float
) -> FloatArray:
    """Return the wrenches ``(k, 6)`` of contacts of unit normal force [N].

    Args:
        contacts: The contacts.
        friction: Coefficient of friction.
        centre: The object's centre of mass ``(3,)`` [m].
        length: What torques are divided by [m].

    Returns:
        `EDGES` + 2 wrenches for each contact: the edges of its cone, and its normal with a torque
        about it to either side.
    """
    if not contacts:
        return np.zeros((0, 6))
    # Moment of friction of a disc under even pressure.
    torsion = 2.0 / 3.0 * friction * PATCH / length
    normals = np.array([contact.normal for contact in contacts])
    arms = (np.array([contact.point for contact in contacts]) - centre)[:, None]
    forces = np.empty((len(contacts), EDGES + 2, 3))
    forces[:, :EDGES], forces[:, EDGES:] = cones(normals, friction), normals[:, None]
    torques = cross(arms, forces) / length
    torques[:, EDGES] += torsion * normals
    torques[:, EDGES + 1] -= torsion * normals
    return np.concatenate([forces, torques], axis=2).reshape(-1, 6)


def least_squares(
    matrix: FloatArray, target: FloatArray, start: FloatArray | None = None
) -> tuple[FloatArray, float]:
    """Solve ``min |matrix x - target|`` with ``x >= 0`` (Lawson and Hanson, 1974, algorithm NNLS).

    Args:
        matrix: ``(m, n)``.
        target: ``(m,)``.
        start: Where the search begins, not negative ``(n,)``: near the solution, it takes few
            steps.

    Returns:
        ``x`` ``(n,)``, and the residual's norm.
    """
    count = matrix.shape[1]
    x = np.zeros(count) if start is None else start.copy()
    used = x > 0.0
    # Solve for the variables of the initial guess before another one enters.
    settled = not used.any()
    enough = 1e-10 * max(1.0, float(np.abs(matrix).max(initial=0.0)))
    # The limit of the authors' own code: rounding could make the exchange go on for ever.
    for _ in range(3 * count):
        if settled:
            gradient = (target - matrix @ x) @ matrix
            gradient[used] = -np.inf
            best = int(gradient.argmax()) if count else 0
            if used.all() or gradient[best] <= enough:
                break
            used[best] = True
        settled = True
        while True:
            columns = np.flatnonzero(used)
            if not len(columns):
                break
            shares = _shares(matrix[:, columns], target, enough)
            if shares.min() > 0.0:
                x = np.zeros(count)
                x[columns] = shares
                break
            # Move towards the trial point until the first share becomes zero.
            before = x[columns]
            below = shares <= 0.0
            ratio = before[below] / np.maximum(before[below] - shares[below], 1e-300)
            after = before + float(ratio.min()) * (shares - before)
            left = after <= 1e-12
            if not left.any():  # rounding: drop what would be negative
                left = below
            after[left] = 0.0
            x = np.zeros(count)
            x[columns] = after
            used[columns[left]] = False
    return x, float(np.linalg.norm(matrix @ x - target))


def _shares(part: FloatArray, target: FloatArray, enough: float) -> FloatArray:
    """Return ``x`` of the least ``|part x - target|``, of any sign, to a gradient of ``enough``."""
    # The normal equations take a quarter of the time of `lstsq`, and do for columns that are not
    # nearly dependent; the gradient says whether they did.
    with suppress(np.linalg.LinAlgError):
        shares = np.asarray(np.linalg.solve(part.T @ part, target @ part), dtype=np.float64)
        if np.abs((target - part @ shares) @ part).max() <= enough:
            return shares
    return np.asarray(np.linalg.lstsq(part, target, rcond=None)[0], dtype=np.float64)


def balanced(vectors: FloatArray) -> bool:
    """Return whether non-negative shares of vectors ``(k, d)``, not all zero, add up to zero."""
    if len(vectors) < 2:
        return False
    # Only directions matter here, and equal lengths keep the residual comparable.
    lengths = np.linalg.norm(vectors, axis=1)
    # The row of ones rules out that all shares are zero.
    system = np.vstack([vectors.T / lengths, np.ones(len(vectors))])
    target = np.zeros(len(system))
    target[-1] = 1.0
    return least_squares(system, target)[1] < 1e-3


def quality(found: FloatArray, least: float = 0.0) -> float:
    """Return the radius of the largest ball of wrenches that a grasp resists (Ferrari and Canny).

    Args:
        found: Wrenches of contacts of unit normal force ``(k, 6)``; see `wrenches`.
        least: A smaller radius need not be exact, only smaller than this [N].

    Returns:
        The radius [N]; 0 where some wrench is not resisted at all.
    """
    if len(found) < 2:
        return 0.0
    size = float(np.linalg.norm(found, axis=1).max())
    directions = _starts(found.shape[1])
    # The support function has edges; smoothed ones, ever sharper, let a descent pass them.
    for sharpness in _SHARPENING:
        for _ in range(_DESCENT):
            weight = directions @ found.T
            highest = weight.max(axis=1, keepdims=True)
            # The ball reaches no farther than the hull does in any direction.
            if least > 0.0 and highest.min() < least:
                return max(0.0, float(highest.min()))
            # Relative to the largest exponent, so that exp does not overflow. In place: these are
            # a hundred by a few hundred numbers, and new arrays take as long as the exponents.
            weight -= highest
            weight *= sharpness / size
            np.exp(weight, out=weight)
            weight /= weight.sum(axis=1, keepdims=True)
            slope = weight @ found
            # Directions stay on the unit sphere: only the tangential part counts.
            slope -= (slope * directions).sum(axis=1, keepdims=True) * directions
            directions = directions - slope / (size * sharpness)
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # A flat hull contains no ball, and its polar has no vertices to climb to.
    if not balanced(found) or np.linalg.matrix_rank(found, tol=1e-9) < found.shape[1]:
        return 0.0
    support = (directions @ found.T).max(axis=1)
    best = np.argsort(support, kind="stable")
    # The origin is on the hull's surface, or outside of it by rounding.
    if support[best[0]] <= _CLOSED * size:
        return 0.0
    chosen: list[int] = []
    for i in best.tolist():
        if all(float(directions[i] @ directions[j]) < _SAME for j in chosen):
            chosen.append(i)
        if len(chosen) == _CLIMBS:
            break
    return min(1.0 / _climb(found, directions[i] / support[i]) for i in chosen)


def _climb(found: FloatArray, start: FloatArray) -> float:
    """Return the norm of a vertex of the polar polytope ``{x: found x <= 1}``, uphill of a point.

    Facets of the hull of the points ``(k, d)`` are vertices of its polar, and the nearer a facet
    the longer its vertex. The path runs along faces of ever smaller dimension, then from vertex to
    vertex along edges that lead away from the origin.
    """
    x, active = start, list[int]()
    for _ in range(_PIVOTS):
        if active:
            basis = found[active]
            shares = np.linalg.lstsq(basis.T, x, rcond=None)[0]
            direction = x - basis.T @ shares
        else:
            shares, direction = np.zeros(0), x
        if float(np.linalg.norm(direction)) <= 1e-9 * float(np.linalg.norm(x)):
            # At a vertex of these faces; a negative share says which one to leave.
            if not len(shares) or shares.min() >= -1e-9 * np.abs(shares).max():
                break
            left = int(np.argmin(shares))
            others = found[active[:left] + active[left + 1 :]]
            direction = -found[active[left]]
            if len(others):
                shares_of = np.linalg.lstsq(others.T, direction, rcond=None)[0]
                direction = direction - others.T @ shares_of
            del active[left]
        rate = found @ direction
        # The path stays on these faces; rounding must not make one of them the next to be met.
        rate[active] = 0.0
        room = np.where(rate > 1e-12, (1.0 - found @ x) / np.maximum(rate, 1e-12), np.inf)
        nearest = int(np.argmin(room))
        if not np.isfinite(room[nearest]):
            break
        # By rounding, the point may be just beyond a face: that is not a step back.
        x = x + max(0.0, float(room[nearest])) * direction
        active.append(nearest)
    return float(np.linalg.norm(x))


@cache
def _starts(dimensions: int) -> FloatArray:
    """Return unit vectors ``(_STARTS + 2 dimensions, dimensions)``: the axes, and all over."""
    spread = 2.0 * halton(dimensions, _STARTS) - 1.0
    starts = np.vstack([np.eye(dimensions), -np.eye(dimensions), spread])
    result: FloatArray = starts / np.linalg.norm(starts, axis=1, keepdims=True)
    return result


def load(
    found: FloatArray,
    torques: FloatArray,
    weights: FloatArray,
    least: float = 0.0,
) -> float:
    """Return how many times a weight a grasp can carry with the efforts of the actuators.

    Where several weights are given, as for an object accelerated in either direction, each must be
    carried this many times, one at a time.

    Args:
        found: Wrenches of contacts of unit normal force ``(k, 6)``; see `wrenches`.
        torques: Effort that each takes of each actuator with an effort limit, as a fraction of
            that limit ``(k, a)``.
        weights: Wrenches of the object's weight ``(6,)`` or ``(p, 6)`` [N].
        least: A smaller multiple need not be exact, only smaller than this.

    Returns:
        The multiple, from 0 to `MOST_LOAD`.
    """
    weights = np.atleast_2d(weights)
    heavy = float(np.linalg.norm(weights[0]))
    if not len(found) or heavy <= 0.0:
        return 0.0
    # Both directions of each actuator; one in which nothing drives it needs no limit.
    upper = np.vstack([torques.T, -torques.T]) * heavy
    upper = upper[upper.max(axis=1) > 0.0]
    # Columns: normal forces in units of the weight, then what is left of each effort.
    limits, count = len(upper), len(found)
    system = np.block([[found.T, np.zeros((6, limits))], [upper, np.eye(limits)]])
    # Columns of equal length: `least_squares` compares all gradients with one bound.
    scale = np.maximum(np.linalg.norm(system[:, :count], axis=0), 1e-9)
    system[:, :count] /= scale
    # Without a load there is no force, and all of each effort is left.
    starts = [np.concatenate([np.zeros(count), np.ones(limits)])] * len(weights)
    order = list(range(len(weights)))

    def carried(times: float) -> bool:
        for place, k in enumerate(order):
            target = np.concatenate([-times * weights[k] / heavy, np.ones(limits)])
            starts[k], residual = least_squares(system, target, starts[k])
            if residual >= _CLOSED * 1e2 * max(1.0, times):
                # A load that was too heavy once is likely to be so again, and is checked first.
                order.insert(0, order.pop(place))
                return False
        return True

    if not carried(_LEAST_LOAD):
        return 0.0
    if least > _LEAST_LOAD and not carried(least):
        return _LEAST_LOAD
    if carried(MOST_LOAD):
        return MOST_LOAD
    # Halving works: the loads that can be carried are an interval from 0, since the solutions
    # are convex and a load of 0 takes no force.
    low, high = _LEAST_LOAD, MOST_LOAD
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if carried(middle) else (low, middle)
    return low
