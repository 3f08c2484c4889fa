"""Waiting for less than a millisecond in the event loop, and the time that bytes take on a wire."""

from __future__ import annotations

import asyncio
import ctypes
import os
import platform
import struct
import sys
import time
from collections.abc import Callable

_TFD_NONBLOCK = os.O_NONBLOCK
_TFD_CLOEXEC = getattr(os, "O_CLOEXEC", 0)
_PR_SET_TIMERSLACK = 29
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
_libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None

SLICE = 100_000
"""Processor time that a prompt thread asks for at a time, the shortest that Linux gives [ns]."""


def wire_time(count: int, baudrate: float | None, bits: float = 10.0) -> float:
    """Return how long ``count`` bytes take on a line [s]; 0 where there is no baud rate."""
    return count * bits / baudrate if baudrate else 0.0


def silence(baudrate: float | None, bits: float = 11.0) -> float:
    """Return the silence that ends a Modbus RTU frame [s]: 3.5 characters, at least 1.75 ms."""
    if not baudrate:
        return 0.0
    return max(0.00175, 3.5 * bits / baudrate)


def wake_exactly() -> None:
    """Have the calling thread's timers go off at their time, not up to 50 µs later (Linux)."""
    if _libc is not None:
        _libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)


def ask_for_short_slices() -> bool:
    """Have the calling thread woken promptly though it is an ordinary one.

    Linux 6.12 and later (EEVDF) let a thread that asks for little processor time at a time go
    before others that have had more than their share; see sched_setattr(2), ``sched_runtime``.

    Returns:
        Whether the system took it; older kernels take it too, and make nothing of it.
    """
    number = _SCHED_SETATTR.get(platform.machine())
    if number is None or _libc is None:
        return False
    attributes = struct.pack("=IIQiIQQQ", 48, os.SCHED_OTHER, 0, os.nice(0), 0, SLICE, 0, 0)
    return bool(_libc.syscall(number, 0, attributes, 0) == 0)


class Pause:
    """Waits in the event loop with the precision of a timerfd; asyncio itself rounds up to 1 ms.

    One wait at a time. Elsewhere than on Linux it is the event loop's own timer.
    """

    def __init__(self) -> None:
        self._fd = -1
        self._callback: Callable[[], None] | None = None
        self._timer: asyncio.TimerHandle | None = None

    async def until(self, when: float) -> None:
        """Return at ``when`` on CLOCK_MONOTONIC [s], or at once if that has passed."""
        if when <= time.monotonic():
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
        left = max(when - time.monotonic(), 1e-9)
        self._callback = callback
        if _libc is None:
            self._timer = loop.call_later(left, self._call)
            return
        if self._fd < 0:
            self._fd = _libc.timerfd_create(time.CLOCK_MONOTONIC, _TFD_NONBLOCK | _TFD_CLOEXEC)
            if self._fd < 0:
                raise OSError(ctypes.get_errno(), "timerfd_create failed")
        seconds = int(left)
        setting = struct.pack("@qqqq", 0, 0, seconds, max(1, int((left - seconds) * 1e9)))
        if _libc.timerfd_settime(self._fd, 0, setting, None) != 0:
            raise OSError(ctypes.get_errno(), "timerfd_settime failed")
        loop.add_reader(self._fd, self._ready)

    def cancel(self) -> None:
        """Call nothing; idempotent."""
        self._callback = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._fd >= 0:
            asyncio.get_running_loop().remove_reader(self._fd)

    def _ready(self) -> None:
        try:
            os.read(self._fd, 8)
        except BlockingIOError:
            return  # armed anew meanwhile
        self._call()

    def _call(self) -> None:
        callback = self._callback
        self.cancel()
        if callback is not None:
            callback()

    def close(self) -> None:
        """Give the timer back; idempotent, and it may be used again afterwards."""
        if self._fd >= 0:
            self.cancel()
            os.close(self._fd)
            self._fd = -1
