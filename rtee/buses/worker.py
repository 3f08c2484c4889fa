"""One worker thread for a blocking library: one call at a time, each with a deadline."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from rtee.buses.timing import ask_for_short_slices, wake_exactly

T = TypeVar("T")

_Call = tuple[Callable[[], Any], asyncio.AbstractEventLoop, "asyncio.Future[Any]"]


class Worker:
    """A thread that calls blocking functions one after the other.

    A call that misses its deadline keeps the thread until it returns; its result is dropped, and
    the next call waits. So two calls never use the library at the same time.

    The event loop's executor would do the same, but needs twice as many turns of the loop to pass a
    result on, and this happens in every cycle.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._calls: queue.SimpleQueue[_Call | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    async def run(self, function: Callable[[], T], deadline: float) -> T:
        """Call a function in the thread and return its result.

        Raises:
            TimeoutError: if it has not returned within ``deadline`` [s].
        """
        loop = asyncio.get_running_loop()
        result: asyncio.Future[T] = loop.create_future()
        self._calls.put((function, loop, result))
        if self._thread is None:
            self._thread = threading.Thread(
                target=_serve, args=(self._calls,), name=self._name, daemon=True
            )
            self._thread.start()
        timer = loop.call_later(deadline, _settle, result, None, TimeoutError())
        try:
            return await result
        finally:
            timer.cancel()

    async def close(self) -> None:
        """Wait for the call under way and end the thread; idempotent."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        # A new queue: a thread that still hangs in a call must not take calls of the next one.
        calls, self._calls = self._calls, queue.SimpleQueue()
        with contextlib.suppress(queue.Empty):
            while call := calls.get_nowait():
                call[2].cancel()
        calls.put(None)
        ending = asyncio.get_running_loop().run_in_executor(None, thread.join)
        await asyncio.shield(ending)


def _serve(calls: queue.SimpleQueue[_Call | None]) -> None:
    wake_exactly()
    ask_for_short_slices()
    while (call := calls.get()) is not None:
        function, loop, future = call
        result, error = None, None
        try:
            result = function()
        # Whatever it is, it belongs to the caller: the thread has to go on.
        except BaseException as raised:
            error = raised
        with contextlib.suppress(RuntimeError):  # the event loop may be gone
            loop.call_soon_threadsafe(_settle, future, result, error)
        del call, function, future, result, error  # what it holds must not outlive it here


def _settle(future: asyncio.Future[Any], result: object, error: BaseException | None) -> None:
    if future.done():
        return
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)
