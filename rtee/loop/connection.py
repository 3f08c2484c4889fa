"""The link to one device: connect and identify, notice what breaks, connect again."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Callable

from rtee.drivers.base import Driver
from rtee.errors import (
    BusBroken,
    BusClosed,
    CommandRejected,
    DeviceFault,
    DriverError,
    HandshakeError,
    NotConnected,
    RteeError,
    UserError,
)
from rtee.loop.exchange_counters import Accounts
from rtee.loop.settings import DeviceSettings
from rtee.sample import measured_arrays
from rtee.types import ActuatorState, Event, Lifecycle

log = logging.getLogger(__name__)

BACKOFF = (0.2, 5.0)
"""First and longest time between attempts to connect [s]."""

CONNECT_WITHIN = 20.0
"""Time that connecting and identifying may take [s]."""

REQUEST_WITHIN = 120.0
"""Time that a request may take, activation with homing included [s]."""

CLOSE_WITHIN = 1.0
"""Time that closing may take [s]."""

LOST_AFTER = 0.5
"""A device that has not answered for this long, and three times in a row, is lost [s]."""

LEAST_DEADLINE = 0.05
"""An exchange is given up after two of its periods, but not before this time [s]."""


class Connection:
    """The link to one device, and what is known of it; used by the device's task alone.

    Args:
        settings: The device.
        driver: Its driver.
        indices: The hand's indices of its actuators.
        tell: Called with events.
        now: The clock [s].

    Attributes:
        state: What it measured last, or ``None``.
        states: How many states it has given.
        lifecycle: How it is.
        every: It is exchanged every n ticks.
        trouble: Why it can't be moved, in words; empty when it can.
        tried: Set after the first attempt to connect.
        mistake: The user's mistake that keeps it from ever connecting.
        rejected: Why it refused a reference, until it is read and emptied.
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
        self.settings = settings
        self.spec = settings.spec
        self.driver = driver
        self.indices = indices
        self.state: ActuatorState | None = None
        self.states = 0
        self.lifecycle = Lifecycle.UNCONFIGURED
        self.every = settings.spec.every or 1
        self.trouble = "it is not connected yet"
        self.tried = asyncio.Event()
        self.mistake: UserError | None = None
        self.rejected = ""
        self._tell = tell
        self._now = now
        self._accounts = Accounts()
        self._busy = False
        self._exchanging = False
        self._give_up_at = math.inf
        self._limit: asyncio.Timeout | None = None
        self._deadline = settings.spec.deadline or LEAST_DEADLINE
        self._fault: DeviceFault | None = None
        self._activate_on_connect = True
        self._backoff = BACKOFF[0]
        self._retry_at = -math.inf
        self._answered = -math.inf
        self._message = ""
        self._warned: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The device's name."""
        return self.spec.name

    @property
    def active(self) -> bool:
        """Whether it may be moved."""
        return self.lifecycle is Lifecycle.ACTIVE

    def _begin(self, within: float) -> None:
        self._busy = True
        self._give_up_at = self._now() + within

    def _end(self) -> None:
        self._busy = self._exchanging = False
        limit = self._limit
        if limit is not None and limit.when() is not None and not limit.expired():
            limit.reschedule(None)

    def _interrupt(self, after: float) -> None:
        """Give up what the task is doing, unless it is done within a time [s]."""
        if self._busy and self._limit is not None and not self._limit.expired():
            self._limit.reschedule(asyncio.get_running_loop().time() + after)

    def _take(self, state: ActuatorState) -> None:
        n = len(self.indices)
        if {len(values) for values in measured_arrays(state)} != {n}:
            raise DriverError(
                self.name, f"gave a state that is not one of {n} actuators", hint="mend its driver"
            )
        self.state = state
        self.states += 1
        self._answered = self._now()
        if state.warnings != self._warned:
            for warning in state.warnings:
                if warning not in self._warned:
                    self._event("device_warning", warning, "warning")
            self._warned = state.warnings

    # --- connecting --------------------------------------------------------------------------

    async def _try_to_connect(self) -> None:
        self._begin(CONNECT_WITHIN)
        try:
            await self._configure()
            if self._activate_on_connect:
                self._begin(REQUEST_WITHIN)
                await self._activate()
        except Exception as error:
            if not isinstance(error, RteeError | OSError | EOFError):
                log.exception("the driver of device '%s' failed", self.name)
            if not isinstance(error, DeviceFault):
                self.lifecycle = Lifecycle.UNCONFIGURED
            await self._sort(error)
        self._end()
        self.tried.set()

    def _not_connected(self, error: Exception) -> None:
        self.tried.set()
        if isinstance(error, UserError):
            self.mistake = error
        self.lifecycle = Lifecycle.UNCONFIGURED
        self._retry_at = self._now() + self._backoff
        self._backoff = min(2 * self._backoff, BACKOFF[1])
        text = _words(error)
        if text != self._message:
            self._event("device_unreachable", f"cannot be reached: {text}", "warning")
        self._message = self.trouble = text

    async def _configure(self) -> None:
        again = self.states > 0
        await self.driver.configure()
        self._pace()
        self._take(await self.driver.sense())
        self._backoff = BACKOFF[0]
        self._retry_at = -math.inf
        self._accounts.in_row = 0
        self.lifecycle = Lifecycle.INACTIVE
        self.trouble = "it is inactive"
        self._message = ""
        if again:
            self._accounts.reconnects += 1
            then = "" if self._activate_on_connect else "; it is inactive until recovered"
            self._event("reconnected", f"is connected again{then}")

    def _pace(self) -> None:
        rate, best = self.spec.rate, self.driver.capabilities.best_rate
        least = max(1, math.ceil(rate / best - 1e-9)) if best > 0 else 1
        self.every = self.spec.every or least
        if self.every < least:
            text = f"is asked for {rate / self.every:g} Hz, its wire gives {best:.0f} Hz at most"
            self._event("device_rate", text, "warning")
        self._deadline = self.spec.deadline or max(2 * self.every / rate, LEAST_DEADLINE)

    async def _activate(self) -> None:
        await self.driver.activate()
        self._take(await self.driver.sense())
        self._activate_on_connect = self.settings.reconnect_active
        self._fault = None
        self._message = self.trouble = ""
        self.lifecycle = Lifecycle.ACTIVE

    # --- what breaks -------------------------------------------------------------------------

    async def _sort(self, error: Exception) -> None:
        """Do what an error of the driver calls for."""
        match error:
            case DeviceFault():
                self._enter_fault(error)
            case CommandRejected():
                self._accounts.errors += 1
                self._message = self.rejected = _words(error)
            case _ if self.lifecycle is Lifecycle.UNCONFIGURED:
                self._not_connected(error)
                await self._close()
            case BusBroken() | BusClosed() | NotConnected() | HandshakeError():
                await self._lose(error)
            case RteeError() | TimeoutError():
                await self._miss(error)
            case OSError() | EOFError():
                await self._lose(error)
            case _:
                log.error("the driver of device '%s' failed", self.name, exc_info=error)
                await self._lose(error)

    async def _miss(self, error: Exception) -> None:
        """Count an exchange that failed; too many of them mean that the device is lost."""
        self._accounts.errors += 1
        self._accounts.in_row += 1
        self._message = _words(error)
        if self._accounts.in_row >= 3 and self._now() - self._answered >= LOST_AFTER:
            await self._lose(error)

    async def _lose(self, error: Exception) -> None:
        self._accounts.errors += 1
        self._message = _words(error)
        self.trouble = f"it is lost: {self._message}"
        self.lifecycle = Lifecycle.UNCONFIGURED
        self._fault = None
        self._retry_at = self._now() + self._backoff
        self._event("device_lost", f"is lost: {self._message}", "error")
        await self._close()

    def _enter_fault(self, fault: DeviceFault) -> None:
        self._message = _words(fault)
        self.trouble = f"it is in fault: {fault.name}"
        new = self._fault is None or self._fault.name != fault.name
        self._fault = fault
        self.lifecycle = Lifecycle.FAULT
        if new:
            hint = f"; {fault.hint}" if fault.hint else ""
            self._event("device_fault", f"reports fault {fault.code} ({fault.name}){hint}", "error")

    async def _close(self) -> None:
        self._give_up_at = self._now() + 2 * CLOSE_WITHIN
        try:
            async with asyncio.timeout(CLOSE_WITHIN):
                await self.driver.close()
        except Exception as error:
            log.warning("device '%s' did not close cleanly: %s", self.name, error)

    def _event(self, kind: str, text: str, severity: str = "info") -> None:
        text = f"device '{self.name}' {text}"
        self._tell(Event(kind, self.name, text, self._now(), severity))


def _words(error: BaseException) -> str:
    return str(error) or type(error).__name__
