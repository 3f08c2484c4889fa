"""An emulated device, its driver and its wire, for the duration of a test."""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import Callable, Sequence
from typing import Any, Final, Self

from rtee import monotonic
from rtee.buses.emulator import Emulator
from rtee.buses.pool import BusPool
from rtee.buses.retry import LATE, patiently
from rtee.buses.simulated import Simulation
from rtee.buses.simulated_time import SimulatedTimeLoop
from rtee.drivers.base import Driver
from rtee.drivers.registry import find_driver
from rtee.errors import (
    BusBroken,
    BusClosed,
    DeviceFault,
    HandshakeError,
    NotConnected,
    RteeError,
)
from rtee.sample import ActuatorState
from rtee.testing.case import DeviceCase
from rtee.types import Reference

_NOT_THERE: Final[tuple[type[RteeError], ...]] = (*LATE, NotConnected, HandshakeError)
"""Errors of connecting on a busy computer: a device that does not answer in time counts as
missing."""

_RESTS = 0.1
"""Time between two states by which motion is detected [s]: longer than the slowest device takes for
a new one, 67 ms."""

_NOTICES = 30.0
"""Longest time in which a driver notices that it was unplugged [s]; on a busy computer, too."""


def simulated_time() -> tuple[str, dict[str, Any]]:
    """Return the value of a fixture ``anyio_backend`` whose tests run on simulated time."""
    return "asyncio", {"loop_factory": SimulatedTimeLoop}


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
        self.pool = pool or BusPool()
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
        return self.pool.played(self.spec.owner)

    @property
    def wire(self) -> Simulation:
        """The simulated wire."""
        return self.pool.simulation(self.spec.owner)

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
            except _NOT_THERE:
                await self.driver.close()
                raise

        await patiently(once, late=_NOT_THERE)

    async def start(self) -> ActuatorState:
        """Connect and activate; return the first state."""
        await self.connect()
        await patiently(self.driver.activate, late=_NOT_THERE)
        return await self.sense()

    async def sense(self) -> ActuatorState:
        """Sense, and repeat after a timeout."""
        return await patiently(self.driver.sense)

    async def cycle(self, reference: Reference) -> ActuatorState | None:
        """Sense and move as the loop does; return ``None`` if an exchange failed."""
        try:
            state = await self.driver.sense()
            await self.driver.move(reference)
        except LATE:
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
            # Emulators in this process also need the processor, even on a slow machine.
            await asyncio.sleep(0.002)

    async def leave(self, posture: Sequence[float], goal: Sequence[float]) -> None:
        """Cycle with a goal until the device is seen to have left a posture."""
        end = monotonic.now() + self.case.within
        while (state := await self.cycle(Reference.at(list(goal)))) is None or self.near(
            state, posture
        ):
            assert monotonic.now() < end, "it does not move"
            await asyncio.sleep(0.002)

    async def approach(self, goal: Sequence[float], share: float) -> list[float]:
        """Move part of the way to a posture as the loop does; return the last reference.

        Moves at a tenth of the velocity limits; the driver gets the measured and requested values.
        """
        standstill = self.driver.standstill
        here = list(map(float, (await self.sense()).position))
        travels = [share * (g - q) for g, q in zip(goal, here, strict=True)]
        pairs = zip(travels, self.case.actuators, strict=True)
        ticks = math.ceil(max(abs(w) / (0.1 * a.velocity) for w, a in pairs) * self.case.rate)
        wanted = here
        for tick in range(1, ticks + 1):
            wanted = [q + travel * tick / ticks for q, travel in zip(here, travels, strict=True)]
            reference = Reference.at(wanted)
            standstill.asked(reference)
            state = await self.cycle(reference)
            if state is not None:
                standstill.measured(state)
            await asyncio.sleep(1.0 / self.case.rate)
        return wanted

    async def at_rest(self) -> ActuatorState:
        """Return the state once the device rests: it may still move while it is being stopped."""
        end = monotonic.now() + self.case.within
        state = await self.sense()
        while True:
            await asyncio.sleep(_RESTS)
            before, state = state, await self.sense()
            if self.near(state, before.position.tolist()) or monotonic.now() > end:
                return state

    async def fault(self) -> DeviceFault:
        """Return the fault that the driver reports while it senses and moves."""
        for _ in range(50):
            try:
                state = await self.driver.sense()
                await self.driver.move(Reference.at(state.position))
            except DeviceFault as fault:
                return fault
            except LATE:
                pass
            await asyncio.sleep(0.01)
        raise AssertionError("the fault was never reported")

    async def lost(self) -> None:
        """Sense and move until the driver notices that it was unplugged."""
        end = monotonic.now() + _NOTICES
        while monotonic.now() < end:
            try:
                state = await self.driver.sense()
                await self.driver.move(Reference.at(state.position))
            except (BusBroken, BusClosed, NotConnected):
                return
            except LATE:
                continue
            await asyncio.sleep(0.001)
        raise AssertionError("the driver never noticed that it was unplugged")

    async def longest_exchange(self) -> float:
        """Return the longest time of twenty exchanges at the rate of the case [s]."""
        longest = 0.0
        for _ in range(20):
            begun = monotonic.now()
            await self.sense()
            longest = max(longest, monotonic.now() - begun)
            await asyncio.sleep(1.0 / self.case.rate)
        return longest

    def near(self, state: ActuatorState, goal: Sequence[float]) -> bool:
        """Return whether the positions of a state are those of a posture, within the tolerance."""
        pairs = zip(state.position, goal, strict=True)
        return all(abs(float(q) - g) <= self.case.tolerance for q, g in pairs)

    def check(self, state: ActuatorState, goal: Sequence[float], wrong: str) -> None:
        """Fail with the words ``wrong`` unless the positions of a state are those of a posture."""
        measured, wanted = ([round(float(q), 5) for q in each] for each in (state.position, goal))
        assert self.near(state, goal), f"{wrong}: {measured} is measured, not {wanted} [rad | m]"
