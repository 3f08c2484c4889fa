"""Local minimisation of a piecewise smooth function in the unit box."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.types import FloatArray

Objective = Callable[[FloatArray], tuple[float, FloatArray]]
"""From coordinates in the unit box to the value and its derivative."""

_DECREASE: Final = 1e-4
_CURVATURE: Final = 0.5
_FIRST_STEP: Final = 0.1
_LONGEST_STEP: Final = 0.5


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where a descent ended.

    Attributes:
        y: Coordinates ``(k,)``.
        value: The value there.
        evaluations: How often the function was evaluated.
    """

    y: FloatArray
    value: float
    evaluations: int


def descend(
    function: Objective, start: FloatArray, *, evaluations: int, tolerance: float = 1e-8
) -> Minimum:
    """Return a local minimum by projected BFGS.

    Quasi-Newton steps on the coordinates that are not held at a bound, with a line search for the
    weak Wolfe conditions. These suffice on functions with kinks, where the method converges though
    the derivative jumps (Lewis and Overton, 2013). Where it stalls, it begins anew once with the
    identity.

    Args:
        function: What to minimise.
        start: Coordinates in the unit box ``(k,)``.
        evaluations: Most evaluations.
        tolerance: A step that gains less ends the descent.
    """
    y = np.clip(start, 0.0, 1.0)
    value, slope = function(y)
    count, fresh, restarted = 1, True, False
    inverse = np.eye(len(y))
    while count < evaluations:
        held = ((y <= 0.0) & (slope > 0.0)) | ((y >= 1.0) & (slope < 0.0))
        free = np.where(held, 0.0, slope)
        if np.abs(free).max(initial=0.0) < 1e-10:
            break
        direction = -np.where(held, 0.0, inverse @ free)
        if direction @ free >= 0.0:
            direction, inverse, fresh = -free, np.eye(len(y)), True
        longest = float(np.abs(direction).max())
        if fresh:
            direction *= _FIRST_STEP / longest
        elif longest > _LONGEST_STEP:
            direction *= _LONGEST_STEP / longest
        found, used = _search_line(function, y, value, free, direction)
        count += used
        if found is None or value - found[1] < tolerance:
            if found is not None:
                y, value, slope = found
            if restarted or fresh:
                break
            inverse, fresh, restarted = np.eye(len(y)), True, True
            continue
        step, change = found[0] - y, found[2] - slope
        y, value, slope = found
        along = float(step @ change)
        if along > 1e-14:
            if fresh:
                inverse = np.eye(len(y)) * (along / float(change @ change))
            bent = inverse @ change
            inverse = (
                inverse
                + ((change @ bent / along + 1.0) / along) * np.outer(step, step)
                - (np.outer(bent, step) + np.outer(step, bent)) / along
            )
            fresh = False
    return Minimum(y, value, count)


_Point = tuple[FloatArray, float, FloatArray]


def _search_line(
    function: Objective, y: FloatArray, value: float, slope: FloatArray, direction: FloatArray
) -> tuple[_Point | None, int]:
    """Return a point of sufficient decrease on the projected ray, if possible of flatter slope."""
    below, above, t = 0.0, np.inf, 1.0
    best: _Point | None = None
    steepness = float(slope @ direction)
    for count in range(1, 11):
        there = y + t * direction
        inside = np.clip(there, 0.0, 1.0)
        new, new_slope = function(inside)
        if new > value + _DECREASE * float(slope @ (inside - y)):
            above = t
        else:
            if best is None or new < best[1]:
                best = (inside, new, new_slope)
            projected = (there != inside).any()
            if projected or float(new_slope @ direction) >= _CURVATURE * steepness:
                return best, count
            below = t
        t = (below + above) / 2.0 if above < np.inf else 2.0 * t
    return best, 10
