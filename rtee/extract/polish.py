"""The last millimetre of a descent: a proximal bundle method for kinks."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtee.extract.descent import Bounds, Minimum, Objective
from rtee.types import FloatArray

_FIRST_STEP: Final = 0.3
_SERIOUS: Final = 0.1
_KEPT: Final = 14
_ENOUGH: Final = 1e-6
_ROUNDING: Final = 1e-10
_SWEEPS: Final = 3


class _Pieces:
    """Linear pieces of a function: points, and the values and slopes there."""

    def __init__(self, y: FloatArray, value: float, slope: FloatArray) -> None:
        self.points = y[None, :]
        self.values = np.array([value])
        self.slopes = slope[None, :]

    def errors(self, y: FloatArray, value: float) -> FloatArray:
        """Return by how much the pieces lie below the function at a point, at least 0."""
        there = self.values + np.einsum("ij,ij->i", self.slopes, y - self.points)
        errors: FloatArray = np.maximum(0.0, value - there)
        return errors

    def drop(self, i: int) -> None:
        """Forget a piece."""
        self.points = np.delete(self.points, i, axis=0)
        self.values = np.delete(self.values, i)
        self.slopes = np.delete(self.slopes, i, axis=0)

    def add(self, y: FloatArray, value: float, slope: FloatArray) -> None:
        """Add a piece."""
        self.points = np.concatenate([self.points, y[None, :]])
        self.values = np.append(self.values, value)
        self.slopes = np.concatenate([self.slopes, slope[None, :]])


def polish(
    function: Objective, start: FloatArray, *, evaluations: int, bounds: Bounds = (0.0, 1.0)
) -> Minimum:
    """Return a local minimum of the maximum of smooth functions.

    A depth is the least over the directions in which two parts can be separated, so minus the depth
    has kinks, and its minima lie on them. The bundle method (Kiwiel, 1985) models the function by
    the linear pieces that it has met and steps to the minimum of the model plus a proximal term.

    Args:
        function: What to minimise.
        start: Coordinates in the box ``(k,)``.
        evaluations: Most evaluations.
        bounds: Corners of the box.
    """
    low, high = (np.broadcast_to(bound, start.shape) for bound in bounds)
    y = np.clip(start, low, high)
    value, slope = function(y)
    pieces = _Pieces(y, value, slope)
    scale = float(np.abs(slope).max())
    if scale == 0.0:
        return Minimum(y, value, 1)
    reach = _FIRST_STEP / scale
    weights, held = np.ones(1), np.zeros(len(y))
    for count in range(2, evaluations + 1):
        errors, slopes = pieces.errors(y, value), pieces.slopes
        step, weights, held = _model_step(slopes, errors, (weights, held), y, reach, (low, high))
        predicted = -float((slopes @ step - errors).max())
        if predicted < _ENOUGH * abs(value) + 1e-9:
            return Minimum(y, value, count)
        there = np.clip(y + step, low, high)
        new, new_slope = function(there)
        if len(weights) >= _KEPT:
            least = int(np.argmin(weights))
            pieces.drop(least)
            weights = np.delete(weights, least)
        pieces.add(there, new, new_slope)
        weights = np.append(weights, 0.0)
        if new <= value - _SERIOUS * predicted:
            reach *= 2.0 if new <= value - 0.5 * predicted else 1.0
            y, value = there, new
        elif value - new - float(new_slope @ (y - there)) > 2.0 * predicted:
            reach *= 0.5
    return Minimum(y, value, evaluations)


def _model_step(
    slopes: FloatArray,
    errors: FloatArray,
    guess: tuple[FloatArray, FloatArray],
    y: FloatArray,
    reach: float,
    box: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the step to the model's minimum in the box, the pieces' weights, and what is held.

    Coordinates are held at the lower face (-1), the upper one (1) or not (0). The search begins
    with the weights and the held coordinates that are given.
    """
    low, high = box
    weights, side = guess
    held = side != 0.0
    fixed = np.where(held, np.where(side < 0.0, low, high) - y, 0.0)
    for _ in range(_SWEEPS * len(y)):
        free = np.where(held, 0.0, slopes)
        weights = _simplex_minimum(reach * (free @ free.T), errors - slopes @ fixed, weights)
        step = fixed - reach * (weights @ free)
        there = y + step
        leaving = ~held & ((there < low) | (there > high))
        if leaving.any():
            held |= leaving
        else:
            pull = weights @ slopes + fixed / reach
            freed = held & np.where(side < 0.0, pull < 0.0, pull > 0.0)
            if not freed.any():
                break
            held &= ~freed
        side = np.where(held, np.where(leaving, np.where(there < low, -1.0, 1.0), side), 0.0)
        # What would leave the box goes to its face; the rest is solved again.
        fixed = np.where(held, np.where(side < 0.0, low, high) - y, 0.0)
    return np.clip(y + step, low, high) - y, weights, side


def _simplex_minimum(matrix: FloatArray, linear: FloatArray, start: FloatArray) -> FloatArray:
    """Return the minimum of ``x·Mx / 2 + c·x`` over the simplex, by an active set.

    Args:
        matrix: M, positive semidefinite ``(k, k)``.
        linear: c ``(k,)``.
        start: A point of the simplex to begin with, up to its sum ``(k,)``.
    """
    count = len(linear)
    total = float(start.sum())
    x = start / total if total > 0.0 else np.eye(count)[int(np.argmin(linear))]
    support = np.flatnonzero(x).tolist()
    regular = matrix + np.eye(count) * (_ROUNDING * (1.0 + matrix.diagonal().max()))
    for _ in range(4 * count):
        x, support = _on_support(regular, linear, x, support)
        gradient = matrix @ x + linear
        level = float(gradient[support].max())
        entering = int(np.argmin(gradient))
        if entering in support or gradient[entering] > level - _ROUNDING * (1.0 + abs(level)):
            break
        support.append(entering)
    return x


def _on_support(
    matrix: FloatArray, linear: FloatArray, x: FloatArray, support: list[int]
) -> tuple[FloatArray, list[int]]:
    """Return the minimum over a face of the simplex, or over a face of it that the way there meets.

    Args:
        matrix: M, positive definite ``(k, k)``.
        linear: c ``(k,)``.
        x: A point of the face.
        support: The coordinates that are free.
    """
    while True:
        size = len(support)
        if size == 1:
            return np.eye(len(x))[support[0]], support
        right = np.ones((2, size))
        right[0] = -linear[support]
        rows = matrix[support]
        plain, even = np.linalg.solve(rows[:, support], right.T).T
        target = plain + even * ((1.0 - plain.sum()) / even.sum())
        if (target > 0.0).all():
            x = np.zeros(len(x))
            x[support] = target
            return x, support
        here = x[support]
        gone = target <= 0.0
        ratio = np.full(size, np.inf)
        ratio[gone] = here[gone] / np.maximum(here[gone] - target[gone], 1e-300)
        drop = int(np.argmin(ratio))
        moved = np.maximum(here + min(1.0, float(ratio[drop])) * (target - here), 0.0)
        moved[drop] = 0.0
        x = np.zeros(len(x))
        x[support] = moved
        support = support[:drop] + support[drop + 1 :]
