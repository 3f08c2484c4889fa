"""The task that supervises one device: it exchanges references and states, and serves requests."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import anyio
import numpy as np

from rtee import monotonic
from rtee.buses.retry import patiently
from rtee.drivers.base import Driver
from rtee.errors import (
    BusBroken,
    BusClosed,
    BusTimeout,
    CommandRejected,
    DeviceFault,
    DriverError,
    HandshakeError,
    NotConnected,
    RteeError,
    UserError,
    foreign,
)
from rtee.loop.guarded_driver import GuardedDriver, line, warnings_of
from rtee.loop.runner import Runner
from rtee.loop.settings import DeviceSettings
from rtee.sample import ActuatorState, FloatArray
from rtee.types import DeviceStatus, Event, Lifecycle, Reference, readonly

log = logging.getLogger(__name__)

BACKOFF = (0.2, 5.0)
"""First and longest time between attempts to connect [s]: a loose cable is back within a second,
and attempts at a device that is switched off must not fill its bus and the log."""

CONNECT_WITHIN = 20.0
"""Time that connecting and identifying may take [s]; the slowest devices boot for ten seconds."""

ACTIVATE_WITHIN = 120.0
"""Time that activation, or another request, may take [s]: homing takes up to a minute."""

CLOSE_WITHIN = 1.0
"""Time that closing may take [s]: a run ends even if a bus hangs."""

LOST_AFTER = 0.5
"""A device with which no exchange succeeded for this long, and three in a row failed, is lost [s],
even if it still answers readings: longer than a bus takes to retry, and barely noticeable to a
person. If three deadlines take longer, that is the time, even if the driver gives up sooner."""

LEAST_DEADLINE = 0.05
"""An exchange is abandoned after two of its periods, but not before this time [s]: a busy computer
delays an answer by some ten milliseconds."""

FAULT_LOOK = 0.1
"""Interval at which a device in fault is read [s]: short enough to see the fault clear."""


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
        answered: When it returned the newest one, by the loop's clock [s].
        activations: Number of times that it became active.
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
        self.activations = 0
        self.counters = ExchangeCounters()
        self.every = settings.spec.every or 1
        self._reach = LEAST_DEADLINE
        self.deadline = settings.spec.deadline or self._reach
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
        # Only the first time: a device that reconnects must not move until somebody recovers it.
        self._activate_on_connect = True
        self._linked_before = self._given_up = False
        self._reported = ""
        self._backoff = BACKOFF[0]
        # Connect at the first tick.
        self._next_at = -math.inf
        self.answered = -math.inf
        self._done_at = self._given_at = -math.inf
        self._given: FloatArray | None = None
        self._behind = False
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
            # Sense first: the controller's next input must not wait for sending.
            self.accept(await self._driver.sense())
            # After a pause of this process, the reference is older than any hand may follow.
            if self._runner.late:
                raise TimeoutError("no answer within the deadline")
            # A request may have made the device inactive since the reference was handed over.
            if reference is not None and self.lifecycle is Lifecycle.ACTIVE:
                await self._give(reference)
        except Exception as error:
            await self.failed(error)
        else:
            self._done_at = self.answered
            self.counters.exchanges += 1
            self.counters.in_row = 0

    async def _give(self, reference: Reference) -> None:
        """Send a reference, within reach of the last one that the device is known to have."""
        # Before the first one has arrived, the loop's reference may have moved on, too.
        if self.counters.in_row or self._behind or self._given_at == -math.inf:
            reference = self._within_reach(reference)
        position, given = reference.position, self._given
        try:
            await self._driver.move(reference)
        except BaseException:
            # It may have arrived or not: only where none was known, the next ones start from it.
            self._behind = True
            if self._given is given:  # else they were started anew meanwhile
                if given is not None:
                    position = readonly(np.where(np.isnan(given), position, given))
                self._given = position
            raise
        self._given_at = self.answered
        if self._given is given:
            self._given = position

    def _within_reach(self, reference: Reference) -> Reference:
        """Return a reference that the device reaches without a jump after missed exchanges.

        Meanwhile, the loop's reference has moved on; the device catches up with it within the
        velocity limits, at first by no more than two periods' travel.
        """
        if self._given is None:
            return reference
        longest = self._reach if self.counters.in_row else self.deadline
        # Until one has arrived, the first one is where the references start.
        passed = self.answered - self._given_at if self._given_at > -math.inf else 0.0
        most = reference.max_velocity * min(passed, longest)
        # `fmin` and `fmax` prefer a number to NaN, which stands for a reference not known.
        near = np.fmax(np.fmin(reference.position, self._given + most), self._given - most)
        self._behind = bool((near != reference.position).any())
        return replace(reference, position=readonly(near)) if self._behind else reference

    def last(self, reference: Reference) -> Reference:
        """Return the reference to leave the device with: its last one if it missed some since."""
        given = self._given
        if given is None or not (self.counters.in_row or self._behind):
            return reference
        position = np.where(np.isnan(given), reference.position, given)
        return replace(reference, position=readonly(position))

    def restart(self, places: Sequence[int], position: FloatArray) -> None:
        """Let some of the device's references start anew, from positions ``(n,)`` [rad | m]."""
        given = np.full(len(position), math.nan) if self._given is None else np.array(self._given)
        given[places] = position[places]
        self._given = given

    def accept(self, state: ActuatorState) -> None:
        """Keep a state that the driver returned."""
        self.state = state
        self.states += 1
        self.answered = self._now()
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
                # Homing takes longer than connecting, so it has its own limit.
                self._runner.begin(ACTIVATE_WITHIN)
                await self._activate()
        except Exception as error:
            # Anything else is a bug in the driver, which its author finds with the traceback.
            if not isinstance(error, RteeError | OSError | EOFError):
                log.exception("the driver of device '%s' failed", self._spec.name)
            # A device in fault answers: it keeps its link and waits to be recovered.
            if not isinstance(error, DeviceFault):
                self.lifecycle = Lifecycle.UNCONFIGURED
            await self.failed(error)
        # This resets the back-off, so it comes after activation: a device that fails to activate
        # is retried as rarely as one that fails to connect.
        if self.lifecycle is not Lifecycle.UNCONFIGURED:
            self._linked(then)
        self._runner.end()
        self.tried.set()

    async def _configure(self) -> None:
        await self._driver.configure()
        self._pace()
        self.accept(await self._driver.sense())
        self._done_at = self.answered
        self._next_at = -math.inf
        self.counters.in_row = 0
        self.lifecycle = Lifecycle.INACTIVE
        self.trouble = "it is inactive"
        self.message = ""

    def _linked(self, then: str) -> None:
        """Record that the link is up; ``then`` describes what the device waits for."""
        self._backoff = BACKOFF[0]
        self._reported = ""
        if self._linked_before:
            self.counters.reconnects += 1
            self._report("reconnected", f"is connected again{then}", "info")
        self._linked_before = True

    def _pace(self) -> None:
        """Choose the ticks per exchange, and its deadline, from the highest rate of the link."""
        rate, best = self._spec.rate, self._driver.capabilities.best_rate
        # Rounding must not halve the rate of a device whose best rate equals that of the loop.
        least = max(1, math.ceil(rate / best - 1e-9)) if best > 0 else 1
        self.every = self._spec.every or least
        if self.every < least:
            text = f"is asked for {rate / self.every:g} Hz; its wire allows at most {best:.0f} Hz"
            self._report("device_rate", text, "warning")
        self._reach = max(2 * self.every / rate, LEAST_DEADLINE)
        self.deadline = self._spec.deadline or self._reach

    async def _activate(self) -> None:
        # No timeout here: the runner watches over the whole attempt.
        await self._driver.activate()
        self.accept(await self._driver.sense())
        self._done_at = self.answered
        self.counters.in_row = 0
        # From here on, somebody may touch the hand while the link is lost.
        self._activate_on_connect = self._settings.reconnect_active
        self.fault = None
        self.message = self.trouble = ""
        self._given, self._given_at = None, -math.inf
        self.activations += 1
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
                self._given_up = False
                await self._configure()
                self._linked("")
                if self._given_up:
                    raise RteeError("'recover' was interrupted")
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

    def give_up_activation(self) -> None:
        """Leave a device inactive that has never been connected, until `recover`."""
        self._given_up = True
        # Later activations never home, and so move nothing.
        if not self._linked_before:
            self._activate_on_connect = False

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
                self.counters.in_row, self._done_at = 0, self.answered  # it answered
                self.message = self.rejected = _words(error)
            case _ if self.lifecycle is Lifecycle.UNCONFIGURED:
                await self._not_connected(error)
            # These errors do not clear by themselves: reconnect at once, without counting to three.
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
        if isinstance(error, UserError):
            self.mistake = error
        # `ready` raises a mistake found in the first attempt; one report is enough.
        told = self.mistake is not None and not self.tried.is_set()
        self.tried.set()
        self._next_at = self._now() + self._backoff
        # Doubled: quick after a loose plug, rarely for a device that stays off.
        self._backoff = min(2 * self._backoff, BACKOFF[1])
        text = _words(error)
        if text != self._reported and not told:
            self._report("device_unreachable", f"cannot be reached: {text}", "warning")
        self._reported = self.message = self.trouble = text
        await self.close()

    async def _miss(self, error: Exception) -> None:
        """Count an exchange that failed; after too many of them, the device is lost."""
        self.counters.errors += 1
        self.counters.in_row += 1
        self.message = _words(error)
        # Both: at 1 kHz, three misses are a hiccup; for a slow device, half a second is one.
        silence = self._now() - self._done_at
        if self.counters.in_row >= 3 and silence >= max(LOST_AFTER, 3 * self.deadline):
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
            # Unlike asyncio's, this timeout keeps cancelling a driver that does not end.
            with anyio.fail_after(CLOSE_WITHIN):
                await self._driver.close()
        except Exception as error:
            log.warning("device '%s' did not close cleanly: %s", self._spec.name, _words(error))


def _words(error: BaseException) -> str:
    return line(error) or type(error).__name__


_RECOVER = "recover"
"""Name of the request to recover a device."""

_BURST = 10.0
"""Events of one kind that a device may cause at once: more than any real trouble causes."""

_EVENT_RATE = 1.0
"""Further events of that kind [1/s]: each is recorded, published and shown to people."""


@dataclass(slots=True)
class _Request:
    name: str
    action: Callable[[], Awaitable[Any]]
    answer: asyncio.Future[Any]


class _EventLimit:
    """Limits the events of one kind of a device: a burst, then one a second."""

    def __init__(self, now: float) -> None:
        self._left, self._then = _BURST, now
        self._left_out = 0

    def allow(self, now: float) -> int | None:
        """Return how many events were suppressed before this one; ``None`` to suppress it, too."""
        self._left = min(self._left + (now - self._then) * _EVENT_RATE, _BURST)
        self._then = now
        if self._left < 1.0:
            self._left_out += 1
            return None
        self._left -= 1.0
        left_out, self._left_out = self._left_out, 0
        return left_out


class Supervisor:
    """Supervises one device in a long-lived task, which alone calls the device's driver.

    At a tick the loop reads the connection's state and calls `exchange`; neither waits. With a
    driver that answers at once, the exchange is done when `exchange` returns; otherwise the task
    waits for the answer. Further exchanges until then count as overruns. All time comes from the
    ticks.

    Args:
        settings: The device.
        driver: Its driver.
        indices: The hand's indices of its actuators.
        on_event: Called with events.
        now: The clock [s].

    Attributes:
        spec: The device as configured.
        driver: Its driver; call it through ``guarded``.
        guarded: The driver as the loop calls it.
        name: Its name.
        actuators: Names of its actuators.
        indices: The hand's indices of its actuators.
        connection: The link to it, with its state.
        muted: How many requests want only the state to be read, and no references to be sent.
    """

    def __init__(
        self,
        settings: DeviceSettings,
        driver: Driver,
        indices: tuple[int, ...],
        on_event: Callable[[Event], None],
        *,
        now: Callable[[], float] = monotonic.asked,
    ) -> None:
        self.spec = settings.spec
        self.driver = driver
        self.name = settings.spec.name
        self.actuators = tuple(actuator.name for actuator in settings.spec.actuators)
        self.indices = indices
        self.muted = 0
        self._on_event = on_event
        self._now = now
        self._runner = Runner(now)
        self.guarded = GuardedDriver(driver, self.name, len(self.actuators))
        self._runner.abandon = self._abandon
        self.connection = DeviceConnection(settings, self.guarded, self._runner, self._report, now)
        self._limits: dict[str, _EventLimit] = {}
        self._requests: deque[_Request] = deque()
        self._closed: Exception | None = None
        self._next_due = 0
        self._exchanging = False
        self._doing = ""

    @property
    def lifecycle(self) -> Lifecycle:
        """State of the device."""
        return self.connection.lifecycle

    @property
    def active(self) -> bool:
        """Whether the device may be moved."""
        return self.connection.lifecycle is Lifecycle.ACTIVE

    async def ready(self) -> None:
        """Wait until the first attempt to connect is over.

        Raises:
            UserError: if a mistake in the configuration keeps the device from ever connecting.
        """
        await self.connection.tried.wait()
        if self.connection.mistake is not None:
            raise self.connection.mistake

    def status(self) -> DeviceStatus:
        """Return the status of the device."""
        now, link = self._now(), self.connection
        counters, fault = link.counters, link.fault
        gains, known = self.guarded.capabilities.gains, self.guarded.gains()
        return DeviceStatus(
            name=self.name,
            driver=self.spec.driver,
            lifecycle=link.lifecycle,
            identity=self.guarded.capabilities.identity,
            rate=counters.rate(now),
            every=link.every,
            age=math.inf if link.state is None else max(0.0, now - link.state.stamp),
            exchanges=counters.exchanges,
            overruns=counters.overruns,
            errors=counters.errors,
            reconnects=counters.reconnects,
            counters=self.guarded.counters(),
            fault_code=0 if fault is None else fault.code,
            fault_name="" if fault is None else fault.name,
            recoverable=fault is not None and fault.recoverable,
            hint="" if fault is None else fault.hint,
            message=self.guarded.doing or link.message,
            gains=gains,
            gain_values=tuple(known.get(name, math.nan) for name in gains),
        )

    def _report(self, kind: str, text: str, severity: str) -> None:
        self._tell(kind, f"device '{self.name}' {foreign(text)}", severity)

    def warn(self, kind: str, text: str) -> None:
        """Report a warning about the device, within the limits of its events."""
        self._tell(kind, foreign(text), "warning")

    def _tell(self, kind: str, text: str, severity: str) -> None:
        now = self._now()
        limit = self._limits.setdefault(kind, _EventLimit(now))
        left_out = limit.allow(now)
        if left_out is None:
            return
        if left_out:
            text += f"; {left_out} more such events were left out"
        self._on_event(Event(kind, self.name, text, now, severity))

    def _abandon(self) -> None:
        self.guarded.abandoned = True

    # --- at a tick ---------------------------------------------------------------------------

    def due(self, tick: int) -> bool:
        """Return whether an exchange is due at a tick; called once per tick."""
        if tick < self._next_due:
            return False
        every = self.connection.every
        # At multiples, not counted from the last exchange: devices keep their phase after a missed
        # tick.
        self._next_due = tick - tick % every + every
        return True

    def exchange(self, reference: Reference | None) -> None:
        """Run one exchange: read the state, then send the reference if there is one."""
        link, runner = self.connection, self._runner
        doing = self.guarded.doing
        if doing != self._doing:
            self._report_doing(doing)
        if not runner.idle:
            link.counters.overruns += self._exchanging
            # Time comes from the ticks, so that deadlines hold in simulated time, too.
            runner.check()
        elif link.lifecycle is Lifecycle.UNCONFIGURED:
            self._exchanging = False
            if link.due():
                runner.start(link.connect())
        elif link.lifecycle is Lifecycle.ACTIVE or link.due():
            self._exchanging = True
            if not runner.start(link.exchange(None if self.muted else reference)):
                runner.begin(link.deadline)

    def _report_doing(self, doing: str) -> None:
        """Report a lengthy operation of the driver; only its first step is a warning."""
        before, self._doing = self._doing, doing
        if self._doing:
            self._report("device_busy", f"is {self._doing}", "info" if before else "warning")

    # --- the task ----------------------------------------------------------------------------

    async def run(self) -> None:
        """Supervise the device until cancelled, then close it."""
        link, runner = self.connection, self._runner
        try:
            while True:
                try:
                    async with runner.guard():
                        if not link.tried.is_set():
                            await link.connect()
                        while True:
                            # Before waiting: a request may have arrived during an exchange.
                            await self._serve_requests()
                            await runner.carry_on()
                except TimeoutError:
                    await self._overdue()
        finally:
            link.lifecycle = Lifecycle.CLOSED
            link.trouble = "it is closed"
            self._refuse_requests(NotConnected(self.name, "is closed"))
            with anyio.CancelScope(shield=True):
                await link.close()

    async def _overdue(self) -> None:
        """Handle work that exceeded its deadline and was abandoned."""
        self._exchanging = False
        self._runner.end()
        self.connection.tried.set()
        if self.lifecycle is Lifecycle.UNCONFIGURED:
            await self.connection.failed(NotConnected(self.name, "does not answer"))
        else:
            await self.connection.failed(BusTimeout(self.name, "no answer within the deadline"))

    # --- requests, served between two exchanges ----------------------------------------------

    async def stop(self, within: float) -> bool:
        """Stop the device within a time [s], again if it did not answer; return whether it did.

        What would activate the device, and may home it, is given up. Cannot raise.
        """
        self._give_up_activation()
        return await self._confirmed("stop", self._stop, within)

    async def disable(self, within: float) -> bool:
        """Disable the device, which leaves it limp and inactive. Returns the same as `stop`."""
        self._give_up_activation()
        return await self._confirmed("disable", self._disable, within)

    async def hold(self, reference: Reference, within: float) -> bool:
        """Send a last reference. Returns the same as `stop`."""
        return await self._confirmed("hold", lambda: self._send_last(reference), within)

    async def recover(self) -> None:
        """Bring the device out of a fault, or connect and activate it, without moving it.

        Raises:
            RteeError: if the device cannot be recovered, or a stop has interrupted the recovery.
        """
        await self._ask(_RECOVER, self.connection.recover)

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Change gains of the device.

        Raises:
            DriverError: if the device has no such gain.
            RteeError: if the device refuses them.
        """
        known = self.guarded.capabilities.gains
        for name in gains:
            if name not in known:
                hint = f"it has: {', '.join(known) or 'none'}"
                raise DriverError(self.name, f"has no gain '{name}'", hint=hint)
        await self._ask("set gains", lambda: self.guarded.set_gains(gains))

    def _give_up_activation(self) -> None:
        """Refuse waiting requests to recover; leave a device inactive that is being connected."""
        self.connection.give_up_activation()
        for request in self._requests:
            if request.name == _RECOVER and not request.answer.done():
                request.answer.set_exception(RteeError(f"'{request.name}' was interrupted"))

    async def _stop(self) -> None:
        await patiently(self.guarded.stop)
        self.connection.accept(await patiently(self.guarded.sense))

    async def _disable(self) -> None:
        await patiently(self.guarded.disable)
        self.connection.deactivated("it was disabled")
        self.connection.accept(await patiently(self.guarded.sense))

    async def _send_last(self, reference: Reference) -> bool:
        self.connection.accept(await patiently(self.guarded.sense))
        # An inactive device would refuse the reference, and does not move anyway.
        if not self.active:
            return False
        last = self.connection.last(reference)
        await patiently(lambda: self.guarded.move(last))
        return True

    async def _confirmed(
        self, name: str, action: Callable[[], Awaitable[bool | None]], within: float
    ) -> bool:
        """Serve a request before all others; return whether it was served in time."""
        # Without a link nothing can be confirmed.
        if self.lifecycle in (Lifecycle.UNCONFIGURED, Lifecycle.CLOSED):
            return False
        # A running exchange gets a third of the time to end: if it were cut short, its answer would
        # arrive in the middle of the request.
        self._runner.interrupt(within / 3)
        try:
            async with asyncio.timeout(within):
                return await self._ask(name, action, first=True) is not False
        except Exception as error:
            self._runner.interrupt()
            why = (
                f"no answer within {within:g} s"
                if isinstance(error, TimeoutError)
                else _words(error)
            )
            log.warning("device '%s' did not confirm '%s': %s", self.name, name, why)
            return False

    async def _ask(
        self, name: str, action: Callable[[], Awaitable[Any]], *, first: bool = False
    ) -> Any:
        """Have the device's task serve a request; return its result or raise its error.

        ``first``: before the requests already waiting.
        """
        if self._closed is not None:
            raise self._closed
        request = _Request(name, action, asyncio.get_running_loop().create_future())
        if first:
            self._requests.appendleft(request)
        else:
            self._requests.append(request)
        if self._runner.idle and self._runner.start(self._serve_requests()):
            self._runner.end()  # all were served inside of the call: no deadline may stay
        return await request.answer

    async def _serve_requests(self) -> None:
        """Serve the waiting requests; exceptions are raised in their callers."""
        while self._requests:
            request = self._requests.popleft()
            answer = request.answer
            # The caller has given up, or a stop has refused it.
            if answer.done():
                continue
            self._exchanging = False
            # The third of the time that a stop left for the running work ends with that work.
            self._runner.end()
            self._runner.begin(ACTIVATE_WITHIN)
            try:
                result = await request.action()
            except asyncio.CancelledError:
                if not answer.done():
                    answer.set_exception(RteeError(f"'{request.name}' was interrupted"))
                raise
            except Exception as error:
                if not answer.done():
                    answer.set_exception(error)
            else:
                if not answer.done():
                    answer.set_result(result)

    def _refuse_requests(self, error: Exception) -> None:
        """Answer all waiting and future requests with an error."""
        self._closed = error
        while self._requests:
            request = self._requests.popleft()
            if not request.answer.done():
                request.answer.set_exception(error)
