"""Rays against triangles in numpy alone, for computers that Embree has no package for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.types import FloatArray

_LEAF: Final = 4
"""Triangles in a leaf of the tree: below, boxes cost more than they save."""

_AT_ONCE: Final = 1 << 13
"""Rays traced together: so few that their arrays stay in the processor's cache (measured)."""

_BITS: Final = 10
"""Bits of a Morton code per axis: 1024 cells along the longest side of a hand are below 1 mm."""

_TINY: Final = np.float32(1e-20)
"""Instead of a component of a direction that is zero, by which one cannot divide."""

_PARALLEL: Final = np.float32(1e-18)
"""Determinants [m²] below this belong to triangles that are seen from the edge, or have no area."""

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class FirstHits:
    """What each ray hits first.

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
    """Triangles in a tree of boxes, which rays go through level by level, many at once.

    The triangles are put in the order of the Morton codes of their centres; each leaf takes
    `_LEAF` of them, and each box holds the two below. The tree is complete, so it needs no links.
    """

    def __init__(self, corners: FloatArray) -> None:
        """Build the tree.

        Args:
            corners: Corners of the triangles ``(t, 3, 3)`` [m].
        """
        order = _morton_order(corners.mean(axis=1))
        leaves = 1
        while leaves * _LEAF < len(order):
            leaves *= 2
        self._depth = leaves.bit_length() - 1
        # The last triangle stands in for those that are missing in the last leaves.
        self._faces = np.concatenate(
            [order, np.full(leaves * _LEAF - len(order), order[-1])]
        ).astype(np.int64)
        # Coordinates come first: numpy is several times faster along long axes.
        ordered = corners[self._faces].astype(np.float32).transpose(1, 2, 0)
        self._origin: Floats = np.ascontiguousarray(ordered[0])
        self._first: Floats = np.ascontiguousarray(ordered[1] - ordered[0])
        self._second: Floats = np.ascontiguousarray(ordered[2] - ordered[0])
        by_leaf = ordered.reshape(3, 3, leaves, _LEAF)
        low, high = by_leaf.min(axis=(0, 3)), by_leaf.max(axis=(0, 3))
        levels = [(low, high)]
        while low.shape[1] > 1:
            low = np.minimum(low[:, ::2], low[:, 1::2])
            high = np.maximum(high[:, ::2], high[:, 1::2])
            levels.append((low, high))
        self._levels = levels[::-1]

    def first(self, origins: FloatArray, directions: FloatArray) -> FirstHits:
        """Return what rays hit first.

        Args:
            origins: Where they begin ``(k, 3)`` [m].
            directions: Unit vectors ``(k, 3)``.
        """
        n = len(directions)
        found = FirstHits(
            np.full(n, -1, dtype=np.int64),
            np.zeros(n, dtype=np.float32),
            np.zeros(n, dtype=np.float32),
            np.full(n, np.inf, dtype=np.float32),
        )
        for start in range(0, n, _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            begin, toward = _rows(origins[part]), _rows(directions[part])
            ray, leaf = self._leaves(begin, toward, np.float32(np.inf))
            for k in range(_LEAF):
                triangle = leaf * _LEAF + k
                depth, u, v = self._meet(begin, toward, ray, triangle)
                hit = np.flatnonzero(np.isfinite(depth))
                # Of several triangles that one ray hits, the nearest is written last.
                hit = hit[np.argsort(-depth[hit], kind="stable")]
                which = ray[hit] + start
                nearer = depth[hit] < found.depth[which]
                hit, which = hit[nearer], which[nearer]
                found.face[which] = self._faces[triangle[hit]]
                found.u[which], found.v[which] = u[hit], v[hit]
                found.depth[which] = depth[hit]
        return found

    def blocked(
        self, origins: FloatArray, directions: FloatArray, reach: float
    ) -> NDArray[np.bool_]:
        """Return which rays hit something within a distance [m]."""
        found = np.zeros(len(directions), dtype=bool)
        for start in range(0, len(directions), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            begin, toward = _rows(origins[part]), _rows(directions[part])
            ray, leaf = self._leaves(begin, toward, np.float32(reach))
            for k in range(_LEAF):
                left = ~found[ray + start]
                ray, leaf = ray[left], leaf[left]
                depth = self._meet(begin, toward, ray, leaf * _LEAF + k)[0]
                found[ray[depth <= reach] + start] = True
        return found

    def _leaves(
        self, origins: Floats, directions: Floats, reach: np.float32
    ) -> tuple[Indices, Indices]:
        """Return which rays go through the boxes of which leaves."""
        inverse = 1 / np.where(np.abs(directions) < _TINY, _TINY, directions)
        ray = np.arange(directions.shape[1])
        node = np.zeros(len(ray), dtype=np.int64)
        for low, high in self._levels:
            enter, leave = np.zeros(len(ray), dtype=np.float32), np.full(len(ray), reach)
            for axis in range(3):
                begin, slope = origins[axis][ray], inverse[axis][ray]
                one = (low[axis][node] - begin) * slope
                other = (high[axis][node] - begin) * slope
                np.maximum(enter, np.minimum(one, other), out=enter)
                np.minimum(leave, np.maximum(one, other), out=leave)
            through = leave >= enter
            ray, node = ray[through], node[through]
            if low.shape[1] < 1 << self._depth:
                ray, node = np.repeat(ray, 2), np.repeat(node * 2, 2)
                node[1::2] += 1
        return ray, node

    def _meet(
        self, origins: Floats, directions: Floats, ray: Indices, triangle: Indices
    ) -> tuple[Floats, Floats, Floats]:
        """Return distance and barycentric coordinates where rays meet triangles, or infinity.

        Möller and Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection", 1997.
        """
        toward = directions[:, ray]
        first, second = self._first[:, triangle], self._second[:, triangle]
        across = _cross(toward, second)
        determinant = _dot(first, across)
        usable = np.abs(determinant) > _PARALLEL
        inverse: Floats = (1 / np.where(usable, determinant, 1)).astype(np.float32)
        begin = origins[:, ray] - self._origin[:, triangle]
        u: Floats = _dot(begin, across) * inverse
        over = _cross(begin, first)
        v: Floats = _dot(toward, over) * inverse
        depth: Floats = _dot(second, over) * inverse
        hit = usable & (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 0)
        return np.where(hit, depth, np.float32(np.inf)), u, v


def _morton_order(points: FloatArray) -> Indices:
    """Return the order of points along a curve that keeps near together what is near."""
    low = points.min(axis=0)
    span = float(np.ptp(points, axis=0).max()) or 1.0
    cells = ((points - low) / span * ((1 << _BITS) - 1)).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _cross(a: Floats, b: Floats) -> Floats:
    result: Floats = np.empty_like(a)
    result[0] = a[1] * b[2] - a[2] * b[1]
    result[1] = a[2] * b[0] - a[0] * b[2]
    result[2] = a[0] * b[1] - a[1] * b[0]
    return result


def _dot(a: Floats, b: Floats) -> Floats:
    result: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return result


def _rows(values: FloatArray) -> Floats:
    """Return vectors ``(k, 3)`` as rows of coordinates ``(3, k)``."""
    return np.ascontiguousarray(values.T, dtype=np.float32)
