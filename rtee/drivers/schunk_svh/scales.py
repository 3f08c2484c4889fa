"""What the SVH measures and is told, in SI units, for all its channels at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rtee.drivers.schunk_svh.channels import Channel
from rtee.drivers.schunk_svh.codec import FeedbackAll
from rtee.types import FloatArray

_LEEWAY = 1000
"""Change of a position that may be noise, at any speed [ticks]."""


class Scales:
    """The units of the channels in use, worked out once for a homed hand.

    Args:
        channels: The channels in use, in the order of the actuators.
        stops: Stops found by homing [ticks], by channel; without one a channel has no position.
        rates: Fastest motion of each channel [ticks/s].

    Attributes:
        homed: Which channels have a position.
    """

    def __init__(
        self, channels: Sequence[Channel], stops: Mapping[int, int], rates: Sequence[float]
    ) -> None:
        self._index = [c.index for c in channels]
        self._slope = np.array([c.rad_per_tick for c in channels])
        self._zero = np.array(
            [float(c.zero(stops[c.index])) if c.index in stops else np.nan for c in channels]
        )
        self._offset = np.nan_to_num(self._zero)
        limits = [c.soft_limits(stops.get(c.index, 0)) for c in channels]
        self._low = np.array([float(low) for low, _ in limits])
        self._high = np.array([float(high) for _, high in limits])
        self._sign = np.array([float(-c.direction) for c in channels])
        self._force = np.array([c.force_slope * c.lever for c in channels])
        self._least = np.array([c.force_offset * c.lever for c in channels])
        self._least[self._force == 0.0] = np.nan
        self._rate = 2.0 * np.array(rates)
        self.homed = [c.index in stops for c in channels]

    def measured(
        self, feedback: FeedbackAll, ticks: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return positions [rad], efforts [N·m] and currents [A]; ``NaN`` where not known.

        Args:
            feedback: What the hand told.
            ticks: Its positions, from `ticks`.
        """
        current = np.array([feedback.currents_ma[i] for i in self._index], dtype=np.float64)
        position = (ticks - self._zero) * self._slope
        size = np.maximum(0.0, self._force * np.abs(current) + self._least)
        return position, np.copysign(size, current * self._sign), current * 1e-3

    def targets(self, position: FloatArray) -> list[int]:
        """Return the targets of positions [rad], within the soft limits [ticks]."""
        ticks = np.rint(position / self._slope) + self._offset
        return [int(t) for t in np.minimum(np.maximum(ticks, self._low), self._high).tolist()]

    def jumped(self, before: FloatArray, after: FloatArray, dt: float) -> bool:
        """Return whether a position [ticks] changed more than a finger can move in ``dt`` [s]."""
        return bool((np.abs(after - before) > _LEEWAY + dt * self._rate).any())

    def ticks(self, feedback: FeedbackAll) -> FloatArray:
        """Return the positions of the channels in use [ticks]."""
        return np.array([feedback.positions[i] for i in self._index], dtype=np.float64)
