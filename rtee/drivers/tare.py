"""Subtract the readings of contact sensors at rest."""

from __future__ import annotations

import numpy as np

from rtee.sample import FloatArray

_DRIFT = 30.0
"""Time constant with which rest values follow readings below the threshold [s]: the drift of a
sensor takes minutes, and no contact of a hand grows this slowly."""
_RELEASE = 0.2
"""Time constant with which they follow a reading that is too low [s]: a rest value taken during a
contact is wrong as soon as the contact ends, but one noisy reading must not change it."""


class SensorTare:
    """The rest values of contact sensors, and the readings above them.

    The first readings count as those of untouched sensors, so an object that is held at connection
    is not felt until it has been let go. Rest values then follow slow drift.

    Args:
        threshold: Difference above which a reading is a contact [the readings' unit]: above the
            sensors' noise.
    """

    def __init__(self, threshold: float) -> None:
        self._threshold = threshold
        self._rest: FloatArray | None = None
        self._count = 0
        self._stamp = 0.0

    def reset(self) -> None:
        """Count the next reading as that of untouched sensors."""
        self._rest = None

    def above(self, values: FloatArray, stamp: float) -> FloatArray:
        """Return the excess of readings over the rest values, 0 for those within the threshold.

        Args:
            values: The readings ``(n,)``; ``NaN``: not measured.
            stamp: Time of the readings [s].
        """
        if self._rest is None:
            self._rest, self._count = np.array(values), 0
        dt = max(0.0, stamp - self._stamp) if self._count else 0.0
        self._stamp = stamp
        self._count += 1
        # A sensor that measured nothing so far begins with its first reading.
        rest = np.where(np.isnan(self._rest), values, self._rest)
        change = values - rest
        # At first the mean of all readings, so that the first one's noise does not stay.
        slow = max(1.0 / self._count, -np.expm1(-dt / _DRIFT))
        share = np.where(change < -self._threshold, -np.expm1(-dt / _RELEASE), slow)
        quiet = change <= self._threshold  # not where a reading is NaN
        self._rest = np.where(quiet, rest + share * change, rest)
        return np.where(quiet, 0.0, change)
