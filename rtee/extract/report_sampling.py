"""Directions that rays take, and arrays of light."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.types import FloatArray

LIGHT_ANGLE: Final = math.radians(9.0)
"""Half the angle under which the light is seen [rad]."""


def normalised(vectors: FloatArray) -> FloatArray:
    """Return vectors ``(k, 3)`` scaled to length 1."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    result: FloatArray = vectors / np.maximum(length, 1e-12)
    return result


def lattice(index: NDArray[np.int64], count: int) -> tuple[FloatArray, FloatArray]:
    """Return points of a Fibonacci lattice in the unit square."""
    return (index + 0.5) / count, np.mod(index * 0.6180339887498949, 1.0)


def frame(normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two unit vectors perpendicular to each normal (Duff et al., 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return first, np.stack([b, sign + y * y * a, -y], axis=1)


def hemisphere(normals: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return directions around normals, as frequent as the cosine of their angle."""
    first, second = frame(normals)
    radius, turn = np.sqrt(a)[:, None], 2 * math.pi * b[:, None]
    height = np.sqrt(1 - a)[:, None]
    return radius * (np.cos(turn) * first + np.sin(turn) * second) + height * normals


def cone(axis: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return directions in a narrow cone around an axis."""
    first, second = frame(axis[None])
    radius = math.tan(LIGHT_ANGLE) * np.sqrt(a)[:, None]
    turn = 2 * math.pi * b[:, None]
    return normalised(axis + radius * (np.cos(turn) * first + np.sin(turn) * second))


def margin(height: int, width: int) -> FloatArray:
    """Return factors that fade towards the picture's border ``(height, width)``."""
    y, x = (
        np.minimum(np.arange(n) + 0.5, n - np.arange(n) - 0.5) / (0.12 * n) for n in (height, width)
    )
    y, x = (np.clip(v, 0, 1) for v in (y, x))
    fade: FloatArray = (y * y * (3 - 2 * y))[:, None] * (x * x * (3 - 2 * x))[None]
    return fade


def blurred(values: FloatArray) -> FloatArray:
    """Return values averaged with their neighbours."""
    for _ in range(2):
        padded = np.pad(values, 1, mode="edge")
        values = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
        values = (values[:, :-2] + 2 * values[:, 1:-1] + values[:, 2:]) / 4
    return values


def enlarged(values: FloatArray, step: int) -> FloatArray:
    """Return values at every pixel from those at every ``step``-th one, linearly."""
    rows, columns = values.shape
    y = np.arange((rows - 1) * step) / step
    x = np.arange((columns - 1) * step) / step
    i, j = y.astype(int), x.astype(int)
    fy, fx = (y - i)[:, None], (x - j)[None]
    above = values[i][:, j] * (1 - fx) + values[i][:, j + 1] * fx
    below = values[i + 1][:, j] * (1 - fx) + values[i + 1][:, j + 1] * fx
    result: FloatArray = above * (1 - fy) + below * fy
    return result
