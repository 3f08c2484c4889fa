"""From the RH56's counts and grams to positions, velocities and efforts of its actuators.

The force curves are published measurements of one hand with a force meter; those of ring and little
finger were not measured and are the mean of index and middle finger. The thumb's rotation was not
measured either: its grams are taken at face value.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rtee.capabilities import GripForce
from rtee.drivers.inspire_rh56.codec import MOST, OPEN
from rtee.drivers.scale import LinearScale

LEAST = 100
"""Smallest force limit for which the curves hold [g]; below it they are replaced by lines to 0."""

_GRAVITY = 9.80665e-3  # newtons of a gram


@dataclass(frozen=True, slots=True)
class Force:
    """The force curve of a finger, and the lever with which its force acts on the actuator.

    Attributes:
        newton_per_gram: Slope of the curve [N/g].
        offset: Force of the curve at 0 g [N].
        arm: Effort of the actuator per force at the fingertip [N·m/N].
    """

    newton_per_gram: float
    offset: float
    arm: float

    def newtons(self, grams: float) -> float:
        """Return the force at the fingertip [N] for a reading or limit in grams."""
        if abs(grams) < LEAST:
            return grams / LEAST * self.newtons(LEAST)
        return self.newton_per_gram * grams + (self.offset if grams > 0.0 else -self.offset)

    def grams(self, newtons: float) -> float:
        """Return the grams for a force at the fingertip [N], which is not negative."""
        least = self.newtons(LEAST)
        if newtons < least:
            return newtons / least * LEAST
        return (newtons - self.offset) / self.newton_per_gram


# The arms follow from the lengths of the phalanges with their couplings, half bent.
FORCES = {
    "little": Force(6.965e-3, -0.198, 0.085),
    "ring": Force(6.965e-3, -0.198, 0.10),
    "middle": Force(6.452e-3, 0.018, 0.10),
    "index": Force(7.478e-3, -0.414, 0.10),
    "thumb_bend": Force(12.547e-3, 0.384, 0.15),
    "thumb_rotate": Force(_GRAVITY, 0.0, 0.07),
}
"""The default force curves of the fingers, by name."""


class Scale:
    """Converts between the registers of a motor and its actuator's units.

    Args:
        lower: Position of the actuator at `OPEN` [rad].
        upper: Position of the actuator at 0 counts [rad].
        force: Its force curve.
        most: Largest force limit of the hand [g].
        travel_time: Time for the whole travel at the largest speed [s].
        reverse: Whether counts rise with the position instead.

    Attributes:
        position: Angle counts to [rad].
    """

    def __init__(
        self,
        lower: float,
        upper: float,
        force: Force,
        *,
        most: int,
        travel_time: float,
        reverse: bool = False,
    ) -> None:
        counts = (0.0, float(OPEN)) if reverse else (float(OPEN), 0.0)
        self.position = LinearScale(counts, (lower, upper))
        self._force = force
        self._most = most
        self._sign = -1.0 if reverse else 1.0
        self._fastest = (upper - lower) / travel_time

    def angle(self, count: int) -> float:
        """Return the position [rad] of an angle count, limited to the ends of the travel."""
        return self.position.to_si(min(max(count, 0), OPEN))

    def effort(self, grams: float) -> float:
        """Return the effort [N·m] of a measured force."""
        return self._sign * self._force.newtons(grams) * self._force.arm

    def limit(self, effort: float) -> int:
        """Return the force limit [g] for an effort limit [N·m], which may be infinite."""
        if math.isinf(effort):
            return self._most
        # At least 1: no source says whether 0 switches the motor off.
        return min(max(round(self._force.grams(effort / self._force.arm)), 1), self._most)

    def speed(self, velocity: float) -> int:
        """Return the speed count for a velocity limit [rad/s], which may be infinite."""
        share = min(velocity / self._fastest, 1.0)
        # At least 1: at speed 0 a finger would never arrive.
        return max(round(MOST * share), 1)

    @property
    def grip(self) -> GripForce:
        """The force at the fingertip by effort limit."""
        force = self._force
        # From LEAST on: nothing was measured below, so no force is promised there.
        low, high = force.newtons(LEAST), force.newtons(self._most)
        return GripForce((low * force.arm, high * force.arm), (low,), (high,))
