"""The time on CLOCK_MONOTONIC: the only place where rtee reads this clock.

Call ``monotonic.now()``, and keep no reference to the function: while an event loop on simulated
time runs (`rtee.buses.simulated_time`), these functions are those of that loop. A call costs no
more than one of the system.
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
    """Return `now`, for callers that keep a reference to the function."""
    return now()
