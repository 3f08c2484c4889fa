"""The link to one device: connect, exchange, detect errors, connect again."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import anyio

from rtee.errors import (
    BusBroken,
    BusClosed,
    CommandRejected,
    DeviceFault,
    HandshakeError,
    NotConnected,
    RteeError,
    UserError,
)
from rtee.loop.guarded_driver import GuardedDriver, line, warnings_of
from rtee.loop.runner import Runner
from rtee.loop.settings import DeviceSettings
from rtee.sample import ActuatorState
from rtee.types import Lifecycle, Reference

log = logging.getLogger(__name__)

BACKOFF = (0.2, 5.0)
"""First and longest time between attempts to connect [s]: a cable that slipped out is back within a
second, and a device that is switched off must not fill its bus and the log."""

CONNECT_WITHIN = 20.0
"""Time that connecting and identifying may take [s]; the slowest devices boot for ten seconds."""

ACTIVATE_WITHIN = 120.0
"""Time that activation, or another request, may take [s]: homing takes up to a minute."""

CLOSE_WITHIN = 1.0
"""Time that closing may take [s]: a run ends even if a bus hangs."""

LOST_AFTER = 0.5
"""A device that has not answered for this long, and three times in a row, is lost [s]: the retries
of a bus take less, and a person hardly notices it."""

LEAST_DEADLINE = 0.05
"""An exchange is given up after two of its periods, but not before this time [s]: a busy computer
delays an answer by some ten milliseconds."""

FAULT_LOOK = 0.1
"""A device in fault is read this often [s]: often enough to see the fault go."""


@dataclass(slots=True)
class ExchangeCounters:
    """Counters of one device since the start, and the rate of its exchanges.

    Attributes:
        exchanges: Exchanges done.
        overruns: Times that the next exchange was due before the last one was over.
        errors: Exchanges that failed.
        in_row: Exchanges that failed since the last one that worked.
        reconnects: Times the link was re-established.
    """

    exchanges: int = 0
    overruns: int = 0
    errors: int = 0
    in_row: int = 0
    reconnects: int = 0
    _rate: float = 0.0
    _since: float = 0.0
    _counted: int = 0

    def rate(self, now: float) -> float:
        """Return the rate of exchanges [Hz], measured over half a second or more."""
        passed = now - self._since
        # Over less time, a slow device's few exchanges would make the figure jump.
        if passed >= 0.5:
            self._rate = (self.exchanges - self._counted) / passed if self._since else 0.0
            self._since, self._counted = now, self.exchanges
        return self._rate


class DeviceConnection:
    """The link to one device; its coroutines are called by the device's task alone.

    Args:
        settings: The device.
        driver: Its driver.
        runner: The device's task.
        report: Called with events: kind, text, severity.
        now: The clock [s].

    Attributes:
        lifecycle: State of the device.
        state: Its newest state, or ``None``.
        states: Number of states that it has returned.
        counters: Counts of exchanges and their errors.
        every: Ticks from one exchange to the next.
        deadline: Time that an exchange may take [s].
        trouble: Why the device can't be moved, in words; empty when it can.
        message: The last error in words.
        fault: The fault that the device reports, if any.
        rejected: Why the device refused a reference; emptied by its reader.
        tried: Set after the first attempt to connect.
        mistake: The mistake in the configuration that prevents any connection.
    """

    def __init__(
        self,
        settings: DeviceSettings,
        driver: GuardedDriver,
        runner: Runner,
        report: Callable[[str, str, str], None],
        now: Callable[[], float],
    ) -> None:
        self.lifecycle = Lifecycle.UNCONFIGURED
        self.state: ActuatorState | None = None
        self.states = 0
        self.counters = ExchangeCounters()
        self.every = settings.spec.every or 1
        self.deadline = settings.spec.deadline or LEAST_DEADLINE
        self.trouble = "it is not connected yet"
        self.message = ""
        self.fault: DeviceFault | None = None
        self.rejected = ""
        self.tried = asyncio.Event()
        self.mistake: UserError | None = None
        self._settings = settings
        self._spec = settings.spec
        self._driver = driver
        self._runner = runner
        self._report = report
        self._now = now
        # Only the first time: a device that reconnects must not move before somebody recovers it.
        self._activate_on_connect = True
        self._linked_before = False
        self._reported = ""
        self._backoff = BACKOFF[0]
        # Connect at the first tick.
        self._next_at = -math.inf
        self._answered = -math.inf
        self._said: tuple[str, ...] = ()
        self._warned: tuple[str, ...] = ()

    def due(self) -> bool:
        """Return whether it is time to exchange with the device, or to try to connect to it."""
        if self.lifecycle is Lifecycle.UNCONFIGURED:
            return self._now() >= self._next_at
        if self.lifecycle is Lifecycle.FAULT:
            if self._now() < self._next_at:
                return False
            self._next_at = self._now() + FAULT_LOOK
        return True

    # --- exchanging --------------------------------------------------------------------------

    async def exchange(self, reference: Reference | None) -> None:
        """Read the state, then send the reference if there is one; cannot raise."""
        try:
            # Sense first: what the controller reads next must not wait for the sending.
            self.accept(await self._driver.sense())
            # A request may have made the device inactive since the reference was handed over.
            if reference is not None and self.lifecycle is Lifecycle.ACTIVE:
                await self._driver.move(reference)
        except Exception as error:
            await self.failed(error)
        else:
            self.counters.exchanges += 1
            self.counters.in_row = 0

    def accept(self, state: ActuatorState) -> None:
        """Keep a state that the driver returned."""
        self.state = state
        self.states += 1
        self._answered = self._now()
        if state.warnings != self._said:
            self._said, known = state.warnings, self._warned
            self._warned = warnings_of(state)
            for warning in self._warned:
                if warning not in known:
                    self._report("device_warning", warning, "warning")

    # --- connecting --------------------------------------------------------------------------

    async def connect(self) -> None:
        """Try to connect, then to activate the device where that is configured; cannot raise."""
        self._runner.begin(CONNECT_WITHIN)
        then = "" if self._activate_on_connect else "; it is inactive until recovered"
        try:
            await self._configure()
            if self._activate_on_connect:
                # Homing takes longer than connecting: it has a limit of its own.
                self._runner.begin(ACTIVATE_WITHIN)
                await self._activate()
        except Exception as error:
            # Anything else is a bug in the driver, which its author finds by the traceback.
            if not isinstance(error, RteeError | OSError | EOFError):
                log.exception("the driver of device '%s' failed", self._spec.name)
            # A device in fault answers: it keeps its link and waits to be recovered.
            if not isinstance(error, DeviceFault):
                self.lifecycle = Lifecycle.UNCONFIGURED
            await self.failed(error)
        # This resets the back-off, so it comes after activation: a device that fails to activate
        # is retried as seldom as one that fails to connect.
        if self.lifecycle is not Lifecycle.UNCONFIGURED:
            self._linked(then)
        self._runner.end()
        self.tried.set()

    async def _configure(self) -> None:
        await self._driver.configure()
        self._pace()
        self.accept(await self._driver.sense())
        self._next_at = -math.inf
        self.counters.in_row = 0
        self.lifecycle = Lifecycle.INACTIVE
        self.trouble = "it is inactive"
        self.message = ""

    def _linked(self, then: str) -> None:
        """Record that the link is up; ``then`` says in words what the device waits for."""
        self._backoff = BACKOFF[0]
        self._reported = ""
        if self._linked_before:
            self.counters.reconnects += 1
            self._report("reconnected", f"is connected again{then}", "info")
        self._linked_before = True

    def _pace(self) -> None:
        """Choose the number of ticks per exchange and its deadline by the best rate of the wire."""
        rate, best = self._spec.rate, self._driver.capabilities.best_rate
        # Rounding must not halve the rate of a device whose best rate equals that of the loop.
        least = max(1, math.ceil(rate / best - 1e-9)) if best > 0 else 1
        self.every = self._spec.every or least
        if self.every < least:
            text = f"is asked for {rate / self.every:g} Hz, its wire gives {best:.0f} Hz at most"
            self._report("device_rate", text, "warning")
        self.deadline = self._spec.deadline or max(2 * self.every / rate, LEAST_DEADLINE)

    async def _activate(self) -> None:
        # No timeout here: the runner watches over the whole attempt.
        await self._driver.activate()
        self.accept(await self._driver.sense())
        # From here on, somebody may have touched the hand by the time that a lost link is back.
        self._activate_on_connect = self._settings.reconnect_active
        self.fault = None
        self.message = self.trouble = ""
        self.lifecycle = Lifecycle.ACTIVE

    async def recover(self) -> None:
        """Bring the device out of a fault, or connect and activate it.

        Raises:
            Exception: the driver's error, which has been handled already.
        """
        if self.lifecycle is Lifecycle.ACTIVE:
            return
        self._backoff = BACKOFF[0]
        try:
            if self.lifecycle is Lifecycle.UNCONFIGURED:
                await self._configure()
                self._linked("")
            # A device that was disabled in fault is inactive, and its fault is still there.
            if self.fault is not None:
                await self._driver.recover()
                self.fault = None
                self.lifecycle = Lifecycle.INACTIVE
            await self._activate()
        except Exception as error:
            await self.failed(error)
            raise
        self._report("recovered", "is active again", "info")

    def deactivated(self, trouble: str) -> None:
        """Record that the device was made inactive; it stays inactive until `recover`."""
        self.lifecycle = Lifecycle.INACTIVE
        self.trouble = trouble
        self._activate_on_connect = False

    # --- errors ------------------------------------------------------------------------------

    async def failed(self, error: Exception) -> None:
        """Handle an error of the driver by its type."""
        match error:
            case DeviceFault():
                self._enter_fault(error)
            # The device works, but not with this reference: `Devices` restarts it from where the
            # device is.
            case CommandRejected():
                self.counters.errors += 1
                self.message = self.rejected = _words(error)
            case _ if self.lifecycle is Lifecycle.UNCONFIGURED:
                await self._not_connected(error)
            # These do not pass by themselves: connect again at once, without counting to three.
            case BusBroken() | BusClosed() | NotConnected() | HandshakeError():
                await self._lose(error)
            # One lost answer is normal on a noisy wire.
            case RteeError() | TimeoutError():
                await self._miss(error)
            case OSError() | EOFError():
                await self._lose(error)
            case _:
                log.error("the driver of device '%s' failed", self._spec.name, exc_info=error)
                await self._lose(error)

    def _enter_fault(self, fault: DeviceFault) -> None:
        # The device repeats its fault in every answer; one event is enough.
        new = self.fault is None or self.fault.name != fault.name
        self.message = _words(fault)
        self.trouble = f"it is in fault: {fault.name}"
        self.fault = fault
        self.lifecycle = Lifecycle.FAULT
        if new:
            text = f"reports fault {fault.code} ({fault.name})"
            text += f"; {fault.hint}" if fault.hint else ""
            self._report("device_fault", text, "error")

    async def _not_connected(self, error: Exception) -> None:
        """Schedule the next attempt to connect; report each reason once."""
        self.tried.set()
        if isinstance(error, UserError):
            self.mistake = error
        self._next_at = self._now() + self._backoff
        # Doubled: quick after a loose plug, quiet with a device that stays off.
        self._backoff = min(2 * self._backoff, BACKOFF[1])
        text = _words(error)
        if text != self._reported:
            self._report("device_unreachable", f"cannot be reached: {text}", "warning")
        self._reported = self.message = self.trouble = text
        await self.close()

    async def _miss(self, error: Exception) -> None:
        """Count an exchange that failed; after too many of them, the device is lost."""
        self.counters.errors += 1
        self.counters.in_row += 1
        self.message = _words(error)
        # Both: at 1 kHz three misses are a hiccup, and a slow device misses one in half a second.
        if self.counters.in_row >= 3 and self._now() - self._answered >= LOST_AFTER:
            await self._lose(error)

    async def _lose(self, error: Exception) -> None:
        self.counters.errors += 1
        self._reported = self.message = _words(error)
        self.trouble = f"it is lost: {self.message}"
        self.lifecycle = Lifecycle.UNCONFIGURED
        self.fault = None
        self._next_at = self._now() + self._backoff
        self._report("device_lost", f"is lost: {self.message}", "error")
        # The next attempt starts from a closed bus, which has discarded half-read answers.
        await self.close()

    async def close(self) -> None:
        """Close the driver in bounded time; cannot raise."""
        # Twice the time: the timeout below fires first, and cancelling takes some time, too.
        self._runner.begin(2 * CLOSE_WITHIN)
        try:
            # Unlike asyncio's, this timeout cancels again and again a driver that goes on.
            with anyio.fail_after(CLOSE_WITHIN):
                await self._driver.close()
        except Exception as error:
            log.warning("device '%s' did not close cleanly: %s", self._spec.name, _words(error))


def _words(error: BaseException) -> str:
    return line(error) or type(error).__name__
