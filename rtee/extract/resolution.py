"""The resolution of a search in coordinates, values and slopes.

The functions that searches minimise have kinks, on which descents end. There, the last digit would
decide which of two faces is measured, and thereby every later step. A search therefore stays on a
lattice of points and rounds its measurements. Differences in last digits between processors, or a
nanometre in a joint's origin, are far below this resolution and lead to the same points, unless a
number lies within that nanometre of a rounding boundary.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from rtee.sample import FloatArray

_GOLDEN: Final = (5.0**0.5 - 1.0) / 2.0
"""The golden ratio, whose multiples modulo 1 are spread most evenly."""


@dataclass(frozen=True, slots=True)
class Resolution:
    """Rounding units of a search; as powers of two, they are exact.

    Attributes:
        coordinate: Unit of coordinates, as a share of an actuator's range.
        value: Unit of values [m].
        slope: Unit of derivatives by coordinates [m].
    """

    coordinate: float
    value: float
    slope: float

    def snap(self, y: FloatArray) -> FloatArray:
        """Return the lattice point nearest to coordinates ``(k,)``."""
        # Scaling is exact, since all factors are powers of two.
        shift, unit = _shifts(len(y)), self.coordinate
        return (np.rint(y * (1.0 / unit) - shift) + shift) * unit

    def snap_box(self, bounds: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return the outermost lattice points in a box, or its own corners where it has none.

        Args:
            bounds: Lower and upper corner of the box ``(k,)``.
        """
        low, high = bounds
        shift, unit = _shifts(len(low)), self.coordinate
        first = (np.ceil(low * (1.0 / unit) - shift) + shift) * unit
        last = (np.floor(high * (1.0 / unit) - shift) + shift) * unit
        some = first <= last
        return np.where(some, first, low), np.where(some, last, high)

    def rounded_value(self, value: float) -> float:
        """Return a value [m], rounded."""
        return round(value / self.value) * self.value

    def rounded_slope(self, slope: FloatArray) -> FloatArray:
        """Return a derivative ``(k,)`` [m], rounded."""
        return np.rint(slope * (1.0 / self.slope)) * self.slope


@lru_cache(maxsize=64)
def _shifts(size: int) -> FloatArray:
    """Return the offsets of the lattice from whole multiples of the unit ``(k,)``."""
    # If all fingers have the same posture, at a limit or half-way, surfaces are parallel, and the
    # last digit decides which of two equal normals is found. Different offsets, multiples of the
    # golden ratio, keep the lattice off such postures. They are rounded to 1/64, so that points
    # are exact.
    shifts: FloatArray = np.floor(np.arange(1, size + 1) * _GOLDEN % 1.0 * 64.0) / 64.0
    shifts.flags.writeable = False
    return shifts


COARSE: Final = Resolution(2.0**-11, 2.0**-16, 2.0**-10)
"""Resolution for exploring: about 0.1 mm at a fingertip, values to 15 µm."""

MEDIUM: Final = Resolution(2.0**-13, 2.0**-18, 2.0**-10)
"""Resolution for improving under constraints: about 10 µm at a fingertip, values to 4 µm."""

FINE: Final = Resolution(2.0**-17, 2.0**-27, 2.0**-20)
"""Resolution for polishing: about 1 µm at a fingertip, values to 7 nm."""
