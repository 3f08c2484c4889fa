"""The time on CLOCK_MONOTONIC: the one place where rtee's code asks for it.

Ask as ``monotonic.now()``, never by a copy of the function: while an event loop on simulated time
runs (`rtee.buses.simulated_time`), these functions are those of that loop. Asking costs no more
than asking the system.
"""

from __future__ import annotations

import time
from collections.abc import Callable

now: Callable[[], float] = time.monotonic
"""Return the time [s]."""

now_ns: Callable[[], int] = time.monotonic_ns
"""Return the time [ns]."""

sleep: Callable[[float], None] = time.sleep
"""Block a worker thread for some time [s]."""


def asked() -> float:
    """Return `now`; for places that keep the function that they ask."""
    return now()
