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
    """Return the largest velocity towards a target from which to stop there without passing it."""
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
