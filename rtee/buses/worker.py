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

    A call that misses its deadline occupies the thread until it returns; its result is discarded,
    and the next call waits. So two calls never use the library at the same time.

    The executor of the event loop would need twice as many iterations of the loop to pass on a
    result, which happens in every cycle.
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
        """Wait for the running call and end the thread; idempotent."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        # A new queue, since a thread that still hangs in a call must not serve later calls.
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
        except BaseException as raised:  # any error goes to the caller, and the thread continues
            error = raised
        with contextlib.suppress(RuntimeError):  # the event loop may be gone
            loop.call_soon_threadsafe(_settle, future, result, error)
        del call, function, future, result, error  # release their objects before the next wait


def _settle(future: asyncio.Future[Any], result: object, error: BaseException | None) -> None:
    if future.done():
        return
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)
