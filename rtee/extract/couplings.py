"""The transmission for searches, with non-linear couplings interpolated from tables."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from rtee.extract.space import widened_limits
from rtee.hand.model import Hand
from rtee.hand.transmission import Coupling, Linear
from rtee.sample import FloatArray

_KNOTS: Final = 1025
"""Number of knots of a table, which agrees with smooth couplings to 1e-8 rad."""


class Couplings:
    """Computes joint positions from actuator positions, fast.

    Linear couplings are evaluated directly. Non-linear ones are tabulated at 1025 knots over the
    widened limits and interpolated by cubic Hermite polynomials. Tables agree with smooth couplings
    of real hands to 1e-8 rad, and to 3e-5 rad at kinks. Where an expression has no finite value,
    the table interpolates between its finite values.
    """

    def __init__(self, hand: Hand) -> None:
        matrix, self._offset = hand.transmission.matrix, hand.transmission.offset
        # A joint follows at most one actuator, so no sum is needed.
        self._mover = np.abs(matrix).argmax(axis=1)
        self._factor = matrix[np.arange(len(matrix)), self._mover]
        self.linear = hand.transmission.linear
        self._tables = [] if self.linear else _tables(hand)
        self._slope = np.array(hand.transmission.matrix)

    def joints(self, u: FloatArray) -> FloatArray:
        """Return joint positions ``(m,)`` at actuator positions ``(n,)`` [rad | m]."""
        q: FloatArray = self._factor * u[self._mover] + self._offset
        for table in self._tables:
            # These joints have zero rows in the matrix; the table holds their whole position.
            q[table.rows] = table.at(float(u[table.actuator]))[0]
        return q

    def slope(self, u: FloatArray) -> FloatArray:
        """Return dq/du ``(m, n)`` at actuator positions ``(n,)``; valid until the next call."""
        for table in self._tables:
            self._slope[table.rows, table.actuator] = table.at(float(u[table.actuator]))[1]
        return self._slope


class _Table:
    """The joints that follow one actuator non-linearly."""

    def __init__(
        self,
        actuator: int,
        rows: list[int],
        couplings: list[Coupling],
        bounds: tuple[float, float],
        known: dict[tuple[object, ...], FloatArray],
    ) -> None:
        low, high = bounds
        self.actuator = actuator
        self.rows = np.array(rows, dtype=np.intp)
        self._low, self._step = low, (high - low) / (_KNOTS - 1)
        # Two more knots beyond each end, for the central differences there.
        x: FloatArray = low + self._step * np.arange(-2.0, _KNOTS + 2.0)
        columns = []
        for coupling in couplings:
            key = (coupling.stages, low, high)
            # Fingers of one hand usually share their couplings.
            if key not in known:
                known[key] = _finite(_values(coupling, x))
            columns.append(known[key])
        wide = np.stack(columns, axis=1)
        self._values = wide[2:-2]
        # Central differences of fourth order, in units of the step.
        self._slopes = (wide[:-4] - 8.0 * wide[1:-3] + 8.0 * wide[3:-1] - wide[4:]) / 12.0

        self._last, self._result = math.nan, (self._values[0], self._slopes[0])

    def at(self, x: float) -> tuple[FloatArray, FloatArray]:
        """Return the joints' positions and derivatives; the last result is cached."""
        # Callers request position and slope one after the other, at the same position.
        if x != self._last:
            self._last, self._result = x, self._interpolate(x)
        return self._result

    def _interpolate(self, x: float) -> tuple[FloatArray, FloatArray]:
        place = (x - self._low) / self._step
        # Beyond the ends, extrapolate the polynomials of the last steps.
        i = min(max(int(place), 0), _KNOTS - 2)
        t = place - i
        s = 1.0 - t
        v, w, following, leaving = (
            self._values[i],
            self._slopes[i],
            self._values[i + 1],
            self._slopes[i + 1],
        )
        rise = following - v
        value = v + t * t * (3.0 - 2.0 * t) * rise + s * t * (s * w - t * leaving)
        slope = 6.0 * t * s * rise + s * (1.0 - 3.0 * t) * w - t * (2.0 - 3.0 * t) * leaving
        return value, slope / self._step


def _tables(hand: Hand) -> list[_Table]:
    lower, upper = widened_limits(hand)
    by_actuator: dict[int, list[int]] = {}
    for row, coupling in enumerate(hand.transmission.couplings):
        if coupling.actuator is not None and not coupling.linear:
            by_actuator.setdefault(coupling.actuator, []).append(row)
    known: dict[tuple[object, ...], FloatArray] = {}
    return [
        _Table(
            actuator,
            rows,
            [hand.transmission.couplings[row] for row in rows],
            (float(lower[actuator]), float(upper[actuator])),
            known,
        )
        for actuator, rows in by_actuator.items()
    ]


def _values(coupling: Coupling, x: FloatArray) -> FloatArray:
    for stage in coupling.stages:
        x = stage.factor * x + stage.offset if isinstance(stage, Linear) else stage.values(x)
    return x


def _finite(values: FloatArray) -> FloatArray:
    good = np.isfinite(values)
    if good.all():
        return values
    x = np.arange(len(values))
    # Expressions may have poles or roots outside the joint's real range.
    return np.interp(x, x[good], values[good])
