"""The motion of a simulated actuator: a lag with a velocity limit, stopped by objects."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rtee.types import ActuatorSpec, from_rest

_NEAR = 1e-9
"""Distance at which the target counts as reached [rad | m]."""


@dataclass(slots=True)
class Plant:
    """One simulated actuator.

    Attributes:
        spec: Name and limits of the actuator.
        position: Position [rad | m].
        velocity: Velocity [rad/s | m/s].
        effort: Effort [N·m | N].
        temperature: Temperature [°C].
        target: Target position [rad | m].
        max_effort: Effort limit of the reference [N·m | N].
        max_velocity: Velocity limit of the reference [rad/s | m/s].
        obstacle: Position at which an object stops it [rad | m]; ``None``: no object.
    """

    spec: ActuatorSpec
    position: float
    velocity: float = 0.0
    effort: float = 0.0
    temperature: float = 25.0
    target: float = 0.0
    max_effort: float = math.inf
    max_velocity: float = math.inf
    obstacle: float | None = None

    @property
    def rating(self) -> float:
        """Effort limit of the actuator [N·m | N]; 1 if the model gives none."""
        return self.spec.effort if math.isfinite(self.spec.effort) else 1.0

    def at(self, fraction: float) -> float:
        """Return the position at a fraction of the way from rest to the farthest bound."""
        return from_rest(self.spec.rest, self.spec.farthest, fraction)

    def step(self, dt: float, follow: float, full_effort_at: float, *, powered: bool) -> None:
        """Simulate the motion for a time [s]; without power it stays where it is, without effort.

        It covers the fraction ``follow`` of the way to its target; at an object, a target this far
        behind it [rad | m] gives full effort.
        """
        before, target = self.position, self.target
        # Most actuators rest in most cycles, and at rest only an object causes effort.
        if not powered or (target == before and self.obstacle is None):
            self.velocity = self.effort = 0.0
            return
        # Run for each actuator at each tick of a motion, so min() and max() are written out.
        spec, gap = self.spec, target - before
        most = dt * (self.max_velocity if self.max_velocity < spec.velocity else spec.velocity)
        moved = gap * follow
        if -_NEAR < gap < _NEAR:  # a lag approaches its target and never reaches it
            moved = gap
        elif moved > most:
            moved = most
        elif moved < -most:
            moved = -most
        after = before + moved
        if after < spec.lower:
            after = spec.lower
        if after > spec.upper:
            after = spec.upper
        self.effort = 0.0
        if self.obstacle is not None:
            after = self._stopped(before, after)
            push = target - after
            if after == self.obstacle and push:
                most_effort = min(self.rating, self.max_effort)
                effort = min(self.rating * abs(push) / full_effort_at, most_effort)
                self.effort = math.copysign(effort, push)
        self.position = after
        self.velocity = (after - before) / dt

    def _stopped(self, before: float, after: float) -> float:
        at = self.obstacle
        if at is None:
            return after
        # The sign of (obstacle - rest) would be 0, not a direction, for an object at rest.
        if self.spec.farthest >= self.spec.rest:
            # An actuator already beyond the object when that is placed does not jump back.
            return after if after <= at or before > at else at
        return after if after >= at or before < at else at

    def warm(self, dt: float, ambient: float, heating: float, time_constant: float) -> None:
        """Simulate the temperature for a time [s]; it depends on the effort."""
        share = self.effort / self.rating
        # The loss in a winding is proportional to the square of the current.
        settled = ambient + heating * share * share
        self.temperature += (settled - self.temperature) * (1.0 - math.exp(-dt / time_constant))
