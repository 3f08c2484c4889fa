"""One worker thread for a blocking library: one call at a time, each with a deadline."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


class Worker:
    """A thread that calls blocking functions one after the other.

    A call that misses its deadline keeps the thread until it returns; what it returns is thrown
    away, and the next call waits for it. So two calls never touch the library at once.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._pool: ThreadPoolExecutor | None = None

    async def run(self, function: Callable[[], T], deadline: float) -> T:
        """Call a function in the thread and return its result.

        Raises:
            TimeoutError: if it has not returned within ``deadline`` [s].
        """
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix=self._name)
        call = asyncio.get_running_loop().run_in_executor(self._pool, function)
        try:
            async with asyncio.timeout(deadline):
                return await asyncio.shield(call)
        finally:
            if not call.done():
                call.add_done_callback(_forget)

    async def close(self) -> None:
        """Wait for the call under way and end the thread; idempotent."""
        pool, self._pool = self._pool, None
        if pool is not None:
            ending = asyncio.get_running_loop().run_in_executor(
                None, lambda: pool.shutdown(wait=True, cancel_futures=True)
            )
            await asyncio.shield(ending)


def _forget(call: asyncio.Future[T]) -> None:
    if not call.cancelled():
        call.exception()
