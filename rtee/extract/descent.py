"""Local minimisation of a piecewise smooth function in a box, by a projected BFGS method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.extract.resolution import COARSE, Resolution
from rtee.hand.linalg import dot, matvec
from rtee.sample import FloatArray

Slope = Callable[[], FloatArray]
"""Returns the derivative ``(k,)`` of a function at its last evaluation.

Must be called before the next evaluation, if at all: half of the steps of a line search are too
long and need no derivative."""

Objective = Callable[[FloatArray], tuple[float, Slope]]
"""Returns the value at coordinates in the unit box, and a function that returns its derivative."""

Bounds = tuple[FloatArray | float, FloatArray | float]
"""Lower and upper corner of the box that bounds the coordinates."""

_DECREASE: Final = 1e-4
_CURVATURE: Final = 0.5
"""Shares of the initial slope in the two weak Wolfe conditions. The first is the usual one; the
second is less than the usual 0.9, since going on beyond a kink gains little."""

_FIRST_STEP: Final = 0.1
_LONGEST_STEP: Final = 0.5
"""Longest steps in the coordinate that moves farthest, as shares of an actuator's range: before the
curvature is known, and in general."""

_FLAT: Final = 1e-10
"""Size below which a derivative counts as 0 [m]: far below the unit of every resolution."""

_CURVED: Final = 1e-14
"""Curvature along a step below which it is a rounding error and does not update the model [m]."""

_MOST_TRIALS: Final = 10
"""Maximum number of points of a line search; ten halvings of the longest step give the coarse unit.
"""


@dataclass(frozen=True, slots=True)
class Minimum:
    """End of a descent.

    Attributes:
        y: Coordinates ``(k,)``.
        value: Value of the function there.
        evaluations: Number of evaluations of the function.
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
    resolution: Resolution = COARSE,
    enough: float = -np.inf,
) -> Minimum:
    """Return a local minimum by projected BFGS.

    Makes quasi-Newton steps in the coordinates that are not held at a bound, with a line search for
    the weak Wolfe conditions. With these, BFGS converges even on functions with kinks, where the
    derivative jumps (Lewis and Overton, 2013). If it stalls, it restarts once from the identity.

    Args:
        function: The function to minimise.
        start: Coordinates ``(k,)``.
        evaluations: Maximum number of evaluations.
        bounds: Corners of the box.
        resolution: Units to which coordinates, values and slopes are rounded. If a step gains no
            more than one unit of the value, the descent has stalled.
        enough: Value at or below which the descent ends.
    """
    low, high = np.zeros(len(start)) + bounds[0], np.zeros(len(start)) + bounds[1]
    bounds = low, high = resolution.snap_box((low, high))
    y = within(resolution.snap(start), bounds)
    value, slope = _measured(function, y, resolution)
    count, fresh, restarted = 1, True, False
    inverse = np.eye(len(y))
    while count < evaluations and value > enough:
        # Hold coordinates at a bound that would leave the box in this step.
        held = ((y <= low) & (slope > 0.0)) | ((y >= high) & (slope < 0.0))
        free = np.where(held, 0.0, slope)
        if max(map(abs, free.tolist()), default=0.0) < _FLAT:
            break
        direction = np.where(held, 0.0, -matvec(inverse, free))
        if dot(direction, free) >= 0.0:  # not a descent: the model is useless beyond a kink
            direction, inverse, fresh = -free, np.eye(len(y)), True
        longest = max(map(abs, direction.tolist()))
        if fresh:
            direction *= _FIRST_STEP / longest
        elif longest > _LONGEST_STEP:
            direction *= _LONGEST_STEP / longest
        point, used = _search_line(function, (y, value, free), direction, bounds, resolution)
        count += used
        if point is None or value - point[1] <= resolution.value:  # stalled
            if point is not None:
                y, value, slope = point
            # Stalled along the gradient itself, so this is a minimum, or as good as one.
            if restarted or fresh:
                break
            inverse, fresh, restarted = np.eye(len(y)), True, True
            continue
        step, change = point[0] - y, point[2] - slope
        y, value, slope = point
        along = dot(step, change)
        if along > _CURVED:
            # Before the first update, scale the identity to the measured curvature (Nocedal and
            # Wright, Numerical Optimization, 2006, equation 6.20).
            if fresh:
                inverse = np.eye(len(y)) * (along / dot(change, change))
            inverse, fresh = _updated(inverse, step, change, along), False
    return Minimum(y, value, count)


def _updated(inverse: FloatArray, step: FloatArray, change: FloatArray, along: float) -> FloatArray:
    """Return the BFGS update of the inverse Hessian after a step that changed the slope.

    ``along`` is the product of the step and the change.
    """
    # As a symmetric sum of two outer products.
    bent = matvec(inverse, change) / along
    half = (0.5 * (dot(change, bent) + 1.0) / along) * step - bent
    update = step[:, None] * half
    return inverse + (update + update.T)


def _measured(
    function: Objective, y: FloatArray, resolution: Resolution
) -> tuple[float, FloatArray]:
    value, rise = function(y)
    return resolution.rounded_value(value), resolution.rounded_slope(rise())


def within(y: FloatArray, bounds: Bounds) -> FloatArray:
    """Return coordinates clamped to a box."""
    return np.minimum(np.maximum(y, bounds[0]), bounds[1])


_Point = tuple[FloatArray, float, FloatArray]


def _search_line(
    function: Objective,
    origin: _Point,
    direction: FloatArray,
    bounds: Bounds,
    resolution: Resolution,
) -> tuple[_Point | None, int]:
    """Return a point of sufficient decrease on the projected ray, or ``None``.

    If possible, the slope there is also flatter. The second value is the number of evaluations.
    """
    y, value, slope = origin
    below, above, t = 0.0, np.inf, 1.0
    best: _Point | None = None
    here = y.tolist()
    steepness = dot(slope, direction)
    for count in range(_MOST_TRIALS):
        there = resolution.snap(y + t * direction)
        inside = within(there, bounds)
        # The step is shorter than one unit of the lattice.
        if inside.tolist() == here:
            return best, count
        new, rise = function(inside)
        new = resolution.rounded_value(new)
        if new > value + _DECREASE * dot(slope, inside - y):
            above = t
        else:
            # Only here: half of the trials are too long and need no derivative.
            new_slope = resolution.rounded_slope(rise())
            if best is None or new < best[1]:
                best = (inside, new, new_slope)
            projected = there.tolist() != inside.tolist()
            # At a face of the box, the slope along the direction has no meaning.
            if projected or dot(new_slope, direction) >= _CURVATURE * steepness:
                return best, count + 1
            below = t
        # Double the step until it is too long, then bisect, which also converges on kinks.
        t = (below + above) / 2.0 if above < np.inf else 2.0 * t
    return best, _MOST_TRIALS
