"""The base class of all buses: owners, counters, a trace of the bytes, and opening of the link."""

from __future__ import annotations

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TypeVar

from rtee.buses.parser import CodecError
from rtee.errors import BusBroken, BusClosed, FrameError

L = TypeVar("L")
T = TypeVar("T")

TraceHook = Callable[[str, str, bytes, float], None]
"""Called as ``hook(bus, direction, data, stamp)``; the direction is ``tx`` or ``rx``, the stamp
CLOCK_MONOTONIC [s]."""


@dataclass(slots=True)
class Counters:
    """Counters of a bus since it was made.

    Attributes:
        transactions: Transactions begun.
        retries: Requests sent again.
        timeouts: Attempts without an answer in time.
        checksum_errors: Frames with a wrong checksum or format.
        strays: Bytes or frames received that answer no request.
        bytes_sent: Bytes written.
        bytes_received: Bytes read.
        opened: Number of times the link was opened.
        broken: Number of times an external cause broke the link.
    """

    transactions: int = 0
    retries: int = 0
    timeouts: int = 0
    checksum_errors: int = 0
    strays: int = 0
    bytes_sent: int = 0
    bytes_received: int = 0
    opened: int = 0
    broken: int = 0


class Bus(ABC):
    """A wire that belongs to this process; several devices of the process may share it.

    Only `connect`, which is idempotent, opens the link. When the link breaks, every call raises
    `BusBroken` until `connect` is called again, so a device is always identified again before it is
    used.

    Attributes:
        name: The address as configured.
        counters: The bus's counters.
        trace: Called with all bytes sent and received; ``None`` switches the trace off.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.counters = Counters()
        self.trace: TraceHook | None = None
        self._owners: set[str] = set()
        self._connecting = asyncio.Lock()
        self._connected = False
        self._cause: str = "it was never opened"
        self._on_empty: Callable[[], Awaitable[None]] | None = None

    @property
    def connected(self) -> bool:
        """Whether the link is open."""
        return self._connected

    @property
    def owners(self) -> frozenset[str]:
        """Names of the devices that use the bus."""
        return frozenset(self._owners)

    async def connect(self) -> None:
        """Open the link unless it is open; only this reopens a broken link.

        Raises:
            BusBusy: if another process has the port open.
            BusBroken: if the link cannot be opened.
        """
        async with self._connecting:
            if self._connected:
                return
            await self._open()
            self._connected = True
            self.counters.opened += 1

    async def detach(self, owner: str) -> None:
        """Detach a device; detaching the last one closes the link. Idempotent."""
        if owner not in self._owners:
            return
        self._owners.discard(owner)
        if self._owners:
            return
        # The callback of the pool closes the bus and forgets it; without a pool, close it here.
        if self._on_empty is not None:
            await self._on_empty()
        else:
            await self.close()

    async def close(self) -> None:
        """Close the link; idempotent."""
        async with self._connecting:
            self._cause = ""
            self._connected = False
            await self._close()

    def check(self) -> None:
        """Raise unless the link is open.

        Raises:
            BusClosed: if the bus was closed by `close`.
            BusBroken: if the link broke.
        """
        if self._connected:
            return
        # `close` clears the cause: nothing broke.
        if not self._cause:
            raise BusClosed(self.name, "it is closed")
        raise BusBroken(self.name, f"no link: {self._cause}")

    def decoded(self, read: Callable[[bytes], T], data: bytes) -> T:
        """Return ``read(data)``, the content of a received frame.

        Raises:
            FrameError: if the codec cannot read the bytes.
        """
        try:
            return read(data)
        except CodecError as error:
            raise FrameError(self.name, str(error), data) from error

    def acquire(self, owner: str, on_empty: Callable[[], Awaitable[None]] | None = None) -> None:
        """Add a device as an owner; called by the pool."""
        self._owners.add(owner)
        self._on_empty = on_empty

    def _broke(self, cause: str) -> None:
        if self._connected:
            # Several calls may notice the same break, which counts once.
            self.counters.broken += 1
        self._connected = False
        self._cause = cause or "the other end went away"

    def _count(self, direction: str, data: bytes, stamp: float, head: bytes = b"") -> None:
        """Count and trace bytes; the trace also shows ``head``, such as a CAN identifier."""
        if direction == "tx":
            self.counters.bytes_sent += len(data)
        else:
            self.counters.bytes_received += len(data)
        if self.trace is not None:
            self.trace(self.name, direction, head + data, stamp)

    @abstractmethod
    async def _open(self) -> None:
        """Open the link."""

    @abstractmethod
    async def _close(self) -> None:
        """Close the link, even a broken one; idempotent."""


def listen(listeners: list[L], listener: L) -> Callable[[], None]:
    """Add a listener to a list and return an idempotent function that removes it."""
    listeners.append(listener)

    def remove() -> None:
        with contextlib.suppress(ValueError):
            listeners.remove(listener)

    return remove
