"""The SVH's measurements and targets in SI units, for all its channels at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from operator import sub

import numpy as np

from rtee.drivers.schunk_svh.channels import Channel
from rtee.drivers.schunk_svh.codec import FeedbackAll
from rtee.sample import FloatArray

_LEEWAY = 1000
"""Change of a position that is plausible at any speed [ticks]: 1 to 3 % of a range."""


class Scales:
    """The units of the channels in use, computed once for a homed hand.

    Args:
        channels: The channels in use, in the order of the actuators.
        stops: Stops found by homing [ticks], by channel; a channel without one has no position.
        rates: Largest speed of each channel [ticks/s].

    Attributes:
        homed: Whether each channel has a position.
    """

    def __init__(
        self, channels: Sequence[Channel], stops: Mapping[int, int], rates: Sequence[float]
    ) -> None:
        self._index = [c.index for c in channels]
        # Twice the commanded rate, since a finger may be pushed and packets may be late.
        self._rate = [2.0 * rate for rate in rates]
        self.homed = [c.index in stops for c in channels]
        # Numbers instead of arrays: for so few, numpy takes longer, and this runs in every cycle.
        self._measuring = [
            (
                c.index,
                float(c.zero(stops[c.index])) if c.index in stops else math.nan,
                c.rad_per_tick,
                c.force_slope * c.lever,
                c.force_offset * c.lever if c.force_slope * c.lever else math.nan,
                -float(c.direction),  # also the sign of a zero current
            )
            for c in channels
        ]
        self._moving = [
            (c.rad_per_tick, c.zero(stops[c.index]), *c.soft_limits(stops[c.index]))
            if c.index in stops
            else (c.rad_per_tick, 0, *c.soft_limits(0))
            for c in channels
        ]

    def measured(self, feedback: FeedbackAll) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return positions [rad], efforts [N·m] and currents [A]; ``NaN`` where not known."""
        positions, currents = feedback.positions, feedback.currents_ma
        where, efforts = [], []
        for index, zero, slope, force, least, sign in self._measuring:
            where.append((positions[index] - zero) * slope)
            current = currents[index]
            effort = force * abs(current) + least
            efforts.append(math.copysign(0.0 if effort < 0.0 else effort, current * sign))
        return (
            np.array(where),
            np.array(efforts),
            np.array([currents[index] * 1e-3 for index in self._index]),
        )

    def targets(self, position: FloatArray) -> list[int]:
        """Return the targets [ticks] for positions [rad], within the soft limits."""
        return [
            min(max(round(q / slope) + zero, low), high)
            for q, (slope, zero, low, high) in zip(position.tolist(), self._moving, strict=True)
        ]

    def jumped(self, before: FeedbackAll, after: FeedbackAll, dt: float) -> bool:
        """Return whether a position changed more than a finger can move in ``dt`` [s]."""
        moved = list(map(sub, after.positions, before.positions))
        if min(moved) >= -_LEEWAY and max(moved) <= _LEEWAY:
            return False  # the usual case, decided quickly in every cycle
        return any(
            abs(moved[index]) > _LEEWAY + dt * rate
            for index, rate in zip(self._index, self._rate, strict=True)
        )
