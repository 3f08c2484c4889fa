"""A thread that does what must hold up neither the loop's thread nor Zenoh's."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)

LONGEST = 1000
"""Calls that may wait unless said otherwise: about a second's worth of a busy hand's messages."""

_ENDS_WITHIN = 2.0
"""A worker that is closed has this long for what is waiting [s]; a client may have stalled."""


class Worker:
    """Makes one call after the other in a thread of its own.

    An executor of one thread bounds nothing that waits, and makes a future for each call: to hand
    one on takes its caller 11 µs in the median and 20 in the 95th percentile, here 7 and 11.

    Args:
        name: The thread's name.
        most: Calls that may wait; further ones are dropped.

    Attributes:
        dropped: Calls dropped because too many were waiting.
    """

    def __init__(self, name: str, most: int = LONGEST) -> None:
        self.dropped = 0
        self._most = most
        self._waiting: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, call: Callable[[], object]) -> bool:
        """Have a function called; return whether there was room for it. Any thread may."""
        if self._waiting.qsize() >= self._most:
            self.dropped += 1
            return False
        self._waiting.put(call)
        return True

    def _run(self) -> None:
        while (call := self._waiting.get()) is not None:
            try:
                call()
            except Exception:
                log.exception("%s: work failed", self._thread.name)

    def close(self) -> None:
        """Make the calls that are waiting, then end; waits for that, but not for long."""
        self._waiting.put(None)
        self._thread.join(_ENDS_WITHIN)
