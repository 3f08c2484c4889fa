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

_BOOT_TIME: int | None = getattr(time, "CLOCK_BOOTTIME", None)
"""The clock that also counts while the computer is suspended; only Linux has it."""
if _BOOT_TIME is not None:
    try:
        time.clock_gettime(_BOOT_TIME)
    except OSError:  # some sandboxes know it by name only
        _BOOT_TIME = None


def _suspended() -> float:
    """Return the time for which the computer has been suspended, from an unknown beginning [s].

    That time is missing from `now`. 0 where no clock counts it.
    """
    if _BOOT_TIME is None:
        return 0.0
    return time.clock_gettime(_BOOT_TIME) - time.clock_gettime(time.CLOCK_MONOTONIC)


suspended: Callable[[], float] = _suspended
"""See `_suspended`; replaced on simulated time."""

sleep: Callable[[float], None] = time.sleep
"""Block a worker thread for some time [s]."""


def asked() -> float:
    """Return the time [s]; unlike `now`, this function may be kept as a reference."""
    return now()
