"""The loop as a systemd service: report the state, and feed the watchdog from the loop's ticks.

The protocol is that of sd_notify(3): datagrams of ``NAME=value`` lines to the socket named by
``NOTIFY_SOCKET``.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import dataclass
from typing import Self

from rtee.loop.observer import Observer
from rtee.sample import TickRecord
from rtee.types import DeviceStatus, LoopStatistics

FEEDS = 10
"""Feeds per watchdog timeout: a loop that hangs is detected after 90 % to 100 % of it."""

MAX_STATUS = 1000
"""Longest status line [characters]: it must fit into one datagram."""


class ServiceReporter:
    """Reports the state of this process's hands to the service manager.

    It has no thread or timer: the hands' ticks send its messages, so that a loop that hangs stops
    feeding the watchdog. With several hands, each must have ticked since the last feed.
    A message that the manager does not accept at once is dropped, and sent again at a later tick.

    Args:
        address: The manager's socket: a path, or a name in the abstract namespace after ``@``.
        watchdog: Watchdog timeout of the manager [s]; 0: none.
    """

    def __init__(self, address: str, watchdog: float = 0.0) -> None:
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)  # the loop must not wait for the manager
        self._every = watchdog / FEEDS
        self._hands: dict[str, str] = {}
        self._waits_for: set[str] = set()
        self._ready = False
        self._stopping = False
        self._due = 0.0
        self._status_sent = ""

    @classmethod
    def of(cls, environ: MutableMapping[str, str] = os.environ) -> Self | None:
        """Return the service that the environment describes; ``None`` outside a service.

        Removes the variables, since programs started by this process are not the service.
        """
        address = environ.pop("NOTIFY_SOCKET", "")
        timeout = environ.pop("WATCHDOG_USEC", "")
        process = environ.pop("WATCHDOG_PID", "")
        if not address.startswith(("/", "@")):
            return None
        watched = timeout.isdecimal() and process in ("", str(os.getpid()))
        return cls(address, int(timeout) * 1e-6 if watched else 0.0)

    def watch(self, name: str) -> Observer:
        """Return an observer for a hand; add it after all others.

        A tick counts only once all other work of the tick is done.
        """
        self._hands[name] = "connecting"
        self._waits_for.add(name)
        return _WatchedHand(name, self._ticked, self._describe)

    def stopping(self) -> None:
        """Report that the hands are coming to rest; from now on the watchdog is not fed."""
        self._stopping = True
        self._send("STOPPING=1", f"STATUS={self._status_sent}")

    def __enter__(self) -> Self:
        """Return the service."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the socket."""
        self._socket.close()

    def _ticked(self, name: str, stamp: float) -> None:
        self._waits_for.discard(name)
        if self._waits_for or self._stopping or (self._ready and stamp < self._due):
            return
        lines = ["WATCHDOG=1"] if self._every else []
        if not self._ready:
            lines += ["READY=1", f"STATUS={self._status()}"]
        if not lines or self._send(*lines):
            self._ready = True
            self._due = stamp + self._every
            self._waits_for.update(self._hands)

    def _describe(self, name: str, statuses: Sequence[DeviceStatus]) -> None:
        self._hands[name] = ", ".join(f"{each.name} {each.lifecycle}" for each in statuses)
        text = self._status()
        if self._ready and text != self._status_sent and self._send(f"STATUS={text}"):
            self._status_sent = text

    def _status(self) -> str:
        text = "; ".join(f"{name}: {state}" for name, state in self._hands.items())
        return " ".join(text.split())[:MAX_STATUS]

    def _send(self, *lines: str) -> bool:
        with contextlib.suppress(OSError):
            self._socket.sendto("\n".join(lines).encode(), self._address)
            return True
        return False


@dataclass(eq=False)  # observers are compared by identity
class _WatchedHand(Observer):
    name: str
    ticked: Callable[[str, float], None]
    describe: Callable[[str, Sequence[DeviceStatus]], None]

    def on_tick(self, record: TickRecord) -> None:
        self.ticked(self.name, record.stamp)

    def on_status(self, statuses: Sequence[DeviceStatus], statistics: LoopStatistics) -> None:
        self.describe(self.name, statuses)
