"""The connection of a driver to its device, from `configure` to `close`."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Generic, TypeVar

from rtee.buses.bus import Bus
from rtee.errors import NotConnected
from rtee.types import DeviceSpec

B = TypeVar("B", bound=Bus)
L = TypeVar("L")


def owner_of(spec: DeviceSpec) -> str:
    """Return the name under which a device owns its bus, unique among all hands of a process."""
    return f"{spec.hand}/{spec.name}"


class Connection(Generic[L]):
    """The bus of a device while its driver is connected, and the link that uses the bus.

    A driver opens it in `configure`, by `Driver.open`, and uses `Driver.link` everywhere else.

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
