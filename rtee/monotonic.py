"""The time on CLOCK_MONOTONIC; no other module of rtee reads this clock.

Call ``monotonic.now()``, and keep no reference to the function: while an event loop on simulated
time runs (`rtee.buses.simulated_time`), these functions are those of that loop. A call costs no
more than a direct call of the system's function.
"""

from __future__ import annotations

import time
from collections.abc import Callable

now: Callable[[], float] = time.monotonic
"""Return the time [s]."""

now_ns: Callable[[], int] = time.monotonic_ns
"""Return the time [ns]."""


def _suspended() -> float:
    clock = time.clock_gettime
    return clock(time.CLOCK_BOOTTIME) - clock(time.CLOCK_MONOTONIC)


# Only Linux has the second clock, which also counts while the computer is suspended.
suspended: Callable[[], float] = _suspended if hasattr(time, "CLOCK_BOOTTIME") else lambda: 0.0
"""Return the time for which the computer has been suspended, from an unknown beginning [s]; that
time is missing from `now`."""

sleep: Callable[[float], None] = time.sleep
"""Block a worker thread for some time [s]."""


def asked() -> float:
    """Return the time [s]; unlike `now`, this function may be kept as a reference."""
    return now()
