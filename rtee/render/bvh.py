"""A bounding volume hierarchy in NumPy, for computers without a package of Embree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.sample import FloatArray

_LEAF: Final = 4
"""Number of triangles in a leaf of the tree: with fewer, the boxes cost more than they save."""

_AT_ONCE: Final = 1 << 13
"""Number of rays traced together, whose arrays stay in the processor's cache (measured)."""

_BITS: Final = 10
"""Bits of a Morton code per axis: 1024 cells along the longest side of a hand are below 1 mm."""

_TINY: Final = np.float32(1e-20)
"""Substitute for a component 0 of a direction, to avoid a division by 0."""

_PARALLEL: Final = 1e-18
"""Area below which a triangle counts as degenerate [m²]: one side is a rounding error."""

_GAP: Final = np.float32(1e-6)
"""Enlargement of triangles as a share of their sides, so that rounding leaves no gaps between
them."""

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class ClosestHits:
    """The closest hit of each ray.

    Attributes:
        face: Index of the triangle ``(k,)``; -1 for none.
        u: Barycentric coordinate of the triangle's second corner ``(k,)``.
        v: Barycentric coordinate of its third corner ``(k,)``.
        depth: Distance along the ray ``(k,)`` [m]; infinite for none.
    """

    face: Indices
    u: Floats
    v: Floats
    depth: Floats


class NumpyScene:
    """Triangles in a tree of boxes, which many rays descend at once, level by level.

    The triangles are sorted by the Morton codes of their centres. A leaf has `_LEAF` of them, and
    each box contains the two below. The tree is complete and needs no links.
    """

    def __init__(self, corners: FloatArray) -> None:
        """Build the tree of triangles, by their corners ``(t, 3, 3)`` [m]."""
        order = _morton_order(corners.mean(axis=1))
        leaves = 1
        while leaves * _LEAF < len(order):
            leaves *= 2
        self._depth = leaves.bit_length() - 1
        # Pad the last leaf with copies of the last triangle.
        self._faces = np.concatenate(
            [order, np.full(leaves * _LEAF - len(order), order[-1])]
        ).astype(np.int64)
        # Coordinates first, since NumPy is several times faster along long axes.
        ordered = corners[self._faces].astype(np.float32).transpose(1, 2, 0)
        self._own = _own_coordinates(corners[self._faces])
        by_leaf = ordered.reshape(3, 3, leaves, _LEAF)
        low, high = by_leaf.min(axis=(0, 3)), by_leaf.max(axis=(0, 3))
        levels = [(low, high)]
        while low.shape[1] > 1:
            low = np.minimum(low[:, ::2], low[:, 1::2])
            high = np.maximum(high[:, ::2], high[:, 1::2])
            levels.append((low, high))
        self._levels = [((low + high) / 2, (high - low) / 2) for low, high in levels[::-1]]

    def closest(self, origins: FloatArray, directions: FloatArray) -> ClosestHits:
        """Return the closest hit of each ray.

        Args:
            origins: Origins of the rays ``(k, 3)`` [m].
            directions: Unit vectors ``(k, 3)``.
        """
        n = len(directions)
        hits = ClosestHits(
            np.full(n, -1, dtype=np.int64),
            np.zeros(n, dtype=np.float32),
            np.zeros(n, dtype=np.float32),
            np.full(n, np.inf, dtype=np.float32),
        )
        for start in range(0, n, _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            begin, toward = _rows(origins[part]), _rows(directions[part])
            ray, triangle, depth, u, v = self._hits(begin, toward, np.float32(np.inf))
            # Of several triangles hit by a ray, the nearest is written last and stays.
            order = np.argsort(-depth, kind="stable")
            which = ray[order] + start
            hits.face[which] = self._faces[triangle[order]]
            hits.u[which], hits.v[which] = u[order], v[order]
            hits.depth[which] = depth[order]
        return hits

    def occluded(
        self, origins: FloatArray, directions: FloatArray, reach: float
    ) -> NDArray[np.bool_]:
        """Return whether each ray hits a triangle within a distance [m]."""
        hidden = np.zeros(len(directions), dtype=bool)
        for start in range(0, len(directions), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            begin, toward = _rows(origins[part]), _rows(directions[part])
            hidden[self._hits(begin, toward, np.float32(reach))[0] + start] = True
        return hidden

    def _leaves(
        self, origins: Floats, directions: Floats, reach: np.float32
    ) -> tuple[Indices, Indices]:
        """Return which rays go through the boxes of which leaves."""
        inverse = 1 / np.where(np.abs(directions) < _TINY, _TINY, directions)
        ray = np.arange(directions.shape[1])
        node = np.zeros(len(ray), dtype=np.int64)
        for centre, half in self._levels:
            enter, leave = np.zeros(len(ray), dtype=np.float32), np.full(len(ray), reach)
            for axis in range(3):
                slope = inverse[axis].take(ray)
                middle = (centre[axis].take(node) - origins[axis].take(ray)) * slope
                size = half[axis].take(node) * np.abs(slope)
                # The slab method: the ray is inside the box while it is between all three pairs of
                # planes.
                np.maximum(enter, middle - size, out=enter)
                np.minimum(leave, middle + size, out=leave)
            through = np.flatnonzero(leave >= enter)
            ray, node = ray.take(through), node.take(through)
            # Above the leaves, the ray goes on into both boxes below.
            if centre.shape[1] < 1 << self._depth:
                ray, node = np.repeat(ray, 2), np.repeat(node * 2, 2)
                node[1::2] += 1
        return ray, node

    def _hits(
        self, origins: Floats, directions: Floats, reach: np.float32
    ) -> tuple[Indices, Indices, Floats, Floats, Floats]:
        """Return which rays hit which triangles, at which distance and barycentric coordinates.

        A triangle's own coordinates make that two products of vectors (Baldwin and Weber, "Fast
        Ray-Triangle Intersections by Coordinate Transformation", 2016), of which the first, with
        the distance from its plane, leaves few rays for the second.
        """
        ray, leaf = self._leaves(origins, directions, reach)
        ray = np.repeat(ray, _LEAF)
        triangle = (leaf[:, None] * _LEAF + np.arange(_LEAF)).ravel()
        begin = [row.take(ray) for row in origins]
        toward = [row.take(ray) for row in directions]
        height, fall = self._along(2, triangle, begin), -self._along(2, triangle, toward, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):  # edge-on or degenerate triangles
            depth = height / fall
        some = np.flatnonzero((depth > 0) & (depth <= reach))
        ray, triangle, depth = ray.take(some), triangle.take(some), depth.take(some)
        at = [
            start.take(some) + depth * way.take(some)
            for start, way in zip(begin, toward, strict=True)
        ]
        u, v = self._along(0, triangle, at), self._along(1, triangle, at)
        hit = np.flatnonzero((u >= -_GAP) & (v >= -_GAP) & (u + v <= 1 + _GAP))
        return ray.take(hit), triangle.take(hit), depth.take(hit), u.take(hit), v.take(hit)

    def _along(
        self, row: int, triangle: Indices, vectors: Sequence[Floats], offset: float = 1.0
    ) -> Floats:
        """Return one of the triangles' own coordinates of points, or of directions (offset 0)."""
        x, y, z, constant = self._own[row]
        result: Floats = x.take(triangle) * vectors[0]
        result += y.take(triangle) * vectors[1]
        result += z.take(triangle) * vectors[2]
        if offset:
            result += constant.take(triangle)
        return result


def _own_coordinates(corners: FloatArray) -> Floats:
    """Return affine maps from points to the triangles' own coordinates ``(3, 4, t)``.

    The coordinates are the barycentric ones of the second and third corner, and the distance from
    the plane [m]; each is the product of the point with the first three numbers, plus the fourth.
    """
    origin = corners[:, 0]
    first, second = corners[:, 1] - origin, corners[:, 2] - origin
    normal = np.cross(first, second)
    area = np.linalg.norm(normal, axis=1)
    flat = area < _PARALLEL
    area[flat] = 1.0
    normal /= area[:, None]
    rows = np.stack([np.cross(second, normal), np.cross(normal, first), normal], axis=1)
    rows[:, :2] /= area[:, None, None]
    # With zeros, no ray ever hits a degenerate triangle.
    rows[flat] = 0.0
    constant = -np.einsum("tij,tj->ti", rows, origin)
    return np.ascontiguousarray(
        np.concatenate([rows, constant[..., None]], axis=2).transpose(1, 2, 0), dtype=np.float32
    )


def _morton_order(points: FloatArray) -> Indices:
    """Return the order of points along a Morton curve, on which near points stay near."""
    low = points.min(axis=0)
    span = float(np.ptp(points, axis=0).max()) or 1.0
    cells = ((points - low) / span * ((1 << _BITS) - 1)).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _rows(values: FloatArray) -> Floats:
    """Return vectors ``(k, 3)`` as rows of coordinates ``(3, k)``."""
    return np.ascontiguousarray(values.T, dtype=np.float32)
