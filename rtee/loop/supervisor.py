"""The task that supervises one device: it exchanges references and states, and serves requests."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any

import anyio

from rtee import monotonic
from rtee.buses.retry import patiently
from rtee.drivers.base import Driver
from rtee.errors import BusTimeout, DriverError, NotConnected, RteeError, foreign
from rtee.loop.connection import ACTIVATE_WITHIN, DeviceConnection
from rtee.loop.guarded_driver import GuardedDriver
from rtee.loop.runner import Runner
from rtee.loop.settings import DeviceSettings
from rtee.types import DeviceStatus, Event, Lifecycle, Reference

log = logging.getLogger(__name__)


_BURST = 10.0
"""Events of one kind that a device may cause at once: more than any cause of trouble has."""

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
        """Return the number of events suppressed before this one; ``None``: suppress it, too."""
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
        muted: Whether only the state is read, and no references are sent.
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
        self.muted = False
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
        """Report what the driver has begun to do; only the first of several steps is a warning."""
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

        Cannot raise.
        """
        return await self._confirmed("stop", self._stop, within)

    async def disable(self, within: float) -> bool:
        """Disable the device, which leaves it limp and inactive. Returns the same as `stop`."""
        return await self._confirmed("disable", self._disable, within)

    async def hold(self, reference: Reference, within: float) -> bool:
        """Send a last reference. Returns the same as `stop`."""
        return await self._confirmed("hold", lambda: self._send_last(reference), within)

    async def recover(self) -> None:
        """Bring the device out of a fault, or connect and activate it, without moving it.

        Raises:
            RteeError: if the device cannot be recovered, or a stop has interrupted the recovery.
        """
        await self._ask("recover", self.connection.recover)

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

    async def _stop(self) -> None:
        await patiently(self.guarded.stop)
        self.connection.accept(await patiently(self.guarded.sense))

    async def _disable(self) -> None:
        await patiently(self.guarded.disable)
        await patiently(self.guarded.deactivate)
        self.connection.deactivated("it was disabled")
        self.connection.accept(await patiently(self.guarded.sense))

    async def _send_last(self, reference: Reference) -> bool:
        self.connection.accept(await patiently(self.guarded.sense))
        # An inactive device would refuse the reference, and does not move anyway.
        if not self.active:
            return False
        await patiently(lambda: self.guarded.move(reference))
        return True

    async def _confirmed(
        self, name: str, action: Callable[[], Awaitable[bool | None]], within: float
    ) -> bool:
        """Serve a request before all others; return whether it was served in time."""
        # Without a link nothing can be confirmed.
        if self.lifecycle in (Lifecycle.UNCONFIGURED, Lifecycle.CLOSED):
            return False
        # A running exchange gets a third of the time to end: if it were cut short, its answer would
        # arrive in the midst of the request.
        self._runner.interrupt(within / 3)
        try:
            async with asyncio.timeout(within):
                return await self._ask(name, action, first=True) is not False
        except Exception as error:
            self._runner.interrupt()
            log.warning("device '%s' did not confirm '%s': %r", self.name, name, error)
            return False

    async def _ask(
        self, name: str, action: Callable[[], Awaitable[Any]], *, first: bool = False
    ) -> Any:
        """Have the device's task serve a request; return its result or raise its error.

        ``first``: before the requests that wait already.
        """
        if self._closed is not None:
            raise self._closed
        request = _Request(name, action, asyncio.get_running_loop().create_future())
        if first:
            self._requests.appendleft(request)
        else:
            self._requests.append(request)
        if self._runner.idle:
            self._runner.start(self._serve_requests())
        return await request.answer

    async def _serve_requests(self) -> None:
        """Serve the waiting requests; exceptions are raised in their callers."""
        while self._requests:
            request = self._requests.popleft()
            answer = request.answer
            # The caller has given up.
            if answer.cancelled():
                continue
            self._exchanging = False
            # The third of the time that a stop has left to the work before it ends with that work.
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
