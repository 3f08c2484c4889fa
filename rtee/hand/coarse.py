"""Coarsen meshes with more triangles than a hand needs, since each costs 2 kB and 10 µs."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.sample import FloatArray

Faces = NDArray[np.int64]

MOST: Final = 60_000
"""Most triangles kept of a mesh: on a link of 40 by 80 mm, their edges are 0.5 mm long."""

_WIDER: Final = 1.15
"""Factor by which cells are widened until there are few enough triangles."""

_BITS: Final = 21
"""Bits of a cell's number along an axis: three fit into one integer."""


def coarsened(points: FloatArray, faces: Faces, kept: FloatArray) -> FloatArray:
    """Merge the corners in each cell of a grid into one of them; return the remaining triangles.

    Closed surfaces stay closed, and the remaining corners stay where they are, those of the convex
    hull first; a round hull with too many of them shrinks by micrometres.

    Args:
        points: The corners ``(v, 3)`` [m].
        faces: The triangles as indices of corners ``(t, 3)``.
        kept: Corners ``(k, 3)`` [m] that stay where they can: those of the convex hull.

    Returns:
        The triangles ``(u, 3, 3)`` [m], at most `MOST`.
    """
    low = points.min(axis=0)
    few = kept if len(kept) <= MOST // 4 else kept[:0]
    own = np.isin(_number(points), _number(few))
    # First, since the first corner of a cell represents it.
    order = np.argsort(~own, kind="stable")
    points, faces, count = points[order], np.argsort(order)[faces], int(own.sum())
    a, b, c = (points[faces[:, i]] for i in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    # A closed surface has twice as many triangles as corners; cells must be countable in `_BITS`.
    cell = max(math.sqrt(2.0 * area / MOST), float(np.ptp(points, axis=0).max()) / 2**_BITS)
    while True:
        place = ((points - low) / cell).astype(np.int64)
        number = (place[:, 0] << 2 * _BITS) | (place[:, 1] << _BITS) | place[:, 2]
        _, first = np.unique(number[:count], return_index=True)
        others = np.setdiff1d(np.arange(count), first)
        number[others] = -1 - others
        _, first, cells = np.unique(number, return_index=True, return_inverse=True)
        corners = cells[faces]
        i, j, k = corners.T
        corners = corners[(i != j) & (j != k) & (k != i)]
        if len(corners) <= MOST:
            found: FloatArray = points[first][corners]
            return found
        cell *= _WIDER


def welded(corners: FloatArray) -> tuple[FloatArray, Faces]:
    """Return the distinct corners of ``(3 t, 3)`` corners [m], and triangles as their indices."""
    _, first, faces = np.unique(_number(corners), return_index=True, return_inverse=True)
    return corners[first], faces.reshape(-1, 3)


def _number(points: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Return a number for each point ``(k, 3)``; two share one with a probability of 1e-8."""
    # As in STL files: the same corner of two triangles is equal in every bit.
    bits = np.ascontiguousarray(points, dtype=np.float32).view(np.uint32).astype(np.uint64)
    mixed = bits[:, 0]
    for column in (1, 2):
        # Multiplied by an odd number near 2**64 divided by the golden ratio, as Fibonacci hashing.
        mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0x9E3779B97F4A7C15) + bits[:, column]
    mixed = (mixed ^ (mixed >> np.uint64(32))) * np.uint64(0x9E3779B97F4A7C15)
    return (mixed >> np.uint64(1)).astype(np.int64)
