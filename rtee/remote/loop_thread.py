"""Calls from other threads to the thread of a hand's loop."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from rtee.errors import RteeError

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
