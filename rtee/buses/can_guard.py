"""Adapt python-can: convert its messages, and keep its notifier alive when a bus fails."""

from __future__ import annotations

import errno
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rtee import monotonic
from rtee.buses.emulator import CanFrame
from rtee.buses.timing import ask_for_short_slices, wake_exactly
from rtee.errors import BusBroken

_ENDING = 1e-3
"""Pause of a notifier's thread between two calls of `recv` after `end` [s]."""


def message_of(frame: CanFrame) -> Any:
    """Return a frame as a message of python-can."""
    import can

    return can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        check=False,
    )


def frame_of(message: Any, stamp: float = 0.0) -> CanFrame:
    """Return a message of python-can as a frame; ``stamp`` is CLOCK_MONOTONIC [s]."""
    return CanFrame(
        message.arbitration_id,
        bytes(message.data),
        message.is_extended_id,
        message.is_remote_frame,
        stamp,
    )


_RETURNS = 0.5
"""Longest time until an echoed frame comes back to its sender on the same computer [s]."""
_RETURNING = frozenset({"udp_multicast"})
"""Interfaces of python-can that echo frames to their sender."""


class Unechoed:
    """A python-can bus that drops echoes of its own frames, which no CAN node receives."""

    def __init__(self, bus: Any) -> None:
        self._bus = bus
        self._sent: deque[tuple[float, CanFrame]] = deque()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def send(self, message: Any, timeout: float | None = None) -> None:
        """Send a message; passes on errors of the bus."""
        self._sent.append((monotonic.now(), frame_of(message)))
        self._bus.send(message, timeout)

    def recv(self, timeout: float | None = None) -> Any:
        """Return the next message; ``None`` if none came in time [s], or only its own."""
        message = self._bus.recv(timeout)
        if message is None:
            return None
        now = monotonic.now()
        # A frame lost in transit must not hide a later one of another node.
        while self._sent and now - self._sent[0][0] > _RETURNS:
            self._sent.popleft()
        frame = frame_of(message)
        for i, (_, sent) in enumerate(self._sent):
            if sent == frame:
                del self._sent[i]
                return None
        return message


def open_bus(interface: str, channel: str, bitrate: int | None = None) -> Any:
    """Open a bus of python-can; raises `BusBroken`."""
    import can

    settings: dict[str, Any] = {} if bitrate is None else {"bitrate": bitrate}
    try:
        bus = can.Bus(interface=interface, channel=channel, **settings)
    except (can.CanError, OSError, ValueError) as error:
        raise BusBroken(channel, _reason(error)) from error
    return Unechoed(bus) if interface in _RETURNING else bus


def _reason(error: Exception) -> str:
    """Return the reason why a bus cannot be opened, for the error message."""
    code = getattr(error, "errno", None)
    if code == errno.EAFNOSUPPORT:
        return "this computer's kernel has no SocketCAN"
    if code == errno.ENODEV:
        return "there is no such CAN interface; `ip link` lists them"
    return f"cannot be opened: {error}"


class GuardedCan:
    """A python-can bus whose `recv` never raises: an error would end its notifier's thread."""

    def __init__(self, bus: Any, failed: Callable[[str], None]) -> None:
        self._bus = bus
        self._failed = failed
        self._dead = threading.Event()
        self._ended = False
        self._prompt = self.fileno_or_none() is not None  # without one, the notifier has a thread
        self.channel_info = bus.channel_info

    def fileno(self) -> int:
        """Return its file descriptor; raises `NotImplementedError` if it has none."""
        return int(self._bus.fileno())

    def fileno_or_none(self) -> int | None:
        """Return its file descriptor, or ``None`` if it has none."""
        try:
            return int(self._bus.fileno())
        except NotImplementedError:
            return None

    def end(self) -> None:
        """Make the notifier's thread end now instead of when its wait is over."""
        self._ended = True
        wake(self._bus)

    def recv(self, timeout: float | None = None) -> Any:
        """Return the next message; ``None`` if none came in time [s] or the bus broke."""
        if self._ended:
            # The notifier is stopped right after `end`; until then its thread must not spin.
            time.sleep(_ENDING)
            return None
        if not self._prompt:
            self._prompt = True
            # Here, since this is the first code that runs in the notifier's thread.
            wake_exactly()
            ask_for_short_slices()
        if self._dead.is_set():
            # The notifier calls this in a loop, which would use a whole core without a pause.
            time.sleep(timeout or 0.0)
            return None
        try:
            message = self._bus.recv(timeout)
            return None if self._ended else message
        except Exception as error:
            self._dead.set()
            self._failed(str(error))
            return None

    def send(self, message: Any, timeout: float | None = None) -> None:
        """Send a message; passes on errors of the bus."""
        self._bus.send(message, timeout)

    def shutdown(self) -> None:
        """Close the bus."""
        self._dead.set()
        self._bus.shutdown()


def wake(bus: Any) -> None:
    """End the wait of a thread that receives from a virtual bus, by sending it an error frame."""
    import can

    queue = getattr(bus, "queue", None)
    if queue is not None:
        queue.put(can.Message(is_error_frame=True))
