"""One actuator's motion in steps of one period, inside limits that can always be kept.

A velocity here is the change of position during a period, divided by it, and an acceleration the
change of that velocity, divided by it: what a device that gets one position per period sees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rtee.errors import ConfigError
from rtee.types import ActuatorSpec


@dataclass(frozen=True, slots=True)
class Limits:
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
    def of(cls, actuators: Sequence[ActuatorSpec]) -> Limits:
        """Take the limits from the actuators.

        Raises:
            ConfigError: if a velocity, acceleration or jerk limit is not a positive number, or the
                position limits are the wrong way round.
        """
        for actuator in actuators:
            for what in ("velocity", "acceleration", "jerk"):
                value = getattr(actuator, what)
                if not (math.isfinite(value) and value > 0):
                    raise ConfigError(
                        f"the actuator '{actuator.name}' has the {what} limit {value:g};"
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
    """Return the largest velocity from which one can still stop within a distance.

    Moving at m·a·dt and slowing down by a·dt every period takes (k + 1)·m − k·(k + 1)/2 times
    a·dt², k = ⌊m⌋: the arithmetic series, solved for m.

    Args:
        distance: To the point not to be passed, 0 or more [rad | m].
        acceleration: Largest deceleration [rad/s² | m/s²].
        dt: Period [s].
    """
    if distance <= 0.0:
        return 0.0
    step = acceleration * dt
    # Without units, the way and the answer fit one formula for all actuators.
    units = distance / (step * dt)
    # Actuators without position limits have an infinite way.
    if math.isinf(units):
        return math.inf
    k = math.floor((math.sqrt(1.0 + 8.0 * units) - 1.0) / 2.0)
    return (units / (k + 1) + k / 2.0) * step


def approach(position: float, target: float, acceleration: float, dt: float) -> float:
    """Return the velocity with which to go to a target and stop there without passing it."""
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
    """Return the velocity nearest to the wanted one that keeps all limits, now and ever after.

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
    # In the order of priority, the last one wins: velocity, acceleration, position.
    result = min(max(wanted, -limit), limit)
    change = acceleration * dt
    result = min(max(result, velocity - change), velocity + change)
    if result > 0.0:
        return min(result, stopping_velocity(upper - position, acceleration, dt))
    if result < 0.0:
        return max(result, -stopping_velocity(position - lower, acceleration, dt))
    return result
