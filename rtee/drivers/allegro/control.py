"""The joint controller of a torque-controlled hand: PD, with an integral term at rest. No I/O."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rtee.drivers.allegro.codec import FINGERS, JOINTS, LIMITS_PWM, PER_FINGER, JointScale

_AT_REST = 0.05
"""Largest speed of a reference that counts as at rest [rad/s]."""
_STILL = 0.2
"""Largest speed at which friction holds a joint, or soon will [rad/s]."""
_GAP = 0.1
"""Longest time between two sets of frames [s]. A longer one means that frames were lost, so neither
velocity nor integral can be computed."""
_PARTIAL = 4 * FINGERS
"""Frames without a complete set after which a finger counts as missing; the vendor's program for
earlier hands tolerates three incomplete sets."""
_CLOSE = 0.002
"""Error below which the integral does not grow [rad], as it would only make the joint oscillate."""


class JointControl:
    """Computes torques from positions, once per complete set of the hand's position frames.

    The integral compensates friction and weight, which leave a permanent error. It grows only while
    the reference is at rest and the joint hardly moves: if it grew during a motion, the joint would
    overshoot, and friction would hold it there.

    Lists are in the order of the wire. Joints without a reference get no torque.

    Attributes:
        kp: Stiffness [N·m/rad].
        kd: Damping [N·m·s/rad].
        ki: Integral gain [N·m/(rad·s)].
        position: Measured angles [rad].
        velocity: Filtered velocities [rad/s].
        torque: Torques sent last [N·m].
        stamp: When the last set was complete [s].
        sets: Number of complete sets so far.
        let_go: Fingers that were missing when it removed all references; ``None``: it has not.
    """

    def __init__(
        self,
        scale: JointScale,
        *,
        kp: float,
        kd: float,
        max_torque: float,
        smoothing: float,
        ki: float = 0.0,
        most_integral: float = 0.0,
        period: float = 0.0,
    ) -> None:
        self.scale = scale
        self.kp = kp
        self.kd = kd
        self.ki = ki
        self.position = [math.nan] * JOINTS
        self.velocity = [0.0] * JOINTS
        self.torque = [0.0] * JOINTS
        self.stamp = -math.inf
        self.sets = 0
        self._smoothing = smoothing
        # Nine tenths of the period, so that a set that is only a little early keeps its time stamp.
        self._least = 0.9 * period
        # The frames of a set arrive together: half a period without a frame separates two sets.
        self._pause = 0.5 * period if period else math.inf
        self._heard = -math.inf
        self._parted = False
        self.let_go: list[int] | None = None
        self._partial = 0
        self._stamps = [-math.inf] * FINGERS
        self._most_integral = most_integral
        self._integral = [0.0] * JOINTS
        self._period = 0.0
        self._most = [min(pwm / scale.pwm_per_torque, max_torque) for pwm in LIMITS_PWM]
        self._limit = list(self._most)
        self._reference: list[float | None] = [None] * JOINTS
        self._rate = [0.0] * JOINTS
        self._fresh: dict[int, tuple[float, ...]] = {}

    def refer(self, joint: int, angle: float | None, rate: float = 0.0) -> None:
        """Set the reference of a joint [rad] and its velocity [rad/s]; ``None``: no torque."""
        self._reference[joint] = angle
        self._rate[joint] = rate

    def limit(self, joint: int, torque: float) -> None:
        """Limit a joint's torque [N·m], within the hand's own limit."""
        self._limit[joint] = min(abs(torque), self._most[joint])

    def limp(self) -> None:
        """Remove the references of all joints, so that they get no torque."""
        self._reference = [None] * JOINTS
        self._integral = [0.0] * JOINTS

    def receive(self, finger: int, counts: Sequence[int], stamp: float) -> list[list[int]] | None:
        """Receive the counts of one finger's four joints, with their time of arrival [s].

        Returns the counts of all torques if the set is complete. While a finger is missing, they
        are all 0: the hand would keep its last torques, wherever these move it.
        """
        pause, self._heard = stamp - self._heard > self._pause, stamp
        self._stamps[finger] = stamp
        if pause and self._fresh and not self._parted:
            # After a lost frame, this set and all later ones would begin in the middle of another.
            self._fresh.clear()
        if not self._fresh:
            self._parted = pause
        self._fresh[finger] = tuple(self.scale.to_rad(count) for count in counts)
        # All four, so that all torques follow from positions of the same time.
        if len(self._fresh) < FINGERS:
            self._partial += 1
            # Repeated while the finger is missing, since a frame may get lost.
            return None if self._partial % _PARTIAL or not self.sets else self._none()
        self._partial = 0
        measured = [angle for f in range(FINGERS) for angle in self._fresh[f]]
        self._fresh.clear()
        self._measure(measured, stamp)
        return self._torques()

    def missing(self, since: float) -> list[int]:
        """Return the fingers that have sent no frame after a time [s], if others have."""
        silent = [finger for finger, stamp in enumerate(self._stamps) if stamp <= since]
        return silent if len(silent) < FINGERS else []

    def _none(self) -> list[list[int]]:
        """Return no torque for any joint."""
        self.torque = [0.0] * JOINTS
        # Without references, too: until the finger is back, joints may sink or be pushed.
        self.limp()
        self.let_go = self.missing(self.stamp)
        return [[0] * PER_FINGER] * FINGERS

    def _measure(self, measured: list[float], stamp: float) -> None:
        dt = stamp - self.stamp
        if dt < self._least:
            # The hand does not send faster, so these frames were delayed in this computer.
            dt = self._least
        self._period = dt if 0.0 < dt < _GAP else 0.0
        if self._period and self.sets:
            # Weighted by the elapsed time, since sets arrive unevenly and some are lost.
            share = dt / (dt + self._smoothing)
            for i, angle in enumerate(measured):
                rate = (angle - self.position[i]) / dt
                self.velocity[i] += share * (rate - self.velocity[i])
        elif dt > 0.0:
            self.velocity = [0.0] * JOINTS
        self.position = measured
        self.stamp = stamp
        self.sets += 1

    def _torques(self) -> list[list[int]]:
        counts: list[int] = []
        for i, reference in enumerate(self._reference):
            torque = 0.0
            if reference is not None:
                error = reference - self.position[i]
                rate, velocity = self._rate[i], self.velocity[i]
                if abs(rate) < _AT_REST and abs(velocity) < _STILL and abs(error) > _CLOSE:
                    bound = self._most_integral
                    grown = self._integral[i] + self.ki * error * self._period
                    self._integral[i] = min(max(grown, -bound), bound)
                torque = self.kp * error + self.kd * (rate - velocity)
                torque += self._integral[i]
                # Limited at the end, since the limit applies to the sum of all terms.
                torque = min(max(torque, -self._limit[i]), self._limit[i])
            self.torque[i] = torque
            # Rounded towards zero, so as not to exceed the limit.
            counts.append(int(torque * self.scale.pwm_per_torque))
        return [counts[f * PER_FINGER : (f + 1) * PER_FINGER] for f in range(FINGERS)]
