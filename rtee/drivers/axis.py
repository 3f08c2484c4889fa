"""One motor axis of the emulators: first-order motion, contact, heat. No I/O, no clock."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from rtee.buses.wear import Wear, WornSensor

_STEP = 0.001
"""Longest integration step [s], short compared with the time constants of motors."""
_MOST_STEPS = 400
"""Largest number of steps in one call: a longer time is integrated in longer steps."""


_ENDLESS = 1e6
"""An axis with at least this distance between its stops counts as continuous [axis units]."""


@dataclass(slots=True)
class VirtualObject:
    """An object between the fingers, met when an axis closes.

    Attributes:
        contact: Position of the axis at which it touches [axis units].
        stiffness: Effort per displacement past the contact [effort per axis unit].
        closing: Direction in which the axis closes, +1 or -1.
    """

    contact: float
    stiffness: float = 1e3
    closing: float = 1.0


class Axis:
    """A position-controlled axis: speed limit, first-order approach, force limit, hard stops, heat.

    Positions and efforts are in any units, such as the counts of a device; time is in seconds. At
    rest against an object, the efforts of servo and object are equal, limited by ``max_effort``.

    Attributes:
        position: Present position.
        target: Commanded position.
        velocity: Present velocity.
        effort: Signed effort, positive towards greater positions.
        enabled: Whether the motor is powered; an unpowered one stays where it is (friction).
        max_velocity: Speed limit.
        max_effort: Effort limit.
        time_constant: Time constant of the approach [s].
        gain: Effort per position error at standstill.
        friction: Effort of free motion; with a smaller ``max_effort`` the axis stands still.
        resolution: Position error below which the target counts as reached.
        lower: Lower hard stop.
        upper: Upper hard stop.
        obstacle: The object between the fingers, if there is one.
        self_locking: Whether the gear is self-locking: an object does not push the axis back when
            the effort is reduced.
        stuck: Whether the axis is jammed and does not follow its target.
        temperature: Motor temperature [°C].
        ambient: Ambient temperature [°C].
        heating: Heating rate at the effort `rating` [K/s].
        cooling: Share of the difference to `ambient` lost per second [1/s].
        rating: Effort at which `heating` applies.
        travel: Full travel, of which wear is a fraction; by default the distance between the stops.
        lag: Delay before the axis follows a new `target` [s]; a stop, which sets the target to the
            present position, takes effect at once.
        pace: Fraction of `max_velocity` that the axis reaches.
        sensor: Its encoder.
    """

    def __init__(
        self,
        position: float = 0.0,
        *,
        lower: float = -math.inf,
        upper: float = math.inf,
        max_velocity: float = math.inf,
        max_effort: float = 1.0,
        time_constant: float = 0.02,
        gain: float = math.inf,
        friction: float = 0.0,
        resolution: float = 1e-9,
        enabled: bool = False,
        self_locking: bool = False,
        rating: float | None = None,
    ) -> None:
        self.position = position
        self.target = position
        self.velocity = 0.0
        self.effort = 0.0
        self.enabled = enabled
        self.max_velocity = max_velocity
        self.max_effort = max_effort
        self.time_constant = time_constant
        self.gain = gain
        self.friction = friction
        self.resolution = resolution
        self.lower = lower
        self.upper = upper
        self.obstacle: VirtualObject | None = None
        self.self_locking = self_locking
        self.stuck = False
        # A small motor: at the rating it would settle 50 K above the ambient temperature.
        self.ambient = 25.0
        self.temperature = self.ambient
        self.heating = 0.5
        self.cooling = 0.01
        self.rating = max_effort if rating is None else rating
        self.travel = upper - lower if upper - lower < _ENDLESS else 0.0
        self.lag = 0.0
        self.pace = 1.0
        self.sensor = WornSensor()
        self._followed = position
        self._asked = position
        self._due: deque[tuple[float, float]] = deque()
        self._age = 0.0
        self._now: float | None = None

    def wear_down(self, wear: Wear) -> None:
        """Apply wear: lag, lower speed, encoder errors and a higher ambient temperature."""
        self.lag, self.pace = wear.lag, wear.pace
        self.sensor = WornSensor.of(wear, self.travel)
        self.ambient += wear.warmth

    @property
    def measured(self) -> float:
        """The position that its encoder reports."""
        return self.sensor.read(self.position)

    @property
    def moving(self) -> bool:
        """Whether the axis moves, or is about to."""
        return self.velocity != 0.0 or bool(self._due)

    @property
    def blocked(self) -> bool:
        """Whether the axis is blocked at rest short of its target, exerting effort."""
        return self.enabled and not self.moving and self.position != self.target

    def _bounds(self) -> tuple[float, float]:
        """Return the reachable range, limited by the stops and by the squeezed object."""
        lower, upper = self.lower, self.upper
        obstacle = self.obstacle
        if obstacle is not None:
            deepest = obstacle.contact + obstacle.closing * self.max_effort / obstacle.stiffness
            if obstacle.closing > 0:
                upper = max(min(upper, deepest), lower)
            else:
                lower = min(max(lower, deepest), upper)
        if self.self_locking:
            # The object cannot push the axis back, so the present position stays reachable.
            if self.target >= self.position:
                upper = max(upper, self.position)
            else:
                lower = min(lower, self.position)
        return lower, upper

    def _contact(self) -> float:
        """Return the effort with which the object resists, at least 0."""
        obstacle = self.obstacle
        if obstacle is None:
            return 0.0
        return max(0.0, (self.position - obstacle.contact) * obstacle.closing * obstacle.stiffness)

    def step(self, now: float) -> None:
        """Let time pass up to ``now`` [s]; the first call only sets the clock."""
        if self._now is not None:
            self.advance(now - self._now)
        # If the clock went back, the same time must not be simulated twice.
        self._now = now if self._now is None else max(now, self._now)

    def advance(self, dt: float) -> None:
        """Let ``dt`` seconds pass."""
        if dt <= 0.0:
            return
        steps = min(max(1, math.ceil(dt / _STEP)), _MOST_STEPS)
        dt /= steps
        # The exact solution over a step, which is stable for steps of any length.
        share, limit = -math.expm1(-dt / self.time_constant), self.max_velocity * self.pace * dt
        # Several steps, since contact force and heat are recomputed after each.
        for step in range(1, steps + 1):
            self._advance(dt, share, limit)
            if self.velocity == 0.0 and not self._due:  # from here on only the heat changes
                self._age += dt * (steps - step)
                self._warm(dt, steps - step + 1)
                return
            self._warm(dt, 1)

    def _follow(self, dt: float) -> None:
        """Update the target that the axis follows, delayed by its lag."""
        self._age += dt
        if self.lag <= 0.0 or self.target == self.position:
            if self._due:
                self._due.clear()
            self._followed = self._asked = self.target
            return
        if self.target != self._asked:
            self._asked = self.target
            self._due.append((self._age + self.lag, self.target))
        while self._due and self._due[0][0] <= self._age:
            self._followed = self._due.popleft()[1]

    def _advance(self, dt: float, share: float, limit: float) -> None:
        """Move by one step: by a fraction of the error, at most by a limit."""
        self._follow(dt)
        # A motor that is too weak for its friction stands still, and pushes all the same.
        if self.enabled and not self.stuck and self.max_effort >= self.friction:
            free = self.obstacle is None and not self.self_locking
            lower, upper = (self.lower, self.upper) if free else self._bounds()
            # Compared instead of `min` and `max`: emulated hands take most of their time here.
            goal = self._followed
            if goal < lower:
                goal = lower
            if goal > upper:
                goal = upper
            change = goal - self.position
            # An exponential never arrives, so the last bit is covered at once.
            if not abs(change) <= self.resolution:
                change *= share
                if change < -limit:
                    change = -limit
                if change > limit:
                    change = limit
            self.position += change
            self.velocity = change / dt
        else:
            self.velocity = 0.0
        self._exert()

    def _warm(self, dt: float, steps: int) -> None:
        # Heating grows with the square of the effort, as losses do with the current.
        rated = self.rating if self.rating > 0.0 else 1.0
        warming = self.heating * (self.effort / rated) ** 2
        cooling, ambient, temperature = self.cooling, self.ambient, self.temperature
        for _ in range(steps):
            temperature += dt * (warming - cooling * (temperature - ambient))
        self.temperature = temperature

    def _exert(self) -> None:
        if not self.enabled:
            self.effort = 0.0
            return
        error = self._followed - self.position
        if error == 0.0 and self.velocity == 0.0 and self.obstacle is None:
            self.effort = 0.0
            return
        contact = self._contact()
        if error != 0.0:
            direction = math.copysign(1.0, error)
        elif contact == 0.0 and self.velocity != 0.0:  # it has arrived in this step
            direction = math.copysign(1.0, self.velocity)
        else:
            direction = 1.0 if self.obstacle is None else self.obstacle.closing
        if self.velocity != 0.0:
            # In motion, the motor only overcomes friction and the object.
            pull = max(self.friction, contact)
        elif error == 0.0:
            pull = contact
        else:
            # An infinitely stiff servo that is blocked exerts its effort limit.
            pull = self.max_effort if math.isinf(self.gain) else self.gain * abs(error)
        self.effort = direction * min(pull, self.max_effort)
