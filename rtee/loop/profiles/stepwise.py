"""Profiles that are computed period by period: the second-order filter and the plain step."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Collection, Mapping
from collections.abc import Set as AbstractSet

from rtee.loop.motion import MotionLimits, approach, bounded
from rtee.loop.profiles.base import Profile


class Stepwise(Profile):
    """A profile that chooses a velocity in each period, which the limits bound."""

    def _seeded(self, indices: Collection[int]) -> None:
        for index in indices:
            self._braking[index] = False

    def _start(
        self, going: AbstractSet[int], brake: Collection[int], changed: AbstractSet[int]
    ) -> None:
        for index in brake:
            self._braking[index] = True
        self.moving = True

    def advance(self) -> None:
        """See `Profile.advance`."""
        if not self.moving:
            return
        self.moving = False
        limits, dt = self.limits, self.period
        for i in range(self.size):
            here, speed = self.position[i], self.velocity[i]
            if self._braking[i]:
                wanted = 0.0
            elif here == self.target[i] and speed == 0.0:
                continue
            else:
                wanted = self._wanted(i)
            allowed = bounded(
                here,
                speed,
                wanted,
                dt,
                self._fastest(i),
                limits.acceleration[i],
                limits.lower[i],
                limits.upper[i],
            )
            self._move(i, wanted, allowed)
            if self._braking[i] and allowed == 0.0:
                self._braking[i] = False
                self.target[i] = self.position[i]
            if self.velocity[i] != 0.0 or self.position[i] != self.target[i]:
                self.moving = True

    def _fastest(self, i: int) -> float:
        """Return the velocity limit of the next period [rad/s | m/s]."""
        return self._top[i]

    @abstractmethod
    def _wanted(self, i: int) -> float:
        """Return the velocity wanted for the next period [rad/s | m/s]."""

    def _move(self, i: int, wanted: float, allowed: float) -> None:
        """Advance by one period at the allowed velocity."""
        position = self.position[i] + allowed * self.period
        # The last step must reach the target exactly, without an error of rounding.
        if not self._braking[i] and abs(position - self.target[i]) <= 1e-12:
            position = self.target[i]
        self.position[i] = position
        self.velocity[i] = allowed


class Step(Stepwise):
    """Goes to the target as fast as velocity and acceleration limits allow."""

    def _wanted(self, i: int) -> float:
        return approach(self.position[i], self.target[i], self.limits.acceleration[i], self.period)


_AHEAD = 5.0
"""How many times faster than the filter the target is smoothed: fast enough to go unnoticed, slow
enough to keep the acceleration continuous."""

_NEAR = 1e-6  # the filter snaps to a target this near [rad | m], or it would creep forever


class Filter(Stepwise):
    """A second-order low-pass with damping 1, as in ROS End-Effector, inside all limits.

    The response to an input s is that of x″ = ω²·(s − x) − 2·ω·x′, solved exactly for each period.
    The input is not the target itself, which would make the acceleration jump, but follows it by
    s′ = 5·ω·(target − s): position, velocity and acceleration are continuous whatever the targets.
    To brake, an actuator goes to the position where the filter comes to rest by itself, which
    avoids jumps as well.

    Args:
        limits: Limits of the actuators.
        period: Time between ticks [s].
        bandwidth: ω / 2π [Hz].
    """

    def __init__(self, limits: MotionLimits, period: float, bandwidth: float = 2.0) -> None:
        super().__init__(limits, period)
        self._omega = 2.0 * math.pi * bandwidth
        # The exact solution over a period: stable at any rate, unlike Euler's method.
        self._decay = math.exp(-self._omega * period)
        self._lag = math.exp(-_AHEAD * self._omega * period)
        self._input = [0.0] * self.size
        self._slope = [0.0] * self.size
        self._next = [0.0] * self.size
        self._change = [0.0] * self.size
        self._held = [False] * self.size

    def _seeded(self, indices: Collection[int]) -> None:
        super()._seeded(indices)
        for index in indices:
            self._input[index] = self.position[index]
            self._slope[index], self._change[index] = self.velocity[index], 0.0

    def go(
        self,
        targets: Mapping[int, float],
        *,
        brake: Collection[int] = (),
        velocity: Mapping[int, float] | None = None,
    ) -> None:
        """See `Profile.go`."""
        # With damping 1, this is where the filter comes to rest by itself.
        rest = {i: self.position[i] + self.velocity[i] / self._omega for i in brake}
        super().go({**targets, **rest}, velocity=velocity)
        for i in velocity or ():
            self._held[i] = True

    def _fastest(self, i: int) -> float:
        return self.limits.velocity[i] if self._held[i] else self._top[i]

    def _wanted(self, i: int) -> float:
        target, dt = self.target[i], self.period
        ahead = self._input[i] = target + (self._input[i] - target) * self._lag
        left = self.position[i] - target
        # A thousandth of what one period can change: the snap is then imperceptible.
        slow = abs(self.velocity[i]) < 1e-3 * self.limits.acceleration[i] * dt
        if slow and abs(left) < _NEAR and abs(ahead - target) < _NEAR:
            self._input[i], self._next[i] = target, 0.0
            return -left / dt
        error = self.position[i] - ahead
        impulse = self._slope[i] + self._omega * error
        after = (error + impulse * dt) * self._decay
        self._next[i] = (self._slope[i] - self._omega * impulse * dt) * self._decay
        wanted = (after - error) / dt
        eased = self._eased(i, wanted)
        if eased != wanted:
            self._next[i] = eased
        return eased

    def _eased(self, i: int, wanted: float) -> float:
        """Return a velocity that reaches its limit with zero acceleration.

        Bringing an acceleration a to zero with the jerk limit j changes the velocity by a² / 2j;
        the acceleration of the next period must leave room for it: a² / 2j + a·dt = room. A
        velocity above a limit that was lowered comes down in the same way. Where limits have taken
        over from the filter, the acceleration continues from its present value.
        """
        velocity, jerk, dt = self.velocity[i], self.limits.jerk[i], self.period
        if wanted * velocity <= 0.0:
            self._held[i] = False
            return wanted
        speed, change = abs(velocity), jerk * dt
        room = self._top[i] - speed
        most = math.copysign(math.sqrt(change * change + 2.0 * jerk * abs(room)) - change, room)
        if self._held[i]:
            present = math.copysign(self._change[i], self._change[i] * velocity) / dt
            most = max(min(most, present + change), present - change)
        top = speed + most * dt
        self._held[i] = abs(wanted) > top or room < -_NEAR * speed
        return wanted if abs(wanted) <= top else math.copysign(top, wanted)

    def _move(self, i: int, wanted: float, allowed: float) -> None:
        self._change[i] = allowed - self.velocity[i]
        self._held[i] = self._held[i] or allowed != wanted
        super()._move(i, wanted, allowed)
        # Where a limit took over, the filter continues from the actual velocity.
        self._slope[i] = self._next[i] if allowed == wanted and wanted != 0.0 else allowed
