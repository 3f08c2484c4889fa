"""Computes the set-points of the six motors from their targets, in each mode. No I/O."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rtee.drivers.ability_hand import codec
from rtee.drivers.ability_hand.codec import COUNT, Header, Reply

SPEEDS = (8.068,) * 5 + (40.34,)
"""Largest velocities of the joints, from the maker's model [rad/s]."""
EFFORTS = (6.0,) * 5 + (1.2,)
"""Largest efforts of the joints, from the same model [N·m]."""
_REFERRED = tuple((gear / codec.GEARS[0]) ** 2 for gear in codec.GEARS)
"""Factor of the gains of each motor: the rotors are equal, but not their gear ratios."""


class MotorControl:
    """Computes the set-points of the six motors; signs are those of the wire.

    In velocity mode and in current mode, this class controls the positions: it commands a velocity
    proportional to the error, or a torque from error and velocity, both limited. One command sets
    all six motors, so a motor without a reference stays where it was at the first command.

    Attributes:
        header: Header of the set-points.
        approach: Velocity per position error [1/s].
        stiffness: Effort of a digit per position error [N·m/rad]; for the thumb's rotation it is
            reduced by the square of the ratio of the gears.
        damping: Effort per velocity, scaled in the same way [N·m·s/rad].
        targets: Target of each motor [rad].
    """

    def __init__(
        self, header: Header, *, approach: float, stiffness: float, damping: float
    ) -> None:
        self.header = header
        self.approach = approach
        self.stiffness = stiffness
        self.damping = damping
        self.targets = [0.0] * COUNT
        self._feed = [0.0] * COUNT
        self._speeds = list(SPEEDS)
        self._efforts = list(EFFORTS)

    def hold(self, reply: Reply) -> None:
        """Make the measured positions the targets of all motors."""
        self.targets = [codec.angle(counts) for counts in reply.positions]
        self._feed = [0.0] * COUNT
        self._speeds, self._efforts = list(SPEEDS), list(EFFORTS)

    def aim(
        self, motor: int, target: float, feed: float, max_velocity: float, max_effort: float
    ) -> None:
        """Set the target [rad] of one motor, which moves at ``feed`` [rad/s].

        Its limits of velocity [rad/s] and effort [N·m] may be infinite.
        """
        self.targets[motor] = target
        self._feed[motor] = feed
        self._speeds[motor] = min(abs(max_velocity), SPEEDS[motor])
        self._efforts[motor] = min(abs(max_effort), EFFORTS[motor])

    def words(self, reply: Reply) -> tuple[int, ...]:
        """Return the six words of the next command, given the newest measurement."""
        if self.header is Header.POSITION:
            return tuple(codec.angle_counts(target) for target in self.targets)
        here = [codec.angle(counts) for counts in reply.positions]
        errors = [target - at for target, at in zip(self.targets, here, strict=True)]
        if self.header is Header.VELOCITY:
            return tuple(
                # Without the feed, a joint would trail a moving target by a constant error.
                codec.rate_counts(_within(self.approach * error + feed, most))
                for error, feed, most in zip(errors, self._feed, self._speeds, strict=True)
            )
        torques = self._torques(errors, reply.velocities)
        return tuple(codec.effort_counts(torque, motor) for motor, torque in enumerate(torques))

    def _torques(self, errors: Sequence[float], velocities: Sequence[int]) -> list[float]:
        # The first replies of a hand in fast mode may be of another variant, without velocities.
        counts = velocities or (0,) * COUNT
        torques = []
        for motor, error in enumerate(errors):
            rate = codec.velocity(counts[motor], motor)
            torque = self.stiffness * error + self.damping * (self._feed[motor] - rate)
            # Limited at the end, since the limit applies to the sum of both terms.
            torques.append(_within(_REFERRED[motor] * torque, self._efforts[motor]))
        return torques


def _within(value: float, most: float) -> float:
    return math.copysign(min(abs(value), most), value)
