"""Waiting for less than a millisecond in the event loop, and the time that bytes take on a wire."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import struct
import sys
import time

_TFD_NONBLOCK = os.O_NONBLOCK
_TFD_CLOEXEC = getattr(os, "O_CLOEXEC", 0)
_PR_SET_TIMERSLACK = 29
_libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


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


class Pause:
    """Waits in the event loop with the precision of a timerfd; asyncio itself rounds up to 1 ms.

    One task at a time. Elsewhere than on Linux it is ``asyncio.sleep``.
    """

    def __init__(self) -> None:
        self._fd = -1
        self._waiter: asyncio.Future[None] | None = None

    async def until(self, when: float) -> None:
        """Return at ``when`` on CLOCK_MONOTONIC [s], or at once if that has passed."""
        left = when - time.monotonic()
        if left <= 0.0:
            return
        if _libc is None:
            await asyncio.sleep(left)
            return
        loop = asyncio.get_running_loop()
        if self._fd < 0:
            self._fd = _libc.timerfd_create(time.CLOCK_MONOTONIC, _TFD_NONBLOCK | _TFD_CLOEXEC)
            if self._fd < 0:
                raise OSError(ctypes.get_errno(), "timerfd_create failed")
        seconds = int(left)
        setting = struct.pack("@qqqq", 0, 0, seconds, max(1, int((left - seconds) * 1e9)))
        if _libc.timerfd_settime(self._fd, 0, setting, None) != 0:
            raise OSError(ctypes.get_errno(), "timerfd_settime failed")
        self._waiter = loop.create_future()
        loop.add_reader(self._fd, self._ready)
        try:
            await self._waiter
        finally:
            loop.remove_reader(self._fd)
            self._waiter = None

    def _ready(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._fd, 8)
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    def close(self) -> None:
        """Give the timer back; idempotent, and it may be used again afterwards."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
