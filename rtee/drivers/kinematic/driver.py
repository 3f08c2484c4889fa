"""The kinematic driver (the paper's DummyHal): positions follow the reference with a short lag."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta, field

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.options import NotNegative
from rtee.errors import BusBroken, CommandRejected, ConfigError, NotConnected, suggestion
from rtee.hand.validation import Section
from rtee.sample import ActuatorState
from rtee.types import ActuatorSpec, DeviceSpec, Reference, from_rest

_NEAR = 1e-9
"""Distance at which the target counts as reached [rad | m]."""


@dataclass(slots=True)
class KinematicActuator:
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
        """Return the position at a fraction of the travel from rest to the farthest bound."""
        return from_rest(self.spec.rest, self.spec.farthest, fraction)

    def step(self, dt: float, follow: float, full_effort_at: float, *, powered: bool) -> None:
        """Simulate the motion for a time [s]; without power, the actuator rests without effort.

        It covers the fraction ``follow`` of the distance to its target. At an object, a target
        ``full_effort_at`` [rad | m] beyond it gives full effort.
        """
        before, target = self.position, self.target
        # Most actuators are at rest in most cycles, where only an object causes effort.
        if not powered or (target == before and self.obstacle is None):
            self.velocity = self.effort = 0.0
            return
        # Runs for each actuator at each tick of a motion, so min() and max() are written out.
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
            # An actuator that is already beyond a newly placed object does not jump back.
            return after if after <= at or before > at else at
        return after if after >= at or before < at else at

    def warm(self, dt: float, ambient: float, heating: float, time_constant: float) -> None:
        """Simulate the temperature, which depends on the effort, for a time [s]."""
        share = self.effort / self.rating
        # The loss in a winding is proportional to the square of the current.
        settled = ambient + heating * share * share
        self.temperature += (settled - self.temperature) * (1.0 - math.exp(-dt / time_constant))


_MEASURES = frozenset({"position", "velocity", "effort"})


class KinematicOptions(Section, frozen=True):
    """Motion of the simulated hand and objects in its way.

    Attributes:
        time_constant: Time constant with which it follows [s].
        start: Position at the beginning by actuator [rad | m]; otherwise the rest posture.
        objects: Objects in the way: finger or actuator to the part of the way from rest to the
            farthest bound (0 to 1) at which it is stopped.
        full_effort_at: Distance behind the reference that gives full effort [rad | m].
        temperatures: Whether it has temperatures, which effort raises.
        ambient: Temperature of the surroundings [°C].
        heating: Rise at full effort in the long run [K].
        thermal_time: Time constant of the temperature [s].
    """

    time_constant: Annotated[float, Meta(gt=0, le=10.0)] = 0.03
    start: Mapping[str, float] = field(default_factory=dict)
    objects: Mapping[str, float] = field(default_factory=dict)
    full_effort_at: Annotated[float, Meta(gt=0)] = 0.1
    temperatures: bool = False
    ambient: float = 25.0
    heating: NotNegative = 60.0
    thermal_time: Annotated[float, Meta(gt=0)] = 60.0


class KinematicDriver(Driver):
    """A hand that follows its reference, stops at objects and warms up with effort.

    Attributes:
        now: Clock of the motion [s]; replace it to simulate faster or slower than real time.
        plants: The simulated actuators, in the order of ``spec.actuators``.
    """

    Options = KinematicOptions
    options: KinematicOptions

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.now: Callable[[], float] = monotonic.asked
        self._check_names("start", self.options.start)
        self.plants = [
            KinematicActuator(
                actuator,
                position=self.options.start.get(actuator.name, actuator.rest),
                temperature=self.options.ambient,
            )
            for actuator in spec.actuators
        ]
        for name, fraction in self.options.objects.items():
            self.place_object(name, fraction)
        self._time_constant = self.options.time_constant
        self._last: float | None = None
        self._plugged = True
        self._closed = False
        self._fault = ""
        measures = _MEASURES | ({"temperature"} if self.options.temperatures else set())
        self.capabilities = Capabilities(
            measures=frozenset(measures),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            recoverable=True,
            gains=("time_constant",),
            identity={"model": "kinematic"},
        )

    def _check_names(self, option: str, names: Iterable[str]) -> None:
        known = {a.name for a in self.spec.actuators}
        if option == "objects":
            known.update(finger for a in self.spec.actuators for finger in a.fingers)
        for name in names:
            if name not in known:
                origin = self.spec.origin(option)
                where = f"{origin}: " if origin else ""
                raise ConfigError(
                    f"{where}device '{self.spec.name}': unknown name '{name}' in its option"
                    f" '{option}'; {suggestion(name, known)}"
                )

    # --- what happens to the simulated device ------------------------------------------------

    def place_object(self, name: str, fraction: float) -> None:
        """Put an object in the way of a finger or an actuator.

        Continuous joints of a finger get no object, since they have no farthest bound.

        Args:
            name: The finger or actuator.
            fraction: Fraction of the travel from rest to the farthest bound, 0 to 1.

        Raises:
            ConfigError: if there is no such finger or actuator, the actuator is continuous, or the
                fraction is out of range.
        """
        self._check_names("objects", (name,))
        if not 0.0 <= fraction <= 1.0:
            raise ConfigError(f"an object must be at 0 to 1 of the travel, not {fraction:g}")
        for plant in self.plants:
            endless = not math.isfinite(plant.spec.farthest)
            if name == plant.spec.name and endless:
                raise ConfigError(f"'{name}' turns endlessly, so no object can be placed there")
            if not endless and (name == plant.spec.name or name in plant.spec.fingers):
                plant.obstacle = plant.at(fraction)

    def remove_object(self, name: str | None = None) -> None:
        """Remove the object of a finger or an actuator; without a name, all objects."""
        for plant in self.plants:
            if name is None or name == plant.spec.name or name in plant.spec.fingers:
                plant.obstacle = None

    def unplug(self) -> None:
        """Break the link; every exchange fails until `plug`."""
        self._plugged = False
        self.active = False

    def plug(self) -> None:
        """Restore the link."""
        self._plugged = True

    def fail(self, name: str) -> None:
        """Make the device report a fault and lose its power until recovery."""
        # First, since the actuators have moved with power up to this moment.
        self._advance()
        self._fault = name
        self.active = False

    def _check(self) -> None:
        if not self._plugged:
            raise BusBroken("kinematic", "unplugged")
        if self._closed:
            raise NotConnected(self.spec.name, "is not connected")
        if self._fault:
            raise self.fault(1, self._fault, hint="`rtee recover` clears it")

    # --- the contract ------------------------------------------------------------------------

    async def configure(self) -> None:
        """See `Driver.configure`."""
        if not self._plugged:
            raise BusBroken("kinematic", "unplugged")
        self._closed = False
        self._last = self.now()

    async def activate(self) -> None:
        """See `Driver.activate`."""
        self._check()
        self._advance()
        for plant in self.plants:
            # Activating must not move anything, as the contract of drivers requires.
            plant.target = plant.position
        self.active = True

    async def sense(self) -> ActuatorState:
        """See `Driver.sense`."""
        self._check()
        stamp = self._advance()
        plants = self.plants
        warm = self.options.temperatures
        return ActuatorState.measured(
            [plant.position for plant in plants],
            stamp,
            velocity=[plant.velocity for plant in plants],
            effort=[plant.effort for plant in plants],
            temperature=[plant.temperature for plant in plants] if warm else None,
        )

    async def move(self, reference: Reference) -> None:
        """See `Driver.move`."""
        self._check()
        columns = zip(
            self.plants,
            reference.mask.tolist(),
            reference.position.tolist(),
            reference.max_effort.tolist(),
            reference.max_velocity.tolist(),
            strict=True,
        )
        for plant, commanded, position, effort, velocity in columns:
            if commanded:
                plant.target = position
                plant.max_effort = effort
                plant.max_velocity = velocity

    async def stop(self) -> None:
        """See `Driver.stop`."""
        if self._plugged:
            self._advance()
            for plant in self.plants:
                plant.target = plant.position

    async def disable(self) -> None:
        """See `Driver.disable`."""
        self.active = False

    async def recover(self) -> None:
        """See `Driver.recover`."""
        self._fault = ""
        self._check()

    def gains(self) -> Mapping[str, float]:
        """See `Driver.gains`."""
        return {"time_constant": self._time_constant}

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """See `Driver.set_gains`."""
        value = gains.get("time_constant", self._time_constant)
        if not value > 0.0:
            raise CommandRejected(self.spec.name, f"time_constant must be above 0 s, not {value:g}")
        self._time_constant = value

    async def close(self) -> None:
        """See `Driver.close`."""
        # A driver that was never connected may be closed and still be configured later.
        self._closed = self._last is not None
        self.active = False

    def _advance(self) -> float:
        now = self.now()
        # Before `configure`, no time passes.
        dt = now - (now if self._last is None else self._last)
        self._last = now
        if dt > 0.0:
            # The exact solution of the lag, so that the motion does not depend on the cycle time.
            follow = 1.0 - math.exp(-dt / self._time_constant)
            options = self.options
            for plant in self.plants:
                plant.step(dt, follow, options.full_effort_at, powered=self.active)
                if options.temperatures:
                    plant.warm(dt, options.ambient, options.heating, options.thermal_time)
        return now
