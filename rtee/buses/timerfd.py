"""Linux's timerfd: a timer that is a file descriptor, so an event loop can wait for it.

Python has ``os.timerfd_create`` from 3.13 on; for older versions, this calls the C library. See
timerfd_create(2).
"""

from __future__ import annotations

import ctypes
import functools
import os
import struct
import sys
import time

_TFD_TIMER_ABSTIME = 1  # timerfd_settime: the time given is absolute (sys/timerfd.h)
_NANOSECONDS = 1_000_000_000  # per second
_COUNT = struct.Struct("=Q")
_SETTING = struct.Struct("@4l")  # struct itimerspec: seconds and nanoseconds, interval and value


@functools.cache
def libc() -> ctypes.CDLL | None:
    """Return Linux's C library, ``None`` on other systems."""
    return ctypes.CDLL(None, use_errno=True) if sys.platform.startswith("linux") else None


def available() -> bool:
    """Return whether this system has timerfd."""
    return hasattr(libc(), "timerfd_create")


class Timer:
    """A timer on absolute CLOCK_MONOTONIC deadlines.

    Attributes:
        fd: The descriptor, readable after an expiry; -1 once closed.

    Args:
        first_ns: First expiry, CLOCK_MONOTONIC [ns]; ``None`` leaves the timer stopped.
        period_ns: Time between expiries [ns]; 0: only one expiry.

    Raises:
        OSError: if the system has no timerfd or the call fails.
    """

    def __init__(self, first_ns: int | None = None, period_ns: int = 0) -> None:
        self.fd = -1
        library = libc()
        if library is None or not available():
            raise OSError("this system has no timerfd")
        self._library = library
        self.fd = library.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self.fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create failed")
        if first_ns is not None:
            try:
                self.start(first_ns, period_ns)
            except OSError:
                self.close()
                raise

    def start(self, first_ns: int, period_ns: int = 0) -> None:
        """Start or restart the timer; if the first expiry has passed, it expires at once.

        Raises:
            OSError: if the system call fails.
        """
        setting = _SETTING.pack(*divmod(period_ns, _NANOSECONDS), *divmod(first_ns, _NANOSECONDS))
        if self._library.timerfd_settime(self.fd, _TFD_TIMER_ABSTIME, setting, None) != 0:
            raise OSError(ctypes.get_errno(), "timerfd_settime failed")

    def expiries(self) -> int:
        """Return the number of expiries since the last call."""
        try:
            return int(_COUNT.unpack(os.read(self.fd, _COUNT.size))[0])
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close the descriptor; idempotent."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1
