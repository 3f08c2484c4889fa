"""The SoftHand's commands on a bus, with and without an answer."""

from __future__ import annotations

from collections.abc import Coroutine
from functools import lru_cache, partial
from typing import Any

from rtee.buses.retry import answered, heard
from rtee.buses.serial import SerialBus
from rtee.drivers.deadlines import RelaxedDeadline
from rtee.drivers.qb_softhand import codec

_LIST_DEADLINE = 0.4
"""Longest time for the list of parameters, a packet of 700 bytes or more [s]."""


class QbLink(RelaxedDeadline):
    """Talks to one hand; several may share the line.

    Attributes:
        bus: The line.
        device: The hand's number on it.
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
    """

    def __init__(self, bus: SerialBus, device: int, deadline: float, retries: int) -> None:
        self.bus = bus
        self.device = device
        self.deadline = deadline
        self.retries = retries
        self._parser = codec.Parser()

    async def request(self, command: codec.Command, data: bytes = b"") -> bytes:
        """Send a command and return the data of its answer; raises `BusError`."""

        def answers(reply: codec.Frame) -> bool:
            return reply.device == self.device and reply.command == command

        reply: codec.Frame = await self.bus.transact(
            _asking(self.device, command, data),
            self._parser,
            self.deadline,
            self.retries,
            accept=answers,
            encode=codec.Frame.to_bytes,
        )
        return reply.data

    def send(self, command: codec.Command, data: bytes = b"") -> Coroutine[Any, Any, None]:
        """Return a coroutine that sends a command without an answer; it raises `BusError`."""
        return self.bus.send(codec.Frame(self.device, command, data).to_bytes(), self.deadline)

    async def ping(self) -> bool:
        """Return whether the hand answers."""
        # Not by a ping, whose answer equals an adapter's echo.
        return await heard(self.active()) is not None

    async def anybody(self) -> int | None:
        """Return the number of the hand that answers, or ``None``; answers of several collide."""
        found = await heard(self._ping_all())
        return None if found is None else found.device

    async def hears_any(self) -> bool:
        """Return whether any hand answers; a collision of several is an answer, too."""
        return await answered(self._ping_all())

    async def _ping_all(self) -> codec.Frame:
        ping = codec.Frame(codec.BROADCAST, codec.Command.PING).to_bytes()
        # Without `accept`, since any number may answer.
        return await self.bus.transact(
            ping, self._parser, self.deadline, self.retries, encode=codec.Frame.to_bytes
        )

    async def parameters(self) -> dict[int, codec.Parameter]:
        """Return the hand's parameters by index; empty if it does not answer."""
        request = codec.Frame(self.device, codec.Command.GET_PARAM_LIST, b"\x00\x00").to_bytes()
        parser = codec.ListParser(self.device)
        # Only one retry: the whole list is sent again, and defaults are known.
        return await heard(self.bus.transact(request, parser, _LIST_DEADLINE, retries=1)) or {}

    async def active(self) -> int:
        """Return the mask of active motors."""
        mask = await self.request(codec.Command.GET_ACTIVATE)
        return self.bus.decoded(codec.activation, mask)

    async def integers(self, command: codec.Command, least: int) -> tuple[int, ...]:
        """Return the 16-bit values in the answer to a command; raises `BusError`."""
        values = await self.request(command)
        return self.bus.decoded(partial(codec.read_int16, least=least), values)


@lru_cache(64)
def _asking(device: int, command: codec.Command, data: bytes) -> bytes:
    """Return a request, cached: there are few, and some are sent in every cycle."""
    return codec.Frame(device, command, data).to_bytes()
