"""Linux's timerfd: a timer that is a file descriptor, so an event loop can wait for it.

Python has it as ``os.timerfd_create`` from 3.13 on; before, it is called in the C library. See
timerfd_create(2).
"""

from __future__ import annotations

import ctypes
import functools
import os
import struct
import sys

_CLOCK_MONOTONIC = 1
_TFD_TIMER_ABSTIME = 1
_NANOSECONDS = 1_000_000_000
_COUNT = struct.Struct("=Q")


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("interval", _Timespec), ("value", _Timespec))


@functools.cache
def _library() -> ctypes.CDLL | None:
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None, use_errno=True)
    return library if hasattr(library, "timerfd_create") else None


def available() -> bool:
    """Return whether this system has timerfd."""
    return _library() is not None


def _timespec(nanoseconds: int) -> _Timespec:
    seconds, rest = divmod(nanoseconds, _NANOSECONDS)
    return _Timespec(seconds, rest)


class PeriodicTimer:
    """A timer on absolute CLOCK_MONOTONIC deadlines.

    Args:
        first_ns: First expiry, CLOCK_MONOTONIC [ns].
        period_ns: Time between expiries [ns].

    Raises:
        OSError: if the system refuses.
    """

    def __init__(self, first_ns: int, period_ns: int) -> None:
        library = _library()
        if library is None:
            raise OSError("this system has no timerfd")
        flags = os.O_NONBLOCK | os.O_CLOEXEC
        self.fd: int = library.timerfd_create(_CLOCK_MONOTONIC, flags)
        if self.fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create failed")
        setting = _Itimerspec(_timespec(period_ns), _timespec(first_ns))
        if library.timerfd_settime(self.fd, _TFD_TIMER_ABSTIME, ctypes.byref(setting), None) != 0:
            error = ctypes.get_errno()
            self.close()
            raise OSError(error, "timerfd_settime failed")

    def expiries(self) -> int:
        """Return how often it expired since the last call, 0 if it didn't."""
        try:
            return int(_COUNT.unpack(os.read(self.fd, 8))[0])
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Give the descriptor back; idempotent."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1
