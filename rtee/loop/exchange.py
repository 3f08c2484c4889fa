"""One device's long-lived task: exchange with it whenever the loop offers, do what is asked."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable

import anyio

from rtee.drivers.base import Driver
from rtee.errors import BusTimeout, NotConnected
from rtee.loop.connection import REQUEST_WITHIN, Connection
from rtee.loop.requests import Requests
from rtee.loop.settings import DeviceSettings
from rtee.types import Event, Lifecycle, Reference

FAULT_LOOK = 0.1
"""A device in fault is looked at this often [s]."""


class Exchange(Connection):
    """The task of one device; it alone calls the driver.

    The tick hands a reference over by `offer` and reads `state`; neither waits. While an exchange
    is under way, further offers are counted as overruns. All time comes from the offers.

    Args:
        settings: The device.
        driver: Its driver.
        indices: The hand's indices of its actuators.
        tell: Called with events.
        now: The clock [s].

    Attributes:
        muted: No references are sent, only its state is read.
    """

    def __init__(
        self,
        settings: DeviceSettings,
        driver: Driver,
        indices: tuple[int, ...],
        tell: Callable[[Event], None],
        *,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(settings, driver, indices, tell, now=now)
        self.muted = False
        self._requests = Requests()
        self._reference: Reference | None = None
        self._offered = False
        self._next_due = 0
        self._look_at = -math.inf
        self._doing = ""

    def due(self, tick: int) -> bool:
        """Return whether it is this device's turn; asked once per tick."""
        if tick < self._next_due:
            return False
        self._next_due = tick - tick % self.every + self.every
        return True

    def offer(self, reference: Reference | None) -> None:
        """Have one exchange done: read the state, then send the reference if there is one."""
        now = self._now()
        if self.driver.doing != self._doing:
            self._tell_doing()
        if self._busy:
            self._accounts.overruns += self._exchanging
            if now >= self._give_up_at:
                self._interrupt(0.0)
            return
        if self.lifecycle is Lifecycle.UNCONFIGURED and now < self._retry_at:
            return
        if self.lifecycle is Lifecycle.FAULT:
            if now < self._look_at:
                return
            self._look_at = now + FAULT_LOOK
        self._reference = None if self.muted else reference
        self._offered = True
        self._requests.wake.set()

    def _tell_doing(self) -> None:
        """Tell what the driver has begun to do; of several steps, the first as a warning."""
        before, self._doing = self._doing, self.driver.doing
        if self._doing:
            severity = "info" if before else "warning"
            self._event("device_busy", f"is {self._doing}", severity)

    # --- the task ----------------------------------------------------------------------------

    async def run(self) -> None:
        """Look after the device until cancelled, then close it."""
        try:
            while True:
                try:
                    async with asyncio.timeout(None) as self._limit:
                        while True:
                            await self._turn()
                except TimeoutError:
                    await self._overdue()
        finally:
            self.lifecycle = Lifecycle.CLOSED
            self.trouble = "it is closed"
            self._requests.refuse(NotConnected(self.name, "is closed"))
            with anyio.CancelScope(shield=True):
                await self._close()

    async def _turn(self) -> None:
        """Wait for something to do, and do it."""
        if self.tried.is_set():
            await self._requests.wake.wait()
        self._requests.wake.clear()
        if self._requests:
            self._begin(REQUEST_WITHIN)
            await self._requests.serve()
            self._end()
        offered, self._offered = self._offered, False
        if self.lifecycle is Lifecycle.UNCONFIGURED:
            if (offered or not self.tried.is_set()) and self._now() >= self._retry_at:
                await self._try_to_connect()
        elif offered:
            await self._exchange()

    async def _overdue(self) -> None:
        """Something took longer than its deadline and was given up."""
        self._end()
        self.tried.set()
        if self.lifecycle is Lifecycle.UNCONFIGURED:
            self._not_connected(NotConnected(self.name, "does not answer"))
            await self._close()
        else:
            await self._miss(BusTimeout(self.name, "no answer within the deadline"))

    async def _exchange(self) -> None:
        self._begin(self._deadline)
        self._exchanging = True
        reference, self._reference = self._reference, None
        try:
            self._take(await self.driver.sense())
            if reference is not None and self.lifecycle is Lifecycle.ACTIVE:
                await self.driver.move(reference)
        except Exception as error:
            await self._sort(error)
        else:
            self._accounts.exchanges += 1
            self._accounts.in_row = 0
        self._end()
