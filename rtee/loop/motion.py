"""One actuator's motion in steps of one period, inside limits that can always be kept.

A velocity here is the change of position during a period, divided by the period, and an
acceleration the change of that velocity, divided by the period: what a device observes that
receives one position per period.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rtee.errors import ConfigError
from rtee.types import ActuatorSpec


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Limits of all actuators of a hand, in its order.

    Attributes:
        lower: Lower position limits [rad | m].
        upper: Upper position limits [rad | m].
        velocity: Velocity limits [rad/s | m/s].
        acceleration: Acceleration limits [rad/s² | m/s²].
        jerk: Jerk limits [rad/s³ | m/s³].
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    jerk: tuple[float, ...]

    @classmethod
    def of(cls, actuators: Sequence[ActuatorSpec]) -> MotionLimits:
        """Return the limits of some actuators.

        Raises:
            ConfigError: if a velocity, acceleration or jerk limit is not a positive number, or the
                position limits are reversed.
        """
        for actuator in actuators:
            for limit in ("velocity", "acceleration", "jerk"):
                value = getattr(actuator, limit)
                if not (math.isfinite(value) and value > 0):
                    raise ConfigError(
                        f"the actuator '{actuator.name}' has the {limit} limit {value:g};"
                        f" a positive number is needed (limits: in hand.yaml)"
                    )
            if not actuator.lower <= actuator.upper:
                raise ConfigError(
                    f"the actuator '{actuator.name}' has the limits {actuator.lower:g} to"
                    f" {actuator.upper:g}; the lower one must come first"
                )
        return cls(
            tuple(a.lower for a in actuators),
            tuple(a.upper for a in actuators),
            tuple(a.velocity for a in actuators),
            tuple(a.acceleration for a in actuators),
            tuple(a.jerk for a in actuators),
        )

    def clamp(self, index: int, position: float) -> float:
        """Return a position of one actuator clamped into its limits."""
        return min(max(position, self.lower[index]), self.upper[index])


def stopping_velocity(distance: float, acceleration: float, dt: float) -> float:
    """Return the largest velocity from which an actuator can still stop within a distance.

    Moving at m·a·dt and slowing down by a·dt every period takes (k + 1)·m − k·(k + 1)/2 times
    a·dt², k = ⌊m⌋: the arithmetic series, solved for m.

    Args:
        distance: Distance to the point that must not be passed, 0 or more [rad | m].
        acceleration: Largest deceleration [rad/s² | m/s²].
        dt: Period [s].
    """
    if distance <= 0.0:
        return 0.0
    step = acceleration * dt
    units = distance / (step * dt)
    # Actuators without position limits have an infinite distance.
    if math.isinf(units):
        return math.inf
    k = math.floor((math.sqrt(1.0 + 8.0 * units) - 1.0) / 2.0)
    return (units / (k + 1) + k / 2.0) * step


def approach(position: float, target: float, acceleration: float, dt: float) -> float:
    """Return the largest velocity towards a target that still allows stopping there."""
    distance = target - position
    velocity = stopping_velocity(abs(distance), acceleration, dt)
    return velocity if distance >= 0.0 else -velocity


def bounded(
    position: float,
    velocity: float,
    wanted: float,
    dt: float,
    limit: float,
    acceleration: float,
    lower: float,
    upper: float,
) -> float:
    """Return the velocity nearest to the wanted one that keeps all limits, now and later.

    If the state came from this function (or is at rest), then slowing down by ``acceleration`` is
    always enough to stop before a position limit. Outside of the position limits an actuator may
    stay or come back, but not go further out. Where limits contradict each other, position takes
    precedence over acceleration, and acceleration over velocity.

    Args:
        position: Present position [rad | m].
        velocity: Velocity of the last period [rad/s | m/s].
        wanted: Wanted velocity of the next period [rad/s | m/s].
        dt: Period [s].
        limit: Velocity limit [rad/s | m/s].
        acceleration: Acceleration limit [rad/s² | m/s²].
        lower: Lower position limit [rad | m].
        upper: Upper position limit [rad | m].
    """
    # In rising priority, so that the last limit prevails: velocity, acceleration, position.
    result = min(max(wanted, -limit), limit)
    change = acceleration * dt
    result = min(max(result, velocity - change), velocity + change)
    if result > 0.0:
        return min(result, stopping_velocity(upper - position, acceleration, dt))
    if result < 0.0:
        return max(result, -stopping_velocity(position - lower, acceleration, dt))
    return result


_SLACK = 1e-6  # excess that counts as rounding: share of a limit, and [rad | m]


class Limiter:
    """Bounds position, step, velocity and acceleration of the set-points; never emits ``NaN``.

    The profiles keep the same limits; the limiter does not rely on them. A set-point that cannot be
    reached within a period is approached as fast as the limits allow.

    Args:
        limits: Limits of the actuators.
        period: Time between ticks [s].
        max_step: Largest change per tick [rad | m]; ``None``: one period at the velocity limit.

    Attributes:
        position: Positions sent last [rad | m].
        velocity: Their velocities [rad/s | m/s].
        limited: Whether the last `apply` limited each actuator.
    """

    def __init__(self, limits: MotionLimits, period: float, max_step: float | None = None) -> None:
        self._limits = limits
        self._period = period
        step = float("inf") if max_step is None else max_step / period
        self._velocity = tuple(min(velocity, step) for velocity in limits.velocity)
        # Rounding must not make a set-point at the limit count as beyond it.
        change = tuple(a * period * (1 + _SLACK) for a in limits.acceleration)
        columns = (limits.lower, limits.upper, self._velocity, limits.acceleration, change)
        self._bounds = tuple(zip(*columns, strict=True))
        self.position = [0.0] * len(limits.lower)
        self.velocity = [0.0] * len(limits.lower)
        self.limited = [False] * len(limits.lower)

    def seed(self, index: int, position: float) -> None:
        """Set one actuator to its measured position, at rest.

        Raises:
            ValueError: if the position is not finite.
        """
        # True for NaN and for both infinities, in one comparison.
        if position - position != 0.0:
            raise ValueError("a reference must start at a finite position")
        self.position[index] = position
        self.velocity[index] = 0.0
        self.limited[index] = False

    def apply(self, wanted: Sequence[float]) -> bool:
        """Move `position` and `velocity` to the next set-points, as far as the limits allow.

        Returns whether any actuator was limited.

        Args:
            wanted: Wanted positions [rad | m]; one that is not finite counts as "stop".
        """
        dt, any_limited = self._period, False
        position, velocity, limited = self.position, self.velocity, self.limited
        for i, target in enumerate(wanted):
            here, speed = position[i], velocity[i]
            # Most actuators are at rest most of the time.
            if target == here and speed == 0.0:
                limited[i] = False
                continue
            lower, upper, top, acceleration, change = self._bounds[i]
            # The fast path: nearly always, a set-point is far from all limits.
            if lower <= target <= upper and not limited[i]:
                step = (target - here) / dt
                size, room = (step, upper - target) if step > 0.0 else (-step, target - lower)
                if (
                    size <= top
                    and -change <= step - speed <= change
                    and room > size * size / acceleration + size * dt
                ):
                    position[i], velocity[i] = target, step
                    continue
            if self._limit(i, target):
                any_limited = True
        return any_limited

    def _limit(self, i: int, target: float) -> bool:
        """Apply a set-point that may be beyond a limit; return whether it was."""
        here, dt, acceleration = self.position[i], self._period, self._limits.acceleration[i]
        if target - target != 0.0:  # NaN or infinite
            # Staying here means to stop within the acceleration limit, as for any set-point.
            target = here
        # An actuator outside of the limits (it was pushed) may come back, but not go further.
        target, beyond = self._inside(i, here, target)
        step = (target - here) / dt
        # An actuator that lagged behind must reach its target slowly enough to stop there.
        follows = not self.limited[i] or abs(step) <= acceleration * dt
        if follows and self._close(i, step):
            self._take(i, target, step, limited=beyond)
            return beyond
        # The set-point cannot be reached within this period: approach without passing it later.
        allowed = self._allowed(i, approach(here, target, acceleration, dt))
        self._take(i, here + allowed * dt, allowed, limited=True)
        return True

    def _inside(self, i: int, here: float, target: float) -> tuple[float, bool]:
        """Return a set-point inside the position limits, and whether it was well beyond them."""
        inside = min(
            max(target, min(self._limits.lower[i], here)), max(self._limits.upper[i], here)
        )
        return inside, abs(inside - target) > _SLACK

    def _close(self, i: int, step: float) -> bool:
        """Return whether a set-point is within what the limits allow."""
        slack = _SLACK * self._limits.acceleration[i] * self._period
        return abs(self._allowed(i, step) - step) <= slack

    def _allowed(self, i: int, wanted: float) -> float:
        limits = self._limits
        return bounded(
            self.position[i],
            self.velocity[i],
            wanted,
            self._period,
            self._velocity[i],
            limits.acceleration[i],
            limits.lower[i],
            limits.upper[i],
        )

    def _take(self, i: int, position: float, velocity: float, *, limited: bool) -> None:
        # Clamped again after all arithmetic, since rounding must not end up outside.
        self.position[i] = self._inside(i, self.position[i], position)[0]
        self.velocity[i] = velocity
        self.limited[i] = limited
