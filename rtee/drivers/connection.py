"""The connection of a driver to its device, from `configure` to `close`."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Generic, Protocol, TypeVar

from rtee.buses.bus import Bus
from rtee.errors import NotConnected
from rtee.types import DeviceSpec

B = TypeVar("B", bound=Bus)
L = TypeVar("L")


def owner_of(spec: DeviceSpec) -> str:
    """Return the name under which a device owns its bus, unique among all hands of a process."""
    return f"{spec.hand}/{spec.name}"


class HasDeadline(Protocol):
    """A link whose exchanges have a deadline.

    Attributes:
        deadline: Longest time for one exchange, including retries [s].
    """

    deadline: float


@contextmanager
def longer_deadline(link: HasDeadline, patience: float) -> Iterator[None]:
    """Extend a link's deadline for exchanges outside the cycle, which a busy computer may delay.

    Args:
        link: The link.
        patience: The deadline meanwhile [s], unless the usual one is longer.
    """
    usual, link.deadline = link.deadline, max(link.deadline, patience)
    try:
        yield
    finally:
        link.deadline = usual


class Connection(Generic[L]):
    """The bus of a device while its driver is connected, and the link that uses the bus.

    A driver makes a connection in its constructor, opens it in `configure`, and uses `link`
    everywhere else. `Driver.counters` and `Driver.close` use it, too.

    ``L`` is the type of the link: the bus, or an object that implements the device's protocol.

    Attributes:
        owner: The name under which the device owns its bus.
    """

    def __init__(self, spec: DeviceSpec) -> None:
        self.owner = owner_of(spec)
        self._device = spec.name
        self._bus: Bus | None = None
        self._link: L | None = None

    @property
    def is_open(self) -> bool:
        """Whether `open` was called since the last `close`; the bus may be broken."""
        return self._link is not None

    @property
    def link(self) -> L:
        """The link by which the driver talks to its device.

        Raises:
            NotConnected: if the connection is not open.
        """
        if self._link is None:
            raise NotConnected(self._device, "is not connected")
        return self._link

    async def open(self, opening: Awaitable[B], talk: Callable[[B], L]) -> L:
        """Close an open connection, acquire the bus and return the new link.

        Args:
            opening: Acquires the bus for `owner`: an awaitable from a method of `BusPool`.
            talk: Makes the link from the bus.

        Raises:
            BusError: if the bus cannot be opened.
        """
        # A second `configure` must not leave the driver attached to the first bus.
        await self.close()
        bus = await opening
        self._bus, self._link = bus, talk(bus)
        return self._link

    def counters(self) -> Mapping[str, int]:
        """Return the counters of the bus; empty if the connection is not open."""
        return {} if self._bus is None else self._bus.counters.as_mapping()

    async def close(self) -> None:
        """Detach from the bus; idempotent."""
        # Cleared before waiting: a second call meanwhile must not detach again.
        bus, self._bus, self._link = self._bus, None, None
        if bus is not None:
            await bus.detach(self.owner)
