"""A thread that works through what the network's own threads hand on to it."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

log = logging.getLogger(__name__)

T = TypeVar("T")

LONGEST = 1000
"""Things that may wait unless said otherwise."""


class Worker(Generic[T]):
    """Does one thing after the other in a thread of its own.

    Args:
        name: The thread's name.
        work: What is done with each; it must not raise.
        most: Things that may wait; further ones are not taken.
    """

    def __init__(self, name: str, work: Callable[[T], None], most: int = LONGEST) -> None:
        self._work = work
        self._most = most
        self._waiting: queue.SimpleQueue[tuple[T] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T) -> bool:
        """Have something done; return whether it was taken."""
        if self._waiting.qsize() >= self._most:
            return False
        self._waiting.put((item,))
        return True

    def _run(self) -> None:
        while (item := self._waiting.get()) is not None:
            try:
                self._work(item[0])
            except Exception:
                log.exception("%s: work failed", self._thread.name)

    def close(self) -> None:
        """Do what is waiting, then end; waits for that, but not for long."""
        self._waiting.put(None)
        self._thread.join(2.0)
