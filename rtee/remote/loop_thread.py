"""The thread in which a hand's loop runs, as other threads reach it."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from rtee.errors import RteeError

T = TypeVar("T")

_ANSWER_WITHIN = 2.0
"""Time to wait for the loop's thread [s]: many ticks, but less than the 5 s that a client waits."""


class LoopThread:
    """Has functions called in the thread that made it; any thread may ask for that."""

    def __init__(self) -> None:
        self._event_loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()

    def call_soon(self, function: Callable[..., object], *arguments: object) -> None:
        """Have a function called; does nothing once the event loop has ended."""
        with contextlib.suppress(RuntimeError):
            self._event_loop.call_soon_threadsafe(function, *arguments)

    def call(self, function: Callable[[], T]) -> T:
        """Have a function called and return what it returns; not from the loop's own thread.

        Raises:
            RteeError: if the loop doesn't answer.
        """
        answer: concurrent.futures.Future[T] = concurrent.futures.Future()

        def call() -> None:
            try:
                answer.set_result(function())
            except Exception as error:
                answer.set_exception(error)

        self.call_soon(call)
        try:
            return answer.result(_ANSWER_WITHIN)
        except concurrent.futures.TimeoutError:
            raise RteeError("the loop does not answer") from None

    def start(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Have something run in the background."""
        self.call_soon(self._start, work)

    def _start(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        task = self._event_loop.create_task(work())
        self._tasks.add(task)  # the event loop itself keeps only a weak reference
        task.add_done_callback(self._tasks.discard)

    async def close(self) -> None:
        """Cancel what runs in the background; called in the loop's thread."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
