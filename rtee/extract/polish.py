"""Minimisation on a kink, after a descent, by a proximal bundle method."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtee.extract.descent import Bounds, Minimum, Objective, within
from rtee.extract.resolution import FINE, Resolution
from rtee.hand.linalg import dot, matmul, matvec, vecmat
from rtee.sample import FloatArray

_FIRST_STEP: Final = 0.3
"""Length of the first step in the steepest coordinate, as a share of an actuator's range."""

_SERIOUS: Final = 0.1
"""Share of the predicted gain that a step must reach to be taken; others only refine the model."""

_KEPT: Final = 14
"""Maximum number of linear pieces: more than meet at a kink for a dozen actuators."""

_ENOUGH: Final = 1e-6
"""Predicted gain, as a share of the value, below which the minimum is found."""

_ROUNDING: Final = 1e-10
"""Rounding error of the model, relative to its largest number."""

_SWEEPS: Final = 3
"""Maximum number of changes per coordinate between held and free before the step is used as it is.
"""

_TINY: Final = 1e-300
"""Substitute for a zero divisor."""

_sum = np.add.reduce


class _Pieces:
    """Linear pieces of a function: points, with the values and slopes there."""

    def __init__(self, y: FloatArray, value: float, slope: FloatArray) -> None:
        self.points = y[None, :]
        self.values = np.array([value])
        self.slopes = slope[None, :]

    def errors(self, y: FloatArray, value: float) -> FloatArray:
        """Return how far each piece lies below the function's value at a point, at least 0."""
        there = self.values + _sum(self.slopes * (y - self.points), axis=1)
        errors: FloatArray = np.maximum(0.0, value - there)
        return errors

    def drop(self, i: int) -> None:
        """Remove a piece."""
        self.points = np.delete(self.points, i, axis=0)
        self.values = np.delete(self.values, i)
        self.slopes = np.delete(self.slopes, i, axis=0)

    def add(self, y: FloatArray, value: float, slope: FloatArray) -> None:
        """Add a piece."""
        self.points = np.concatenate([self.points, y[None, :]])
        self.values = np.append(self.values, value)
        self.slopes = np.concatenate([self.slopes, slope[None, :]])


def polish(
    function: Objective,
    start: FloatArray,
    *,
    evaluations: int,
    bounds: Bounds = (0.0, 1.0),
    resolution: Resolution = FINE,
) -> Minimum:
    """Return a local minimum of the maximum of smooth functions.

    A depth is a minimum over the directions in which two parts can be separated. Minus the depth
    therefore has kinks, and its minima lie on them. The bundle method (Kiwiel, 1985) models the
    function by linear pieces at earlier points, and steps to the minimum of the model plus a
    proximal term.

    Args:
        function: The function to minimise.
        start: Coordinates in the box ``(k,)``.
        evaluations: Maximum number of evaluations.
        bounds: Corners of the box.
        resolution: Units to which coordinates, values and slopes are rounded.
    """
    box = tuple(np.broadcast_to(bound, start.shape) for bound in bounds)
    low, high = resolution.snap_box((box[0], box[1]))
    y = within(resolution.snap(start), (low, high))
    value, rise = function(y)
    value, slope = resolution.rounded_value(value), resolution.rounded_slope(rise())
    pieces = _Pieces(y, value, slope)
    scale = float(np.abs(slope).max())
    if scale == 0.0:
        return Minimum(y, value, 1)
    reach = _FIRST_STEP / scale
    weights, held = np.ones(1), np.zeros(len(y))
    tried: bytes | None = None
    for count in range(2, evaluations + 1):
        # The function is not convex; a piece above it at this point counts as touching it.
        errors, slopes = pieces.errors(y, value), pieces.slopes
        step, weights, held = _model_step(slopes, errors, (weights, held), y, reach, (low, high))
        predicted = -float((matvec(slopes, step) - errors).max())
        there = within(resolution.snap(y + step), (low, high))
        if predicted < _ENOUGH * abs(value) + resolution.value or (there == y).all():
            return Minimum(y, value, count)
        # The model already has this piece; all further steps would lead there again.
        if there.tobytes() == tried:
            break
        new, rise = function(there)
        new, new_slope = resolution.rounded_value(new), resolution.rounded_slope(rise())
        # Remove the piece with the least weight in the last step.
        if len(weights) >= _KEPT:
            least = int(np.argmin(weights))
            pieces.drop(least)
            weights = np.delete(weights, least)
        pieces.add(there, new, new_slope)
        weights = np.append(weights, 0.0)
        if new <= value - _SERIOUS * predicted:
            # If the gain is nearly as good as predicted, the next step may be longer.
            reach *= 2.0 if new <= value - 0.5 * predicted else 1.0
            # A serious step moves the centre of the model; any other only refines the model.
            y, value, tried = there, new, None
        # The step was too long: the new piece does not improve the model at y.
        elif value - new - dot(new_slope, y - there) > 2.0 * predicted:
            reach, tried = 0.5 * reach, None
        else:
            tried = there.tobytes()
    return Minimum(y, value, evaluations)


def _model_step(
    slopes: FloatArray,
    errors: FloatArray,
    guess: tuple[FloatArray, FloatArray],
    y: FloatArray,
    reach: float,
    box: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the step to the model's minimum in the box, the pieces' weights, and the held faces.

    Each coordinate is held at its lower bound (-1) or upper bound (1), or is free (0). The search
    starts from the weights and held coordinates in ``guess``.
    """
    low, high = box
    weights, side = guess
    held = side != 0.0
    fixed = np.where(held, np.where(side < 0.0, low, high) - y, 0.0)
    # Solve for the free coordinates, hold those that leave the box, free those pulled back; repeat.
    for _ in range(_SWEEPS * len(y)):
        some = bool(held.any())
        free = np.where(held, 0.0, slopes) if some else slopes
        linear = errors - matvec(slopes, fixed) if some else errors
        weights = _simplex_minimum(reach * matmul(free, free.T), linear, weights)
        step = fixed - reach * vecmat(weights, free)
        there = y + step
        leaving = ~held & ((there < low) | (there > high))
        if leaving.any():
            held |= leaving
        elif not some:
            break
        else:
            # Free held coordinates whose minimum of the model lies inside the box.
            pull = vecmat(weights, slopes) + fixed / reach
            freed = held & np.where(side < 0.0, pull < 0.0, pull > 0.0)
            if not freed.any():
                break
            held &= ~freed
        side = np.where(held, np.where(leaving, np.where(there < low, -1.0, 1.0), side), 0.0)
        # Move the held coordinates to the faces of the box, and solve for the rest again.
        fixed = np.where(held, np.where(side < 0.0, low, high) - y, 0.0)
    return within(y + step, box) - y, weights, side


def _simplex_minimum(matrix: FloatArray, linear: FloatArray, start: FloatArray) -> FloatArray:
    """Return the minimum of ``x·Mx / 2 + c·x`` over the simplex, by an active-set method.

    M is positive semidefinite. ``start`` has non-negative weights, which are scaled to sum 1.
    """
    count = len(linear)
    rows, offsets, weights = matrix.tolist(), linear.tolist(), start.tolist()
    total = sum(weights)
    if total <= 0.0:
        weights = [0.0] * count
        weights[offsets.index(min(offsets))] = total = 1.0
    face = {i: weight / total for i, weight in enumerate(weights) if weight}
    # Pieces may be linearly dependent; a ridge on the diagonal keeps the system definite.
    ridge = _ROUNDING * (1.0 + max(rows[i][i] for i in range(count)))
    for _ in range(4 * count):
        face = _on_face(rows, offsets, ridge, face)
        gradient = [
            offset + sum([row[i] * weight for i, weight in face.items()])
            for row, offset in zip(rows, offsets, strict=True)
        ]
        level, least = max(gradient[i] for i in face), min(gradient)
        # Optimal if no weight outside the face has a smaller derivative than those on it.
        entering = gradient.index(least)
        if entering in face or least > level - _ROUNDING * (1.0 + abs(level)):
            break
        # The steepest weight enters: a simple rule, fast enough for few pieces.
        face[entering] = 0.0
    x = np.zeros(count)
    x[list(face)] = list(face.values())
    return x


def _on_face(
    rows: list[list[float]], offsets: list[float], ridge: float, face: dict[int, float]
) -> dict[int, float]:
    """Return the minimum over a face of the simplex, or over a subface that limits the step.

    ``face`` gives the face by one of its points, the weights of its free coordinates. The ridge,
    added to the diagonal of M (``rows``), makes it definite; ``offsets`` is c.
    """
    while len(face) > 1:
        support = list(face)
        block = [[rows[i][j] for j in support] for i in support]
        for k, row in enumerate(block):
            row[k] += ridge
            row += (-offsets[support[k]], 1.0)
        plain, even = _solved(block)
        slack = (1.0 - sum(plain)) / sum(even)
        target = [a + slack * b for a, b in zip(plain, even, strict=True)]
        if min(target) > 0.0:
            return dict(zip(support, target, strict=True))
        shares = [
            (here / max(here - there, _TINY), k)
            for k, (here, there) in enumerate(zip(face.values(), target, strict=True))
            if there <= 0.0
        ]
        share, drop = min(shares)
        share = min(1.0, share)
        face = {
            i: max(0.0, here + share * (there - here))
            for k, ((i, here), there) in enumerate(zip(face.items(), target, strict=True))
            if k != drop
        }
    return dict.fromkeys(face, 1.0)


def _solved(block: list[list[float]]) -> tuple[list[float], list[float]]:
    """Return the solutions of a small definite system for two right-hand sides.

    The last two columns of ``block`` are the right-hand sides.
    """
    # Gaussian elimination in place: for the few pieces at a kink, it is faster than LAPACK, and
    # gives the same digits on every processor.
    size = len(block)
    for k, pivot in enumerate(block):
        for i in range(k + 1, size):
            # The part below the diagonal mirrors the part above it.
            factor = pivot[i] / pivot[k]
            if factor:
                row = block[i]
                row[i:] = [a - factor * b for a, b in zip(row[i:], pivot[i:], strict=True)]
    plain, even = [0.0] * size, [0.0] * size
    for k in range(size - 1, -1, -1):
        row = block[k]
        a, b = row[size], row[size + 1]
        for j in range(k + 1, size):
            a -= row[j] * plain[j]
            b -= row[j] * even[j]
        plain[k], even[k] = a / row[k], b / row[k]
    return plain, even
