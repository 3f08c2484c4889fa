"""The resolution of a search in coordinates, values and slopes.

The functions that searches minimise have kinks, and a descent ends on one: the last digit would
decide which of two faces is measured there, and with it every later step. So a search has a
resolution: it stays on the points of a lattice, and rounds what it measures there. Another
processor's last digits, or a joint origin that is off by a nanometre, are far below the resolution
and lead to the same points, except where a number lies within that nanometre of a rounding
boundary.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from rtee.sample import FloatArray

_GOLDEN: Final = (5.0**0.5 - 1.0) / 2.0
"""The golden section, whose multiples modulo 1 are the most evenly spread ones."""


@dataclass(frozen=True, slots=True)
class Resolution:
    """Units that a search rounds to; powers of two, so that rounding to them is exact.

    Attributes:
        coordinate: Of coordinates, as a part of an actuator's range.
        value: Of values [m].
        slope: Of derivatives by coordinates [m].
    """

    coordinate: float
    value: float
    slope: float

    def snap(self, y: FloatArray) -> FloatArray:
        """Return the point of the lattice next to coordinates ``(k,)``."""
        # All factors are powers of two: scaling by them is exact.
        shift, unit = _shifts(len(y)), self.coordinate
        point: FloatArray = (np.rint(y * (1.0 / unit) - shift) + shift) * unit
        return point

    def snap_box(self, bounds: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return the outermost points of the lattice in a box; its corners where it holds none.

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
        """Return a value [m] rounded."""
        return round(value / self.value) * self.value

    def rounded_slope(self, slope: FloatArray) -> FloatArray:
        """Return a derivative ``(k,)`` [m] rounded."""
        rounded: FloatArray = np.rint(slope * (1.0 / self.slope)) * self.slope
        return rounded


@lru_cache(maxsize=64)
def _shifts(size: int) -> FloatArray:
    """Return where the lattice's points lie between whole multiples of the unit ``(k,)``.

    Where all fingers have the same posture, at a limit or half-way, surfaces are parallel, and the
    last digit decides which of two equal normals is found. Shifts that are multiples of the golden
    section, of which no two are alike, keep the lattice off such postures. They are multiples of
    1/64, so that points are exact.
    """
    shifts: FloatArray = np.floor(np.arange(1, size + 1) * _GOLDEN % 1.0 * 64.0) / 64.0
    shifts.flags.writeable = False
    return shifts


COARSE: Final = Resolution(2.0**-11, 2.0**-16, 2.0**-10)
"""To explore: a fingertip moves by about 0.1 mm from point to point; values to 15 µm."""

MEDIUM: Final = Resolution(2.0**-13, 2.0**-18, 2.0**-10)
"""To improve poses among constraints: about 10 µm from point to point, values to 4 µm."""

FINE: Final = Resolution(2.0**-17, 2.0**-27, 2.0**-20)
"""To polish: about 1 µm from point to point, values to 7 nm."""
