"""Simplification of convex parts for searches: fewer vertices, and no parts inside others."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import coal
import numpy as np
from numpy.typing import NDArray

from rtee.hand.geometry import Shape, hull_of
from rtee.hand.linalg import rotated
from rtee.sample import FloatArray

SLACK: Final = 1e-4
"""Largest distance of a coarse shape below a mesh's hull [m]; real hands differ more from their
models."""

_SIMPLE: Final = 200
"""Number of vertices below which simplifying a hull gains little: Coal climbs along its edges."""

_DIRECTIONS: Final = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float
)
"""Directions of the first vertices of a coarse shape: to a cube's faces, edges and corners."""

_SIDES: Final = 16
"""Number of sides of the prism that replaces a cylinder: Coal compares all of up to 32 corners, and
keeps nothing from one query to the next."""

_THICK: Final = 6.0
"""Largest distance of such a prism below its cylinder, in units of the slack; thicker cylinders get
more sides."""

_MOST_SIDES: Final = 240
"""Maximum number of sides: with more, a corner of the prism's cap would have more neighbours than
Coal can count (255). Cylinders of up to 1.1 m radius need fewer."""

_TURN: Final = 0.37
"""Rotation of that prism about its axis, as a share of a side: not a simple fraction, so that its
faces are parallel to few others."""

_ROUNDED: Final = 2e-9
"""Upper bound on the displacement of corners by rounding to a nanometre [m]."""

_EQUAL: Final = 1e-9
"""Difference of heights below which vertices are equally far out [m]: the hull gets all of them, as
otherwise the last digit would choose between those of a symmetric mesh."""

_ROUNDS: Final = 12
"""Maximum number of rounds of adding vertices, each of which about halves the error."""

_AT_ONCE: Final = 2**16
"""Maximum number of projections computed at once: at 8 bytes each, they fit in the CPU cache."""


@dataclass(frozen=True, slots=True)
class CoarseShape:
    """Replacement of the convex part of a shape during a search.

    Attributes:
        shape: A convex shape inside the convex part.
        slack: Largest distance of the convex part beyond it [m].
    """

    shape: coal.ShapeBase
    slack: float


def coarse_shape(shape: Shape) -> CoarseShape:
    """Return a polytope of few vertices inside a shape's convex part, or that part itself.

    A cylinder becomes a prism, since depths between flat faces are exact and their normals do not
    depend on last digits. A hull of many vertices becomes one of fewer; spheres, boxes and simple
    hulls are unchanged.
    """
    part = shape.convex
    if isinstance(part, coal.Cylinder):
        return _prism(part.radius, part.halfLength)
    if not shape.is_mesh or part.num_points <= _SIMPLE:
        return CoarseShape(part, 0.0)
    return simplified(part)


def _prism(radius: float, half: float) -> CoarseShape:
    """Return a prism inscribed in a cylinder, turned so that it is parallel to few other shapes."""
    flat = 1.0 - math.cos(math.pi / _SIDES)
    sides = _SIDES
    if radius * flat > _THICK * SLACK:
        flat = SLACK / radius
        sides = math.ceil(math.pi / math.acos(1.0 - flat))
        if sides > _MOST_SIDES:
            sides, flat = _MOST_SIDES, 1.0 - math.cos(math.pi / _MOST_SIDES)
    turns = [2.0 * math.pi * (k + _TURN) / sides for k in range(sides)]
    # Rounded to a nanometre, so that all mathematical libraries give the same corners.
    ring = [(round(radius * math.cos(a), 9), round(radius * math.sin(a), 9)) for a in turns]
    corners = np.array([(x, y, z) for z in (-half, half) for x, y in ring])
    return CoarseShape(hull_of(corners), radius * flat + _ROUNDED)


def simplified(part: coal.ConvexBase) -> CoarseShape:
    """Return a hull of fewer vertices inside a hull, independent of the order of the vertices.

    Starts with the outermost vertices in evenly spread directions. While vertices lie beyond a face
    by more than the slack, adds the farthest ones.
    """
    points = np.array(part.points())
    chosen = _outermost(points, _DIRECTIONS)
    for _ in range(_ROUNDS):
        hull = hull_of(points[chosen])
        normals, corners = np.array(hull.normals()), np.array(hull.points())
        beyond = _farthest(points, normals) - _farthest(corners, normals)
        worst = float(beyond.max())
        if worst <= SLACK:
            return CoarseShape(hull, max(0.0, worst))
        # Add vertices for every face that is not good enough, so that few rounds suffice.
        chosen |= _outermost(points, normals[beyond > SLACK])
    return CoarseShape(part, 0.0)


def outer(
    shapes: Sequence[Shape], coarse_shapes: Mapping[int, CoarseShape], link: Sequence[int]
) -> tuple[int, ...]:
    """Return the indices of a link's shapes that lie inside no other shape's coarse shape.

    A shape inside another shape's convex part is never nearer to other links than that part.
    """
    kept = list(link)
    for j in link:
        body, holder = coarse_shapes[j].shape, shapes[j].placement
        if not isinstance(body, coal.ConvexBase):
            continue
        normals = np.array(body.normals())
        levels = _farthest(np.array(body.points()), normals)
        # A dropped shape also drops the shapes inside it: they lie inside the kept shape, too.
        for i in [i for i in kept if i != j]:
            shape = shapes[i]
            corners = rotated(shape.points, shape.placement.rotation) + shape.placement.translation
            local = rotated(corners - holder.translation, holder.rotation.T)
            # If all corners are inside all faces, the whole shape is inside: both are convex.
            if (_farthest(local, normals) <= levels).all():
                kept.remove(i)
    return tuple(kept)


def least_width(shape: Shape, coarse_shape: coal.ShapeBase) -> float:
    """Return a lower bound on the width of a shape's convex part in any direction [m].

    The width of a polyhedron is least between a face and a vertex or between two edges; a third of
    the least width across its faces is less than both.

    Args:
        shape: The shape.
        coarse_shape: Its coarse shape, which is no wider.
    """
    if not shape.is_mesh:
        low, high = shape.box
        return float((high - low).min()) / 2.0
    heights = _along(np.array(coarse_shape.points()), np.array(coarse_shape.normals()))
    return float((heights.max(axis=0) - heights.min(axis=0)).min()) / 3.0


def _farthest(points: FloatArray, directions: FloatArray) -> FloatArray:
    """Return how far points ``(p, 3)`` reach along directions ``(d, 3)``: ``(d,)`` [m]."""
    return np.concatenate([heights.max(axis=1) for heights in _heights(points, directions)])


def _outermost(points: FloatArray, directions: FloatArray) -> NDArray[np.bool_]:
    """Return which points ``(p,)`` reach farthest along any of the directions ``(d, 3)``."""
    found = np.zeros(len(points), dtype=bool)
    for heights in _heights(points, directions):
        found |= (heights >= heights.max(axis=1)[:, None] - _EQUAL).any(axis=0)
    return found


def _heights(points: FloatArray, directions: FloatArray) -> Iterator[FloatArray]:
    """Yield how far points ``(p, 3)`` reach along a few directions at a time ``(d, p)`` [m]."""
    count = max(1, _AT_ONCE // len(points))
    for i in range(0, len(directions), count):
        # One row per direction, along which the maximum is found fastest.
        yield _along(directions[i : i + count], points)


def _along(points: FloatArray, directions: FloatArray) -> FloatArray:
    """Return the projections ``(p, d)`` of points ``(p, 3)`` on directions ``(d, 3)`` [m]."""
    x, y, z = np.ascontiguousarray(directions.T)
    result: FloatArray = points[:, :1] * x + points[:, 1:2] * y + points[:, 2:3] * z
    return result
