"""The host's end of a simulated line on simulated time, in the host's event loop.

A pseudo-terminal or a socket would pass bytes on in real time, for which simulated time does not
wait.
"""

from __future__ import annotations

import asyncio
import errno
import itertools
import os
import weakref
from collections.abc import Callable
from typing import Any, Protocol

from rtee.buses.simulated_time import SimulatedTimeLoop

SIMULATED = "simulated"
"""Scheme of the addresses of these ends."""

_NUMBERS = itertools.count()


class _Host(Protocol):
    rate: int

    def receive(self, data: bytes) -> None: ...

    def lose(self) -> None: ...


class DirectEnd:
    """A stand-in for a pseudo-terminal or a TCP port, for one host at a time.

    Attributes:
        address: Its address for `rtee.buses.link.open_link`.
        open: Whether the host can find it.

    Args:
        loop: The event loop of the host.
        take: Called with the bytes that the host sends.
        cut: Called when another host connects, to discard bytes for the previous one; ``None``: the
            end stands for a tty, not for a TCP port.
    """

    def __init__(
        self,
        loop: SimulatedTimeLoop,
        take: Callable[[bytes], None],
        cut: Callable[[], None] | None = None,
    ) -> None:
        self.address = f"{SIMULATED}://{next(_NUMBERS)}"
        self.loop = loop
        self.open = False
        self._take = take
        self._cut = cut
        self._network = cut is not None
        self._host: _Host | None = None
        _ENDS[self.address] = self

    @property
    def heard(self) -> bool:
        """Whether a host is connected."""
        return self._host is not None

    def plug(self) -> None:
        """Create the port."""
        self.open = True

    def unplug(self) -> None:
        """Remove the port."""
        self.open = False
        host, self._host = self._host, None
        if host is not None:
            host.lose()

    def dispose(self) -> None:
        """Forget its address."""
        _ENDS.pop(self.address, None)

    def write(self, data: bytes) -> None:
        """Send bytes to the host, if there is one."""
        if self._host is not None:
            self._host.receive(data)

    def rate(self) -> int | None:
        """Return the bit rate that the host has set [bit/s], ``None`` if there is none."""
        return None if self._network or self._host is None else self._host.rate

    def connect(
        self, protocol: asyncio.Protocol, rate: int
    ) -> tuple[asyncio.Transport, asyncio.Protocol]:
        """Connect a host at a bit rate [bit/s]; raises `OSError` as a port or a socket does."""
        transport = _Transport(self, protocol, rate)
        self.join(transport)
        self.loop.call_soon(protocol.connection_made, transport)
        return transport, protocol

    def join(self, host: _Host) -> None:
        """Connect a host; raises `OSError` if there is no port or it is taken."""
        if not self.open:
            raise _os_error(errno.ECONNREFUSED if self._network else errno.ENOENT)
        if self._host is not None:
            raise _os_error(errno.ECONNREFUSED if self._network else errno.EBUSY)
        self._host = host
        if self._cut is not None:
            self._cut()

    def leave(self, host: _Host) -> None:
        """Disconnect a host; idempotent."""
        if self._host is host:
            self._host = None

    def send(self, host: _Host, data: bytes) -> None:
        """Take bytes from a host; drop them if it has left."""
        if self._host is host:
            self._take(data)


_ENDS: weakref.WeakValueDictionary[str, DirectEnd] = weakref.WeakValueDictionary()


def simulated_end(address: str) -> DirectEnd:
    """Return the end that has an address; raises `OSError` if there is none."""
    end = _ENDS.get(address)
    if end is None:
        raise _os_error(errno.ENOENT)
    return end


def _os_error(number: int) -> OSError:
    return OSError(number, os.strerror(number))


class _Transport(asyncio.Transport):
    """The host's side for asyncio."""

    def __init__(self, end: DirectEnd, protocol: asyncio.Protocol, rate: int) -> None:
        super().__init__()
        self.rate = rate
        self._end = end
        self._protocol = protocol
        self._closing = False

    def receive(self, data: bytes) -> None:
        self._protocol.data_received(data)

    def lose(self) -> None:
        self._finish(OSError("the port vanished"))

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        if not self._closing:
            self._end.send(self, bytes(data))

    def close(self) -> None:
        self._finish(None)

    def abort(self) -> None:
        self._finish(None)

    def is_closing(self) -> bool:
        return self._closing

    def _finish(self, error: Exception | None) -> None:
        if not self._closing:
            self._closing = True
            self._end.leave(self)
            self._end.loop.call_soon(self._protocol.connection_lost, error)


class DirectPort:
    """The host's side for a blocking library in a worker thread, as a port of pyserial.

    Attributes:
        timeout: Longest time for which `read` waits for its first byte [s].

    Raises:
        OSError: if there is no such port, or another program has it open.
    """

    def __init__(self, address: str, rate: int) -> None:
        self.rate = rate
        self.timeout = 0.0
        self._received = bytearray()
        self._lost = False
        self._end = simulated_end(address)
        self._end.join(self)

    @property
    def in_waiting(self) -> int:
        """Number of bytes received."""
        return len(self._received)

    def read(self, count: int) -> bytes:
        """Return at most ``count`` bytes; raises `OSError` if the port is gone."""
        if not self._received and self.timeout > 0.0:
            self._end.loop.wait(lambda: bool(self._received) or self._lost, self.timeout)
        self._check()
        data = bytes(self._received[:count])
        del self._received[:count]
        return data

    def write(self, data: bytes) -> int:
        """Send bytes; raises `OSError` if the port is gone."""
        self._check()
        self._end.loop.call_soon_threadsafe(self._end.send, self, data)
        return len(data)

    def reset_input_buffer(self) -> None:
        """Discard the bytes received."""
        self._received.clear()

    def close(self) -> None:
        """Close the port; idempotent."""
        self._end.leave(self)

    def receive(self, data: bytes) -> None:
        """Receive bytes from the line; in the loop's thread."""
        self._received += data

    def lose(self) -> None:
        """Mark the port as unplugged."""
        self._lost = True

    def _check(self) -> None:
        if self._lost:
            raise _os_error(errno.EIO)
