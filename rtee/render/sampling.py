"""Evenly spread directions of rays, without random numbers, for reproducible pictures."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.sample import FloatArray

_LIGHT_ANGLE: Final = math.radians(9.0)
"""Half the angular size of the light [rad], which gives shadows soft edges."""

_GOLDEN_SECTION: Final = (math.sqrt(5.0) - 1.0) / 2.0
"""The golden section, whose multiples modulo 1 are spread most evenly."""


def normalised(vectors: FloatArray) -> FloatArray:
    """Return vectors ``(k, 3)`` scaled to length 1."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    result: FloatArray = vectors / np.maximum(length, 1e-12)
    return result


def fibonacci_lattice(index: NDArray[np.int64], count: int) -> tuple[FloatArray, FloatArray]:
    """Return the coordinates of points of a Fibonacci lattice in the unit square."""
    return (index + 0.5) / count, np.mod(index * _GOLDEN_SECTION, 1.0)


def orthonormal_basis(normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two unit vectors perpendicular to each normal.

    After Duff et al., "Building an Orthonormal Basis, Revisited", 2017.
    """
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    # Without branches, and without the singularity of a cross product with a fixed axis.
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return first, np.stack([b, sign + y * y * a, -y], axis=1)


def cosine_hemisphere(normals: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return directions around normals with a density proportional to the cosine of their angle."""
    first, second = orthonormal_basis(normals)
    radius, turn = np.sqrt(a)[:, None], 2 * math.pi * b[:, None]
    height = np.sqrt(1 - a)[:, None]
    return radius * (np.cos(turn) * first + np.sin(turn) * second) + height * normals


def cone(axis: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return directions in the narrow cone of the light around an axis."""
    first, second = orthonormal_basis(axis[None])
    radius = math.tan(_LIGHT_ANGLE) * np.sqrt(a)[:, None]
    turn = 2 * math.pi * b[:, None]
    return normalised(axis + radius * (np.cos(turn) * first + np.sin(turn) * second))
