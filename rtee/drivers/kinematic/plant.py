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
        spec: Its limits.
        position: Where it is [rad | m].
        velocity: How fast it moves [rad/s | m/s].
        effort: What it exerts [N·m | N].
        temperature: Its temperature [°C].
        target: Where it is to go [rad | m].
        max_effort: Effort it may exert [N·m | N].
        max_velocity: Velocity it may reach [rad/s | m/s].
        obstacle: Position at which an object stops it [rad | m], if one does.
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
        """Effort limit of the actuator; 1 where the model gives none [N·m | N]."""
        return self.spec.effort if math.isfinite(self.spec.effort) else 1.0

    def at(self, fraction: float) -> float:
        """Return the position at a part of the way from rest to the farthest bound."""
        return from_rest(self.spec.rest, self.spec.farthest, fraction)

    def step(self, dt: float, follow: float, full_effort_at: float, *, powered: bool) -> None:
        """Move on.

        Args:
            dt: Time [s].
            follow: Part of the way to the target that is covered in this time.
            full_effort_at: Distance behind the target that gives full effort [rad | m].
            powered: Whether the motor is on; else it stays and exerts nothing.
        """
        before, target = self.position, self.target
        # Most actuators rest in most cycles, and at rest only an object takes effort.
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
        # Not by where the object is: one at the rest position says nothing about the direction.
        if self.spec.farthest >= self.spec.rest:
            # One that is beyond the object already, when that is placed, is not thrown back.
            return after if after <= at or before > at else at
        return after if after >= at or before < at else at

    def warm(self, dt: float, ambient: float, heating: float, time_constant: float) -> None:
        """Let its temperature follow its effort for a time [s]."""
        share = self.effort / self.rating
        # The loss in a winding goes with the square of the current.
        settled = ambient + heating * share * share
        self.temperature += (settled - self.temperature) * (1.0 - math.exp(-dt / time_constant))
