"""Bounded queue from Zenoh's threads to the event loop, and limits on data from others."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import Counter, deque
from collections.abc import Callable
from typing import Generic, TypeVar

from rtee import monotonic

T = TypeVar("T")


class WarningLog:
    """Logs problems with the messages of others: each problem once, however often it occurs.

    Args:
        log: Logger of the warnings.

    Attributes:
        count: Number of occurrences of each problem.
    """

    MOST = 200
    """Most different problems logged and counted, since others may send anything."""

    def __init__(self, log: logging.Logger) -> None:
        self.count: dict[str, int] = {}
        self._log = log
        self._lock = threading.Lock()

    def tell(self, what: str, detail: str = "") -> None:
        """Count a problem, and log it the first time; may be called from any thread.

        Args:
            what: The problem, one of a small number of texts.
            detail: Details to log with it.
        """
        with self._lock:
            before = self.count.get(what, 0)
            if before or len(self.count) < self.MOST:
                self.count[what] = before + 1
            else:
                return
        # Outside the lock, for which Zenoh's threads wait, since a log handler may block.
        if not before:
            self._log.warning(
                "%s%s; further cases are not logged", what, f": {detail}" if detail else ""
            )


class Limit:
    """Limits the events in each interval of one second; may be called from any thread."""

    def __init__(self, rate: int) -> None:
        self._rate, self._left, self._until = rate, rate, 0.0
        self._lock = threading.Lock()

    def passes(self) -> bool:
        """Count an event and return whether it is within the limit."""
        with self._lock:
            now = monotonic.now()
            if now >= self._until:
                self._left, self._until = self._rate, now + 1.0
            self._left -= 1
            return self._left >= 0


class SharedLimit:
    """Limits the events in each interval of one second, and shares them among their causes.

    Each cause may use at most as much of the limit as is left over: a single cause half of it, two
    causes a third each. However many events one cause has, there is always room for those of
    another. May be called from any thread.
    """

    def __init__(self, rate: int) -> None:
        self._rate, self._left, self._until = rate, rate, 0.0
        self._taken: Counter[bytes] = Counter()
        self._lock = threading.Lock()

    def passes(self, cause: bytes) -> bool:
        """Count an event of a cause and return whether it is within the limit."""
        with self._lock:
            now = monotonic.now()
            if now >= self._until:
                self._left, self._until = self._rate, now + 1.0
                self._taken.clear()
            if self._taken[cause] >= self._left:
                return False
            self._left -= 1
            self._taken[cause] += 1
            return True


class Inbox(Generic[T]):
    """Bounded queue from a thread of Zenoh to a function in the event loop; never blocks.

    Must be made in the event loop's thread.

    Args:
        take: Called in the event loop with each item; must return soon.
        depth: Most items that wait.
        keep_newest: Whether a full queue drops its oldest item, otherwise the new one.
        dropped: Called in Zenoh's thread for each dropped item.
    """

    _BATCH = 50
    """Most items taken before the event loop turns to other work."""

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

    def put(self, item: T) -> None:
        """Append an item; called in a thread of Zenoh."""
        with self._lock:
            if self._closed:
                return
            full = len(self._waiting) >= self._depth
            if full and self._keep_newest:
                self._waiting.popleft()
            if not full or self._keep_newest:
                self._waiting.append(item)
            # One wake-up for all waiting items; one for each would flood the event loop.
            wake, self._due = not self._due, True
        # Outside the lock, for which the event loop waits, since this may log.
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
                    # Under the lock, so that a concurrent `put` wakes the loop again.
                    self._due = False
                    return
                item = self._waiting.popleft()
            self._take(item)
        # `_due` stays set, so that no `put` schedules a second run.
        self._loop.call_soon(self._run)

    def close(self) -> None:
        """Drop the waiting items, and accept no more."""
        with self._lock:
            self._closed = True
            self._waiting.clear()
