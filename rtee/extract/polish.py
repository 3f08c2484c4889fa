"""The last millimetre of a descent: a proximal bundle method for kinks."""

from __future__ import annotations

from dataclasses import dataclass
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


@dataclass(slots=True)
class _Cut:
    """A linear piece: value and slope at a point."""

    y: FloatArray
    value: float
    slope: FloatArray

    def error(self, y: FloatArray, value: float) -> float:
        """Return by how much the piece lies below the function at another point."""
        step = y - self.y
        return max(0.0, value - self.value - float(self.slope @ step))


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
    cuts = [_Cut(y, value, slope)]
    scale = float(np.abs(slope).max())
    if scale == 0.0:
        return Minimum(y, value, 1)
    reach = _FIRST_STEP / scale
    for count in range(2, evaluations + 1):
        errors = np.array([cut.error(y, value) for cut in cuts])
        slopes = np.array([cut.slope for cut in cuts])
        step, weights = _model_step(slopes, errors, y, reach, low, high)
        predicted = -float((slopes @ step - errors).max())
        if predicted < _ENOUGH * abs(value) + 1e-9:
            return Minimum(y, value, count)
        there = np.clip(y + step, low, high)
        new, new_slope = function(there)
        serious = new <= value - _SERIOUS * predicted
        cut = _Cut(there, new, new_slope)
        if serious:
            reach *= 2.0 if new <= value - 0.5 * predicted else 1.0
            y, value = there, new
        elif cut.error(y, value) > predicted * 2.0:
            reach *= 0.5
        if len(cuts) >= _KEPT:
            del cuts[int(np.argmin(weights))]
        cuts.append(cut)
    return Minimum(y, value, evaluations)


def _model_step(
    slopes: FloatArray,
    errors: FloatArray,
    y: FloatArray,
    reach: float,
    low: FloatArray,
    high: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the step to the model's minimum in the box, and the weights of the pieces."""
    held = np.zeros(len(y), dtype=bool)
    fixed = np.zeros(len(y))
    for _ in range(_SWEEPS * len(y)):
        free = np.where(held, 0.0, slopes)
        weights = _simplex_minimum(reach * (free @ free.T), errors - slopes @ fixed)
        step = fixed - reach * (weights @ free)
        there = y + step
        leaving = ~held & ((there < low) | (there > high))
        if leaving.any():
            held |= leaving
        else:
            pull = weights @ slopes + fixed / reach
            freed = held & np.where(there <= low, pull < 0.0, pull > 0.0)
            if not freed.any():
                break
            held &= ~freed
        # What would leave the box goes to its face; the rest is solved again.
        fixed = np.where(held, np.clip(there, low, high) - y, 0.0)
    return np.clip(y + step, low, high) - y, weights


def _simplex_minimum(matrix: FloatArray, linear: FloatArray) -> FloatArray:
    """Return the minimum of ``x·Mx / 2 + c·x`` over the simplex, by an active set."""
    count = len(linear)
    start = int(np.argmin(0.5 * matrix.diagonal() + linear))
    support = [start]
    x = np.zeros(count)
    x[start] = 1.0
    ridge = 1e-12 * (1.0 + matrix.diagonal().max())
    for _ in range(4 * count):
        gradient = matrix @ x + linear
        level = float(gradient[support].max())
        entering = int(np.argmin(gradient))
        if entering in support or gradient[entering] > level - _ROUNDING * (1.0 + abs(level)):
            break
        support.append(entering)
        while True:
            size = len(support)
            system = np.ones((size + 1, size + 1))
            system[:size, :size] = matrix[np.ix_(support, support)]
            system[range(size), range(size)] += ridge
            system[size, size] = 0.0
            right = np.append(-linear[support], 1.0)
            target = np.linalg.solve(system, right)[:size]
            here = x[support]
            if (target > 0.0).all():
                x[support] = target
                break
            gone = target <= 0.0
            ratio = np.full(size, np.inf)
            ratio[gone] = here[gone] / np.maximum(here[gone] - target[gone], 1e-300)
            drop = int(np.argmin(ratio))
            moved = here + min(1.0, float(ratio[drop])) * (target - here)
            moved[drop] = 0.0
            x[support] = np.maximum(moved, 0.0)
            del support[drop]
            if not support:
                return x
    return x
