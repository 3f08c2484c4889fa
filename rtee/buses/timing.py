"""Wait for less than a millisecond in the event loop, and compute the time of bytes on a wire."""

from __future__ import annotations

import asyncio
import os
import platform
import struct
from collections.abc import Callable

from rtee import monotonic
from rtee.buses import timerfd
from rtee.buses.simulated_time import on_simulated_time

_PR_SET_TIMERSLACK = 29  # linux/prctl.h
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}  # its system call number by machine

SLICE = 100_000
"""Time slice that `ask_for_short_slices` requests [ns]: the shortest that Linux grants."""


def wire_time(count: int, baudrate: float | None, bits: float = 10.0) -> float:
    """Return how long ``count`` bytes take on a line [s]; 0 without a baud rate."""
    return count * bits / baudrate if baudrate else 0.0


def silence(baudrate: float | None, bits: float = 11.0) -> float:
    """Return the silence that ends a Modbus RTU frame [s]: 3.5 characters, at least 1.75 ms."""
    if not baudrate:
        return 0.0
    # 1.75 ms above 19,200 baud (Modbus over serial line 1.02, section 2.5.1.1).
    return max(0.00175, 3.5 * bits / baudrate)


def wake_exactly() -> None:
    """Make the calling thread's timers expire on time, not up to 50 µs later (Linux)."""
    libc = timerfd.libc()
    if libc is not None:
        # 1 ns is the minimum; 0 would restore the default of 50 µs.
        libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)


def ask_for_short_slices() -> bool:
    """Make the scheduler wake the calling thread promptly, without real-time priority.

    The scheduler of Linux 6.12 and later (EEVDF) prefers a thread with a short time slice to others
    that have had more than their share; see sched_setattr(2), ``sched_runtime``.

    Returns:
        Whether the system accepted the setting; older kernels accept it without effect.
    """
    number, libc = _SCHED_SETATTR.get(platform.machine()), timerfd.libc()
    if number is None or libc is None:
        return False
    # struct sched_attr: size, policy, flags, nice, priority, then runtime, deadline and period.
    attributes = struct.pack("=IIQiIQQQ", 48, os.SCHED_OTHER, 0, os.nice(0), 0, SLICE, 0, 0)
    return bool(libc.syscall(number, 0, attributes, 0) == 0)


class Pause:
    """Waits in the event loop with the precision of a timerfd; asyncio itself rounds up to 1 ms.

    One wait at a time. On simulated time, and on other systems than Linux, it uses the event loop's
    timer.
    """

    def __init__(self) -> None:
        self._callback: Callable[[], None] | None = None
        self._timer: timerfd.Timer | None = None
        self._handle: asyncio.TimerHandle | None = None

    async def until(self, when: float) -> None:
        """Wait until ``when`` on CLOCK_MONOTONIC [s]; return at once if that has passed."""
        if when <= monotonic.now():
            return
        waiter = asyncio.get_running_loop().create_future()
        self.start(when, lambda: None if waiter.done() else waiter.set_result(None))
        try:
            await waiter
        finally:
            self.cancel()

    def start(self, when: float, callback: Callable[[], None]) -> None:
        """Call a function from the event loop at ``when`` on CLOCK_MONOTONIC [s]."""
        loop = asyncio.get_running_loop()
        self._callback = callback
        if not timerfd.available() or on_simulated_time():
            self._handle = loop.call_later(max(0.0, when - monotonic.now()), self._call)
            return
        if self._timer is None:
            self._timer = timerfd.Timer()
        self._timer.start(max(1, int(when * 1e9)))  # 0 would stop it
        loop.add_reader(self._timer.fd, self._ready)

    def cancel(self) -> None:
        """Cancel the call; idempotent."""
        self._callback = None
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None
        if self._timer is not None:
            asyncio.get_running_loop().remove_reader(self._timer.fd)

    def _ready(self) -> None:
        if self._timer is not None and self._timer.expiries():  # 0 if it was restarted since
            self._call()

    def _call(self) -> None:
        callback = self._callback
        self.cancel()
        if callback is not None:
            callback()

    def close(self) -> None:
        """Close the timer; idempotent. `start` may be called again afterwards."""
        if self._timer is not None:
            self.cancel()
            self._timer.close()
            self._timer = None
