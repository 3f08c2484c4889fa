"""One worker thread for a blocking library: one call at a time, each with a deadline."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from rtee.buses.simulated_time import SimulatedTimeLoop
from rtee.buses.timing import ask_for_short_slices, wake_exactly

T = TypeVar("T")


class _QueuedCall(NamedTuple):
    function: Callable[[], Any]
    loop: asyncio.AbstractEventLoop
    result: asyncio.Future[Any]


class Worker:
    """A thread that calls blocking functions one after the other.

    A call that misses its deadline occupies the thread until it returns; its result is discarded,
    and the next call waits. So two calls never use the library at the same time.

    The event loop's own executor is not used: it needs twice as many iterations of the loop to pass
    on a result, in every cycle.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._thread: _Thread | None = None

    async def run(self, function: Callable[[], T], deadline: float) -> T:
        """Call a function in the thread and return its result.

        Raises:
            TimeoutError: if it has not returned within ``deadline`` [s].
        """
        loop = asyncio.get_running_loop()
        if self._thread is None:
            self._thread = _Thread(self._name)
        result: asyncio.Future[T] = self._thread.put(function, loop)
        timer = loop.call_later(deadline, _settle, result, None, TimeoutError())
        try:
            return await result
        finally:
            timer.cancel()

    async def close(self) -> None:
        """Wait for the running call and end the thread; idempotent."""
        # Another thread serves later calls, since this one may still hang in a call.
        thread, self._thread = self._thread, None
        if thread is not None:
            loop = asyncio.get_running_loop()
            await asyncio.shield(thread.end(loop))
            await asyncio.shield(loop.run_in_executor(None, thread.join))


class _Thread:
    """The thread and its queue of calls."""

    def __init__(self, name: str) -> None:
        self._calls: queue.SimpleQueue[_QueuedCall | None] = queue.SimpleQueue()
        self._pending = 0
        thread = threading.Thread(target=self._serve, name=name, daemon=True)
        self.join = thread.join
        thread.start()

    def put(self, function: Callable[[], T], loop: asyncio.AbstractEventLoop) -> asyncio.Future[T]:
        """Queue a function behind all others; return the future of its result."""
        result: asyncio.Future[T] = loop.create_future()
        # Simulated time stops for the thread, not for every call: a second call waits for the
        # first, which may itself be waiting for time to pass.
        if not self._pending and isinstance(loop, SimulatedTimeLoop):
            loop.work_begins()
        self._pending += 1
        self._calls.put(_QueuedCall(function, loop, result))
        return result

    def end(self, loop: asyncio.AbstractEventLoop) -> asyncio.Future[None]:
        """Drop the waiting calls and end after the running one; return a future of the end."""
        with contextlib.suppress(queue.Empty):
            while call := self._calls.get_nowait():
                call.result.cancel()
                self._done(call, None, None)
        ended = self.put(lambda: None, loop)
        self._calls.put(None)
        return ended

    def _serve(self) -> None:
        wake_exactly()
        ask_for_short_slices()
        while (call := self._calls.get()) is not None:
            result, error = None, None
            try:
                result = call.function()
            except BaseException as raised:  # any error goes to the caller; the thread continues
                error = raised
            with contextlib.suppress(RuntimeError):  # the event loop may be gone
                call.loop.call_soon_threadsafe(self._done, call, result, error)
            del call, result, error  # release their objects before the next wait

    def _done(self, call: _QueuedCall, result: object, error: BaseException | None) -> None:
        _settle(call.result, result, error)
        self._pending -= 1
        if not self._pending and isinstance(call.loop, SimulatedTimeLoop):
            call.loop.work_ends()


def _settle(future: asyncio.Future[Any], result: object, error: BaseException | None) -> None:
    if future.done():
        return
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)
