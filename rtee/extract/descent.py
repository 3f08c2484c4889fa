"""Local minimisation of a piecewise smooth function in a box."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.types import FloatArray

Slope = Callable[[], FloatArray]
"""Returns the derivative ``(k,)`` where a function was evaluated last.

It is asked for before the next evaluation, or not at all: half of the steps that a line search
tries are too long, and nobody needs the derivative there."""

Objective = Callable[[FloatArray], tuple[float, Slope]]
"""From coordinates in the unit box to the value and what returns its derivative."""

Bounds = tuple[FloatArray | float, FloatArray | float]
"""Lower and upper corner of the box that coordinates stay in."""

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
    function: Objective,
    start: FloatArray,
    *,
    evaluations: int,
    bounds: Bounds = (0.0, 1.0),
    tolerance: float = 1e-8,
    enough: float = -np.inf,
) -> Minimum:
    """Return a local minimum by projected BFGS.

    Quasi-Newton steps on the coordinates that are not held at a bound, with a line search for the
    weak Wolfe conditions. These suffice on functions with kinks, where the method converges though
    the derivative jumps (Lewis and Overton, 2013). Where it stalls, it begins anew once with the
    identity.

    Args:
        function: What to minimise.
        start: Coordinates ``(k,)``.
        evaluations: Most evaluations.
        bounds: Corners of the box.
        tolerance: A step that gains less ends the descent.
        enough: A value at which the descent ends.
    """
    low, high = np.zeros(len(start)) + bounds[0], np.zeros(len(start)) + bounds[1]
    bounds = low, high  # two numbers are slower to compare with
    y = within(start, bounds)
    value, rise = function(y)
    slope = rise()
    count, fresh, restarted = 1, True, False
    inverse = np.eye(len(y))
    while count < evaluations and value > enough:
        held = ((y <= low) & (slope > 0.0)) | ((y >= high) & (slope < 0.0))
        free = np.where(held, 0.0, slope)
        if max(map(abs, free.tolist()), default=0.0) < 1e-10:
            break
        direction = np.where(held, 0.0, -inverse.dot(free))
        if direction.dot(free) >= 0.0:
            direction, inverse, fresh = -free, np.eye(len(y)), True
        longest = max(map(abs, direction.tolist()))
        if fresh:
            direction *= _FIRST_STEP / longest
        elif longest > _LONGEST_STEP:
            direction *= _LONGEST_STEP / longest
        found, used = _search_line(function, (y, value, free), direction, bounds)
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
        along = float(step.dot(change))
        if along > 1e-14:
            if fresh:
                inverse = np.eye(len(y)) * (along / float(change.dot(change)))
            bent = inverse.dot(change) / along
            half = (0.5 * (float(change.dot(bent)) + 1.0) / along) * step - bent
            update = step[:, None] * half
            inverse = inverse + (update + update.T)
            fresh = False
    return Minimum(y, value, count)


def within(y: FloatArray, bounds: Bounds) -> FloatArray:
    """Return coordinates clamped into a box."""
    clamped: FloatArray = np.minimum(np.maximum(y, bounds[0]), bounds[1])
    return clamped


_Point = tuple[FloatArray, float, FloatArray]


def _search_line(
    function: Objective, origin: _Point, direction: FloatArray, bounds: Bounds
) -> tuple[_Point | None, int]:
    """Return a point of sufficient decrease on the projected ray, if possible of flatter slope."""
    y, value, slope = origin
    below, above, t = 0.0, np.inf, 1.0
    best: _Point | None = None
    steepness = float(slope.dot(direction))
    for count in range(1, 11):
        there = y + t * direction
        inside = within(there, bounds)
        new, rise = function(inside)
        if new > value + _DECREASE * float(slope.dot(inside - y)):
            above = t
        else:
            new_slope = rise()
            if best is None or new < best[1]:
                best = (inside, new, new_slope)
            projected = there.tolist() != inside.tolist()
            if projected or float(new_slope.dot(direction)) >= _CURVATURE * steepness:
                return best, count
            below = t
        t = (below + above) / 2.0 if above < np.inf else 2.0 * t
    return best, 10
