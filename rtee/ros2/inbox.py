"""What Zenoh's threads hand over to the event loop: bounded, and never waiting."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Complaints:
    """Says what is wrong with what others send: each thing once, however often it comes.

    Args:
        log: Where to.

    Attributes:
        count: What was dropped since the beginning, by what was wrong.
    """

    MOST = 200
    """Different complaints that are told and counted: others send what they like."""

    def __init__(self, log: logging.Logger) -> None:
        self.count: dict[str, int] = {}
        self._log = log
        self._lock = threading.Lock()

    def tell(self, what: str, detail: str = "") -> None:
        """Tell of something that was dropped, once; any thread may call this.

        Args:
            what: What was dropped and why: of few different texts.
            detail: What more there is to say the first time.
        """
        with self._lock:
            told = self.count.get(what, 0)
            if told or len(self.count) < self.MOST:
                self.count[what] = told + 1
            else:
                return
        # Outside the lock, for which Zenoh's threads wait: a log handler may block.
        if not told:
            self._log.warning(
                "%s%s; further ones are not told", what, f": {detail}" if detail else ""
            )


class Limit:
    """Lets through so many things a second; any thread may ask.

    Args:
        rate: How many, in each second of its own.
    """

    def __init__(self, rate: int) -> None:
        self._rate, self._left, self._until = rate, rate, 0.0
        self._lock = threading.Lock()

    def passes(self) -> bool:
        """Return whether one more may pass."""
        with self._lock:
            now = time.monotonic()
            if now >= self._until:
                self._left, self._until = self._rate, now + 1.0
            self._left -= 1
            return self._left >= 0


class Inbox(Generic[T]):
    """Things that a thread of Zenoh hands over to a function in the event loop.

    To be made in the event loop's thread.

    Args:
        take: Called in the event loop with each thing; it must return soon.
        depth: How many may wait.
        keep_newest: Whether the oldest is dropped when there are more, otherwise the new one.
        dropped: Called in Zenoh's thread for each that is dropped.
    """

    _BATCH = 50
    """Things taken before other work of the event loop has its turn."""

    def __init__(
        self,
        take: Callable[[T], object],
        depth: int,
        *,
        keep_newest: bool = True,
        dropped: Callable[[], object] | None = None,
    ) -> None:
        self._take, self._depth, self._keep_newest = take, max(depth, 1), keep_newest
        self._dropped = dropped
        self._waiting: deque[T] = deque()
        self._lock = threading.Lock()
        self._due = False
        self._loop = asyncio.get_running_loop()
        self._closed = False

    def put(self, thing: T) -> None:
        """Hand something over; called in a thread of Zenoh."""
        with self._lock:
            if self._closed:
                return
            full = len(self._waiting) >= self._depth
            if full and self._keep_newest:
                self._waiting.popleft()
            if not full or self._keep_newest:
                self._waiting.append(thing)
            # One wake-up for all that wait: one for each would flood the event loop.
            wake, self._due = not self._due, True
        # Outside the lock, for which the event loop waits: this may log.
        if full and self._dropped is not None:
            self._dropped()
        if wake:
            try:
                self._loop.call_soon_threadsafe(self._run)
            except RuntimeError:  # the event loop is closed
                self._closed = True

    def _run(self) -> None:
        for _ in range(self._BATCH):
            with self._lock:
                if not self._waiting or self._closed:
                    # Under the lock: a thing that is put at this moment either is seen above or
                    # wakes the loop again.
                    self._due = False
                    return
                thing = self._waiting.popleft()
            self._take(thing)
        self._loop.call_soon(self._run)

    def close(self) -> None:
        """Take nothing more; what waits is dropped."""
        with self._lock:
            self._closed = True
            self._waiting.clear()
