"""Boxes, spheres and cylinders as triangles, and triangles as a file."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.hand.linalg import rotated
from rtee.sample import FloatArray

Triangles = tuple[FloatArray, NDArray[np.int64]]
"""Vertices ``(v, 3)`` [m] and faces ``(f, 3)``, counter-clockwise seen from outside."""

_AROUND: Final = 32
_RINGS: Final = 16
"""Vertices around a surface of revolution, and rings of a sphere: enough to look smooth."""


def box(size: tuple[float, float, float]) -> Triangles:
    """Return a box of edge lengths [m], centred at the origin."""
    corners = [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return np.array(corners) * np.array(size), np.array(faces, dtype=np.int64)


def cylinder(radius: float, length: float) -> Triangles:
    """Return a cylinder of a radius and length [m] along z, centred at the origin."""
    rings = [(0.0, -length / 2), (radius, -length / 2), (radius, length / 2), (0.0, length / 2)]
    return _revolve(rings)


def sphere(radius: float) -> Triangles:
    """Return a sphere of a radius [m], centred at the origin."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, _RINGS + 1)
    return _revolve([(radius * float(np.cos(a)), radius * float(np.sin(a))) for a in angles])


def solid(kind: str, dimensions: tuple[float, ...]) -> Triangles:
    """Return a box, sphere or cylinder of dimensions [m], as `UrdfGeometry` and objects have them.

    Those are its edge lengths; its radius; or its radius and its length.
    """
    if kind == "box":
        x, y, z = dimensions
        return box((x, y, z))
    return sphere(*dimensions) if kind == "sphere" else cylinder(*dimensions)


def joined(parts: Iterable[tuple[Triangles, FloatArray]]) -> Triangles:
    """Return solids as one, each with its pose ``(4, 4)`` in the common frame [m]."""
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
    for (points, corners), pose in parts:
        vertices.append(rotated(points, pose[:3, :3]) + pose[:3, 3])
        faces.append(corners + count)
        count += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def subdivided(corners: FloatArray, longest: float) -> FloatArray:
    """Return triangles ``(t, 3, 3)`` with edges halved until none is too long.

    Args:
        corners: Triangles ``(t, 3, 3)`` [m].
        longest: Largest length of an edge [m].
    """
    while True:
        lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        long = lengths.max(axis=1, initial=0.0) > longest
        if not long.any():
            return corners
        # Always the longest edge: halving another one would leave ever thinner triangles.
        parts, edge = corners[long], lengths[long].argmax(axis=1)
        rows = np.arange(len(parts))
        a, b, c = (parts[rows, (edge + i) % 3] for i in range(3))
        middle = (a + b) / 2.0
        pieces = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        corners = np.concatenate([corners[~long], *pieces])


_RECORD: Final = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
"""A triangle of a binary STL file."""

_HEADER: Final = 84
"""Bytes of a binary STL file before its triangles; the last four are their number."""


def binary_stl(corners: FloatArray) -> bytes:
    """Return triangles ``(t, 3, 3)`` [m] as a binary STL file; readers compute the normals."""
    triangles = np.zeros(len(corners), dtype=_RECORD)
    triangles["corners"] = corners
    return bytes(_HEADER - 4) + len(corners).to_bytes(4, "little") + triangles.tobytes()


def stl_corners(data: bytes) -> FloatArray | None:
    """Return the corners ``(3 t, 3)`` of a binary STL file; ``None`` if it is not one."""
    count = int.from_bytes(data[_HEADER - 4 : _HEADER], "little")
    # Binary files may also begin with "solid", but their length identifies them.
    if len(data) != _HEADER + count * _RECORD.itemsize:
        return None
    triangles = np.frombuffer(data, _RECORD, count, _HEADER)
    return triangles["corners"].reshape(-1, 3).astype(np.float64)


def _revolve(profile: list[tuple[float, float]]) -> Triangles:
    """Return the surface of revolution of a profile (radius, height) about z, from bottom to top.

    The first and the last point lie on the axis.
    """
    turn = np.arange(_AROUND) * (2 * np.pi / _AROUND)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    inner = profile[1:-1]
    rings = [np.column_stack([r * circle, np.full(_AROUND, z)]) for r, z in inner]
    bottom, top = len(inner) * _AROUND, len(inner) * _AROUND + 1
    poles = np.array([[0.0, 0.0, profile[0][1]], [0.0, 0.0, profile[-1][1]]])
    faces: list[tuple[int, int, int]] = []
    for i in range(_AROUND):
        j = (i + 1) % _AROUND
        faces.append((bottom, j, i))
        for low, high in pairwise(range(len(inner))):
            a, b = low * _AROUND, high * _AROUND
            faces += [(a + i, a + j, b + j), (a + i, b + j, b + i)]
        last = (len(inner) - 1) * _AROUND
        faces.append((top, last + i, last + j))
    return np.concatenate([*rings, poles]), np.array(faces, dtype=np.int64)
