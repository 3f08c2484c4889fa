"""The last stage between set-points and the bus: its output is safe to send, and is logged."""

from __future__ import annotations

from collections.abc import Sequence

from rtee.loop.motion import MotionLimits, approach, bounded

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
            raise ValueError("a reference starts at a finite position")
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
