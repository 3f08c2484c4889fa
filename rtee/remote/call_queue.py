"""Queues whose threads make calls that must not delay the loop's thread or Zenoh's."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import logging
import queue
import threading
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any, TypeVar

from rtee import monotonic
from rtee.errors import RteeError

log = logging.getLogger(__name__)

LONGEST = 1000
"""Default limit of waiting calls: about one second of a busy hand's messages."""

_CLOSE_WITHIN = 2.0
"""Time for the waiting calls when the queue is closed [s]: a client may have stopped reading."""


class CallQueue:
    """Makes calls in a thread, one after the other.

    If ``most`` calls wait, further ones are dropped; `dropped` counts them.

    An executor with one thread would not limit the waiting calls, and would make a future for each
    call. That costs the caller 11 µs at the median and 20 µs at the 95th percentile; this queue
    costs 7 and 11 µs.
    """

    def __init__(self, name: str, most: int = LONGEST) -> None:
        self.dropped = 0
        self._most = most
        self._waiting: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        # A daemon: a call that waits for a slow client must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, call: Callable[[], object]) -> bool:
        """Queue a call; return whether there was room. Any thread may use this."""
        # Without a lock, so that callers never wait; a few calls beyond the limit do no harm.
        if self._waiting.qsize() >= self._most:
            self.dropped += 1
            return False
        self._waiting.put(call)
        return True

    def _run(self) -> None:
        while (call := self._waiting.get()) is not None:
            try:
                call()
            # A call that fails must not end the thread, which the other calls need.
            except Exception:
                log.exception("%s: work failed", self._thread.name)

    def close(self) -> None:
        """Make the waiting calls, then end the thread; blocks for two seconds at most."""
        self._waiting.put(None)
        self._thread.join(_CLOSE_WITHIN)


class DelayQueue(CallQueue):
    """Makes calls after a delay [s], which slows down clients that wait for answers."""

    def __init__(self, name: str, delay: float, most: int) -> None:
        self._delay = delay
        self._closing = threading.Event()
        super().__init__(name, most)

    def put(self, call: Callable[[], object]) -> bool:
        """Queue a call; return whether there was room. Any thread may use this."""
        return super().put(partial(self._call_at, monotonic.now() + self._delay, call))

    def _call_at(self, due: float, call: Callable[[], object]) -> None:
        # All calls have the same delay, so the first in the queue is always the next one due.
        self._closing.wait(max(0.0, due - monotonic.now()))
        call()

    def close(self) -> None:
        """Make the waiting calls at once, then end the thread; blocks for two seconds at most."""
        self._closing.set()
        super().close()


T = TypeVar("T")

_ANSWER_WITHIN = 2.0
"""Time to wait for the loop's thread [s]: many ticks, yet less than the 5 s that clients wait."""


class LoopThread:
    """Calls functions in the thread of the running event loop, for any other thread."""

    def __init__(self) -> None:
        self._event_loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()

    def call_soon(self, function: Callable[..., object], *arguments: object) -> None:
        """Call a function soon; does nothing once the event loop has ended."""
        with contextlib.suppress(RuntimeError):  # the event loop is closed
            self._event_loop.call_soon_threadsafe(function, *arguments)

    def call(self, function: Callable[[], T]) -> T:
        """Call a function and return its result; must not be used in the loop's own thread.

        Raises `RteeError` if the loop does not answer in time.
        """
        answer: concurrent.futures.Future[T] = concurrent.futures.Future()

        def call() -> None:
            try:
                answer.set_result(function())
            # Raised in the caller's thread; in the event loop it would only be logged.
            except Exception as error:
                answer.set_exception(error)

        self.call_soon(call)
        try:
            return answer.result(_ANSWER_WITHIN)
        except concurrent.futures.TimeoutError:
            raise RteeError("the loop does not answer") from None

    def start(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run a coroutine function in the background."""
        self.call_soon(self._start, work)

    def _start(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        task = self._event_loop.create_task(work())
        self._tasks.add(task)  # the event loop itself keeps only a weak reference
        task.add_done_callback(self._tasks.discard)

    async def close(self) -> None:
        """Cancel the background coroutines; called in the loop's thread."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
