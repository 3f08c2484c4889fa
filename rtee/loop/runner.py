"""A long-lived task that begins its work inside the call that starts it."""

from __future__ import annotations

import asyncio
import math
import types
from asyncio.tasks import _enter_task, _leave_task
from collections.abc import AsyncIterator, Callable, Coroutine, Generator
from contextlib import asynccontextmanager
from contextvars import Context
from typing import Any

from rtee import monotonic

Work = Coroutine[Any, Any, object]

_LATE = 0.1
"""Time after its deadline [s] at which work is late: ticks that check it come more often, so the
process had stopped, or the computer was too busy."""

_ABANDON_AFTER = 1.0
"""Time after its deadline at which work that is still running is abandoned [s]: clean-up that waits
for a bus takes a few hundredths."""


class Runner:
    """Runs coroutines in one task, one at a time, and abandons them at a deadline.

    `start` runs a coroutine inside the call, as a part of the task, until the coroutine has to
    wait; then the task continues it. A coroutine that doesn't wait is done when `start` returns.
    Waking the task with an `asyncio.Event` instead would take another turn of the event loop, which
    costs more processor time than the exchange with a device that answers at once. (Python 3.12's
    eager tasks start in the same way, but each exchange would need a new task.)

    Deadlines are in the time of the hand's loop and checked at its ticks, so that they hold in
    simulated time, too.

    Args:
        now: The clock of the hand's loop [s].

    Attributes:
        abandon: Called before work that ignored an interruption is cancelled once more: the work
            must then uncancel the task and raise `TimeoutError`.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._until = math.inf
        self._suspended = 0.0
        self._timeout: asyncio.Timeout | None = None
        self.abandon: Callable[[], None] = lambda: None
        self._task: asyncio.Task[Any] | None = None
        self._idle = _Idle()
        self._begun: tuple[Work, object] | None = None

    # --- work --------------------------------------------------------------------------------

    @property
    def idle(self) -> bool:
        """Whether the task waits for work."""
        return self._idle.resume is not None

    def start(self, work: Work) -> bool:
        """Begin a coroutine; return whether it is done already.

        Raises:
            RuntimeError: if the task is busy with another one.
        """
        idle, task, outer = self._idle, self._task, asyncio.current_task()
        resume, idle.resume = idle.resume, None
        if resume is None or task is None or idle.context is None:
            work.close()
            raise RuntimeError("the task is running")
        event_loop = task.get_loop()
        # As asyncio's documentation of custom tasks describes: tell it which task is running.
        if outer is not None:
            _leave_task(event_loop, outer)
        try:
            _enter_task(event_loop, task)
            try:
                # Run the first step, until the coroutine waits, in the task's own context, for
                # its context variables.
                waits_for = idle.context.run(work.send, None)
            except BaseException as error:
                # Done, or failed at once: the task stays idle.
                idle.resume = resume
                if isinstance(error, StopIteration):
                    return True
                raise
            finally:
                _leave_task(event_loop, task)
            # The task wakes up in `carry_on`, only to wait for the same object as the coroutine.
            self._begun = work, waits_for
            idle.context.run(resume, idle)
            return False
        finally:
            if outer is not None:
                _enter_task(event_loop, outer)

    async def carry_on(self) -> None:
        """Wait until `start` has left an unfinished coroutine, and finish it."""
        self._check_expired()
        self.end()
        self._task = asyncio.current_task()
        await self._idle
        if self._begun is not None:
            (work, waits_for), self._begun = self._begun, None
            await _rest(work, waits_for)
            self._check_expired()

    def _check_expired(self) -> None:
        """Raise `TimeoutError` if work was interrupted but ended without raising it."""
        # Leave the guard, since a timeout acts only once.
        if self._timeout is not None and self._timeout.expired():
            raise TimeoutError

    # --- deadlines ---------------------------------------------------------------------------

    @property
    def late(self) -> bool:
        """Whether the deadline of the present work passed long ago: `check` had no chance.

        Work is also late if the computer was suspended meanwhile, which no deadline counts.
        """
        if self._until == math.inf:
            return False
        over, asleep = self._now() - self._until, monotonic.suspended() - self._suspended
        return max(over, asleep) >= _LATE

    @asynccontextmanager
    async def guard(self) -> AsyncIterator[None]:
        """Enforce the deadlines on the task's code: raises `TimeoutError` when one has passed."""
        try:
            async with asyncio.timeout(None) as self._timeout:
                yield
        finally:
            self._timeout = None

    def begin(self, within: float) -> None:
        """Set the deadline of the present work to ``within`` seconds from now."""
        self._until = self._now() + within
        self._suspended = monotonic.suspended()

    def end(self) -> None:
        """Remove the deadline: the work is done."""
        self._until = math.inf
        timeout = self._timeout
        if timeout is not None and timeout.when() is not None and not timeout.expired():
            timeout.reschedule(None)

    def check(self) -> None:
        """Abandon the present work if its deadline has passed."""
        over = self._now() - self._until
        if over >= 0.0:
            self.interrupt()
        if over >= _ABANDON_AFTER and self._task is not None and not self.idle:
            self._until = self._now()  # again after the same time, if need be
            self.abandon()
            self._task.cancel()

    def interrupt(self, after: float = 0.0) -> None:
        """Abandon the present work unless it ends within ``after`` seconds of event-loop time."""
        timeout = self._timeout
        if not self.idle and timeout is not None and not timeout.expired():
            timeout.reschedule(asyncio.get_running_loop().time() + after)


class _Idle:
    """The future-like object that an idle task awaits.

    Attributes:
        resume: Resumes the task; ``None`` while the task does not wait.
        context: The context in which the task runs.
    """

    # The protocol of asyncio's futures: a task waits for any object that has this attribute.
    _asyncio_future_blocking = False

    def __init__(self) -> None:
        self.resume: Callable[[_Idle], object] | None = None
        self.context: Context | None = None
        self._cancelled: tuple[str, ...] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def __await__(self) -> Generator[_Idle, None, None]:
        # Kept for `cancel`: `asyncio.run` cancels remaining tasks after the loop has stopped.
        self._loop = asyncio.get_running_loop()
        self._asyncio_future_blocking = True
        yield self

    def get_loop(self) -> asyncio.AbstractEventLoop:
        return self._loop or asyncio.get_running_loop()

    def add_done_callback(
        self, resume: Callable[[_Idle], object], *, context: Context | None = None
    ) -> None:
        self.resume, self.context = resume, context

    def cancel(self, msg: str | None = None) -> bool:
        resume, self.resume = self.resume, None
        if resume is None:
            return False
        self._cancelled = () if msg is None else (msg,)
        self.get_loop().call_soon(resume, self, context=self.context)
        return True

    def result(self) -> None:
        if self._cancelled is not None:
            message, self._cancelled = self._cancelled, None
            raise asyncio.CancelledError(*message)


@types.coroutine
def _rest(work: Work, waits_for: object) -> Generator[object, None, None]:
    """Finish a coroutine that was started and is waiting for an object."""
    while True:
        try:
            yield waits_for
        except BaseException as error:
            try:
                waits_for = work.throw(error)
            except StopIteration:
                return
        else:
            yield from work
            return
