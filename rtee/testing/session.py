"""An emulated device, its driver and its wire, for the duration of a test."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Sequence
from typing import Any, Self

from rtee import monotonic
from rtee.buses.emulator import Emulator
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.buses.simulated import Simulation
from rtee.buses.simulated_time import SimulatedTimeLoop
from rtee.drivers.base import Driver
from rtee.drivers.connection import owner_of
from rtee.drivers.registry import find_driver
from rtee.errors import BusTimeout, FrameError
from rtee.sample import ActuatorState
from rtee.testing.case import DeviceCase
from rtee.types import Reference

SIMULATED_TIME: tuple[str, dict[str, Any]] = ("asyncio", {"loop_factory": SimulatedTimeLoop})
"""What a fixture ``anyio_backend`` returns to have its tests run on simulated time."""


def open_files() -> int:
    """Return how many file descriptors this process has open."""
    return len(os.listdir("/proc/self/fd"))


class Session:
    """A driver with its own pool of buses; an asynchronous context manager that closes both."""

    def __init__(
        self, case: DeviceCase, *, pool: BusPool | None = None, name: str = "device"
    ) -> None:
        self.case = case
        self.spec = case.spec(name)
        self._own = pool is None
        # Without wire time, since the suite tests behaviour in tens of thousands of cycles.
        self.pool = pool or BusPool(wire_time=False)
        self.driver: Driver = find_driver(case.driver)(self.spec, self.pool)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.driver.close()
        if self._own:
            await self.pool.aclose()

    @property
    def emulator(self) -> Any:
        """The emulator of the device."""
        return self.pool.played(owner_of(self.spec))

    @property
    def wire(self) -> Simulation:
        """The simulated wire."""
        return self.pool.simulation(owner_of(self.spec))

    async def before(self, prepare: Callable[[Emulator], None]) -> None:
        """Change the emulated device before the driver under test connects to it."""
        # The emulator is made when a driver connects for the first time.
        await self.connect()
        await self.driver.close()
        self.wire.call(lambda: prepare(self.emulator))

    async def connect(self) -> None:
        """Connect and repeat after a timeout, starting over each time as a supervisor does."""

        async def once() -> None:
            try:
                await self.driver.configure()
            except (BusTimeout, FrameError):
                await self.driver.close()
                raise

        await patiently(once)

    async def start(self) -> ActuatorState:
        """Connect and activate; return the first state."""
        await self.connect()
        await patiently(self.driver.activate)
        return await self.sense()

    async def sense(self) -> ActuatorState:
        """Sense, and repeat after a timeout."""
        return await patiently(self.driver.sense)

    async def cycle(self, reference: Reference) -> ActuatorState | None:
        """Sense and move as the loop does; return ``None`` if an exchange failed."""
        try:
            state = await self.driver.sense()
            await self.driver.move(reference)
        except (BusTimeout, FrameError):
            return None
        return state

    async def reach(self, goal: Sequence[float], **limits: Any) -> ActuatorState:
        """Move to a posture and return the state when it is reached, or when the time is up.

        Args:
            goal: The posture ``(n,)`` [rad | m].
            limits: Limits for `Reference.at`, such as ``max_effort``.
        """
        reference = Reference.at(list(goal), **limits)
        end = monotonic.now() + self.case.within
        while True:
            state = await self.cycle(reference)
            if state is not None and self.near(state, goal):
                return state
            if monotonic.now() > end:
                # None: the last exchange failed.
                return state or await self.sense()
            # Emulators in this process need the processor, too, even on a slow machine.
            await asyncio.sleep(0.002)

    def near(self, state: ActuatorState, goal: Sequence[float]) -> bool:
        """Return whether the positions of a state are those of a posture, within the tolerance."""
        pairs = zip(state.position, goal, strict=True)
        return all(abs(float(q) - g) <= self.case.tolerance for q, g in pairs)
