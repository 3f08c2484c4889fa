"""The last thing between set-points and the bus: what leaves it is safe and is what is logged."""

from __future__ import annotations

from collections.abc import Sequence

from rtee.loop.motion import Limits, approach, bounded

_SLACK = 1e-6


class Limiter:
    """Bounds position, step, velocity and acceleration of what is sent; holds no ``NaN``, ever.

    The profiles keep the same limits by themselves; this one trusts nobody. A set-point that
    cannot be reached within a period is approached as fast as the limits allow.

    Args:
        limits: Limits of the actuators.
        period: Time between ticks [s].
        max_step: Largest change per tick [rad | m]; ``None``: one period at the velocity limit.

    Attributes:
        position: What was sent last [rad | m].
        velocity: Its velocity [rad/s | m/s].
        limited: Whether the last `apply` changed anything, per actuator.
    """

    def __init__(self, limits: Limits, period: float, max_step: float | None = None) -> None:
        self._limits = limits
        self._period = period
        step = float("inf") if max_step is None else max_step / period
        self._velocity = tuple(min(velocity, step) for velocity in limits.velocity)
        self.position = [0.0] * len(limits.lower)
        self.velocity = [0.0] * len(limits.lower)
        self.limited = [False] * len(limits.lower)

    def seed(self, index: int, position: float) -> None:
        """Start one actuator anew, standing at its measured position.

        Raises:
            ValueError: if the position is not finite.
        """
        if position - position != 0.0:
            raise ValueError("a reference starts at a finite position")
        self.position[index] = position
        self.velocity[index] = 0.0
        self.limited[index] = False

    def apply(self, wanted: Sequence[float]) -> bool:
        """Take the next set-points; `position` and `velocity` are what may be sent.

        Args:
            wanted: Wanted positions [rad | m]; one that is not finite counts as "stop".

        Returns:
            Whether anything was limited.
        """
        dt = self._period
        any_limited = False
        for i, target in enumerate(wanted):
            here = self.position[i]
            speed = self.velocity[i]
            if target == here and speed == 0.0:
                self.limited[i] = False
                continue
            if target - target != 0.0:  # NaN or infinite
                target = here
            step = (target - here) / dt
            acceleration = self._limits.acceleration[i]
            change = step - speed
            top = self._velocity[i]
            # Rounding must not make a set-point at the limit count as beyond it.
            if abs(step) <= top * (1 + _SLACK) and abs(change) <= acceleration * dt * (1 + _SLACK):
                room = (
                    (self._limits.upper[i] - target) if step > 0 else target - self._limits.lower[i]
                )
                if room >= 0.0 and room > step * step / acceleration + abs(step) * dt:
                    self._take(i, target, step, limited=False)
                    continue
            allowed = self._allowed(i, step)
            if abs(allowed - step) <= _SLACK * (acceleration * dt):
                self._take(i, target, step, limited=False)
                continue
            allowed = self._allowed(i, approach(here, target, acceleration, dt))
            self._take(i, here + allowed * dt, allowed, limited=True)
            any_limited = True
        return any_limited

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
        limits = self._limits
        here = self.position[i]
        # Rounding may leave the last digit beyond a position limit that `here` was inside of.
        if position > limits.upper[i]:
            position = max(limits.upper[i], min(here, position))
        elif position < limits.lower[i]:
            position = min(limits.lower[i], max(here, position))
        self.position[i] = position
        self.velocity[i] = velocity
        self.limited[i] = limited
