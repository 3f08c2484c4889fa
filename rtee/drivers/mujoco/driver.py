"""The `mujoco` driver: sense and move a simulated hand in lockstep with the loop."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import anyio
import anyio.to_thread

from rtee import monotonic
from rtee.actions.library import ActionLibrary
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.mujoco.options import SimOptions
from rtee.errors import (
    CommandRejected,
    DeviceFault,
    NotConnected,
    SimulationUnstable,
    needing_extra,
)
from rtee.hand.load import hand_folder, load_hand
from rtee.sample import ActuatorState, FloatArray
from rtee.touch import TouchReading
from rtee.types import DeviceSpec, Reference

if TYPE_CHECKING:
    from rtee.buses.pool import BusPool
    from rtee.drivers.mujoco.simulation import Simulation

log = logging.getLogger(__name__)

GAINS = ("kp", "ki", "kd")
"""The gains of every actuator that can be set while it runs; see `Simulation.set_gain`."""

_UNSTABLE = 1
"""Fault code of a simulation that became unstable, the only fault of this driver."""

_AFFORDABLE = 0.2
"""A step that takes less than this share of a period runs in the loop's own thread: handing it
to another one would cost more."""

_MOST_BEHIND = 3
"""Largest number of periods that a late exchange makes up for: after a freeze of the computer, the
hand must not jump."""

_ROUNDED = 1e-3
"""Share of a period by which rounding may shorten a whole period."""

_SPARE = 0.7
"""Missed periods are made up for only if a step takes less than this share of one: a simulation
that is too slow would only fall further behind."""


class MujocoDriver(Driver):
    """A hand with dynamics and contact, simulated.

    Every exchange advances the simulation by the time between exchanges, so that two runs of the
    same goals are equal if the loop keeps its rate. The next exchange makes up for missed ticks;
    otherwise simulated time would fall behind the references, which follow real time.
    """

    Options = SimOptions
    options: SimOptions

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self._simulation: Simulation | None = None
        # One thread at a time: MuJoCo's state must not be advanced twice at once.
        self._thread = anyio.CapacityLimiter(1)
        self._advancing = threading.Lock()
        self._affordable = _AFFORDABLE * (spec.every or 1) / spec.rate
        self._cost = 0.0
        self._period = period = (spec.every or 1) / spec.rate
        self._behind, self._before = 0.0, math.inf
        self._touch_every = max(1, round(1.0 / (self.options.touch_rate * period)))
        self._touch: TouchReading | None = None
        self._turn = 0
        names = [actuator.name for actuator in spec.actuators]
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "effort", "contact_force"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            best_rate=spec.rate,
            gains=tuple(f"{kind}.{name}" for name in names for kind in GAINS),
            identity={"model": "MuJoCo simulation"},
        )

    @property
    def simulation(self) -> Simulation:
        """The running simulation; raises `NotConnected` before `configure`."""
        if self._simulation is None:
            raise NotConnected(self.spec.name, "the simulation has not been started")
        return self._simulation

    async def configure(self) -> None:
        """Build the model in another thread than the loop's, since that takes a moment."""
        with needing_extra("the driver 'mujoco'", "sim"):
            self._simulation = await anyio.to_thread.run_sync(self._made)
        self.object_description = self._simulation.object_description
        self.capabilities = replace(self.capabilities, touch=self._simulation.taxels.sensors)
        for doubt in self._simulation.doubts:
            log.warning("%s: %s", self.spec.name, doubt)
        for note in self._simulation.notes:
            log.info("%s: %s", self.spec.name, note)

    def _made(self) -> Simulation:
        from rtee.drivers.mujoco.scene import TipsClosing, make_simulation

        folder, _ = hand_folder(self.spec.folder or self.spec.hand)
        hand = load_hand(folder)
        closing = TipsClosing.of(hand, ActionLibrary.load(hand, folder / "actions"))
        period = (self.spec.every or 1) / self.spec.rate
        names = [actuator.name for actuator in self.spec.actuators]
        return make_simulation(hand, self.options, names, period, closing=closing)

    async def activate(self) -> None:
        """Power the actuators at their present positions."""
        self.simulation.hold()
        self.simulation.power(True)
        self._behind, self._before = 0.0, math.inf

    async def sense(self) -> ActuatorState:
        """Advance by one exchange, then measure."""
        exchange = partial(self._exchange, self.simulation, self._due(monotonic.now()))
        try:
            if self._cost < self._affordable:
                return exchange()
            return await anyio.to_thread.run_sync(exchange, limiter=self._thread)
        except SimulationUnstable as error:
            raise DeviceFault(
                self.spec.name,
                _UNSTABLE,
                str(error),
                hint="`rtee recover` restarts it from its initial state",
            ) from error

    def _exchange(self, simulation: Simulation, count: int) -> ActuatorState:
        """Advance by ``count`` periods, then measure; in any thread."""
        # An abandoned exchange may still run in its thread, and measuring reads contacts that a
        # step replaces.
        with self._advancing:
            began = time.perf_counter()
            for _ in range(count):
                simulation.advance()
            # A slow average, so that one preempted step does not move the work to the thread.
            self._cost += 0.05 * ((time.perf_counter() - began) / count - self._cost)
            return self._measured(simulation)

    def _measured(self, simulation: Simulation) -> ActuatorState:
        now = monotonic.now()
        extras: dict[str, FloatArray] = simulation.scene_channels
        if not simulation.taxels.sensors:
            # A hand with touch sensors feels with them, as a real one does.
            extras = {"contact_force": simulation.contact_forces, **extras}
        elif self._turn % self._touch_every == 0:
            self._touch = TouchReading(simulation.taxels.read(simulation.data), now)
        self._turn += 1
        return ActuatorState.measured(
            simulation.position,
            now,
            velocity=simulation.velocity,
            effort=simulation.effort,
            extras=extras,
            touch=self._touch,
        )

    def _due(self, now: float) -> int:
        """Return the number of periods to advance by: one, plus those that were missed."""
        period = self._period
        late = max(now - self._before, 0.0) - period if self._before < math.inf else 0.0
        self._before = now
        # An early exchange makes up for a late one before it, and for nothing more.
        self._behind = min(max(self._behind + late, -period), _MOST_BEHIND * period)
        missed = 0
        if self._cost < _SPARE * period:
            missed = max(int(self._behind / period + _ROUNDED), 0)
        self._behind -= missed * period
        return 1 + missed

    async def move(self, reference: Reference) -> None:
        """Set references and effort limits."""
        self.simulation.command(
            reference.position, reference.max_effort, reference.mask, reference.max_velocity
        )

    async def recover(self) -> None:
        """Restart the simulation: the hand at rest, the object where it was placed."""
        with self._advancing:
            self.simulation.reset()

    async def stop(self) -> None:
        """Hold the present positions."""
        if self._simulation is not None:
            self._simulation.hold()

    async def disable(self) -> None:
        """Make the joints limp."""
        if self._simulation is not None:
            self._simulation.power(False)

    def gains(self) -> Mapping[str, float]:
        """See `Driver.gains`."""
        return {} if self._simulation is None else self._simulation.gains

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Set position (``kp.ACTUATOR``), integral (``ki.…``) and damping (``kd.…``) gains."""
        for name, value in gains.items():
            try:
                self.simulation.set_gain(name, value)
            except (KeyError, ValueError) as error:
                raise CommandRejected(
                    self.spec.name, f"cannot set gain '{name}' to {value:g}", hint=str(error)
                ) from error

    async def close(self) -> None:
        """Discard the simulation."""
        self._simulation = None
