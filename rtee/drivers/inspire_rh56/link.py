"""Reads and writes the registers of an RH56: by its own frames, or over Modbus."""

from __future__ import annotations

import struct

from rtee.buses.bus import Bus
from rtee.buses.modbus import ModbusBus
from rtee.buses.serial import SerialBus
from rtee.buses.timing import wire_time
from rtee.drivers.deadlines import RelaxedDeadline
from rtee.drivers.inspire_rh56.codec import OVERHEAD, REQUEST, Command, Frame, ReplyParser
from rtee.errors import BusError


class WriteRefused(BusError):
    """The hand did not accept a write."""

    def __init__(self, bus: str, address: int, answer: int) -> None:
        super().__init__(bus, f"the hand refused a write to register {address} ({answer:#04x})")


class _HandLink(RelaxedDeadline):
    """Talks to one hand; several may share a line.

    Args:
        bus: The line.
        hand: The hand's number on the line; over Modbus, its Modbus number.

    Attributes:
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
    """

    def __init__(self, bus: Bus, hand: int, deadline: float, retries: int) -> None:
        self.deadline = deadline
        self.retries = retries
        self._bus: Bus = bus
        self._hand = hand
        self._parser = ReplyParser()


class FrameLink(_HandLink):
    """Reads and writes registers by the hand's own frames on a serial line."""

    _bus: SerialBus

    async def read(self, address: int, size: int) -> bytes:
        """Return ``size`` bytes of registers from ``address`` on; raises `BusError`."""
        return await self._ask(Command.READ, address, bytes([size]), size)

    async def write(self, address: int, data: bytes) -> None:
        """Set registers from ``address`` on.

        Raises `WriteRefused` if the hand did not accept it, and `BusError`.
        """
        answer = await self._ask(Command.WRITE, address, data, 1)
        if answer != b"\x01":
            raise WriteRefused(self._bus.name, address, answer[0])

    async def _ask(self, command: Command, address: int, data: bytes, size: int) -> bytes:
        def answers(reply: Frame) -> bool:
            # The size, too: the block and the angles alone begin at the same address.
            wanted = (self._hand, command, address, size)
            return (reply.hand, reply.command, reply.address, len(reply.data)) == wanted

        request = Frame(self._hand, command, address, data).to_bytes(REQUEST)
        reply: Frame = await self._bus.transact(
            request,
            self._parser,
            self.deadline,
            self.retries,
            accept=answers,
            whom=f"unit {self._hand}",
        )
        return reply.data

    def read_time(self, size: int, turnaround: float) -> float:
        """Return the shortest time to read ``size`` bytes of registers [s].

        Args:
            size: The number of bytes.
            turnaround: Time that the hand needs before it answers [s].
        """
        # Two frames; the request has one byte of data, the number of bytes to read.
        count = 2 * OVERHEAD + 1 + size
        return wire_time(count, self._bus.line.baudrate) + turnaround

    def write_time(self, size: int, turnaround: float) -> float:
        """Return the shortest time to write ``size`` bytes of registers [s]."""
        return self.read_time(size, turnaround)


class ModbusLink(_HandLink):
    """Reads and writes over Modbus; a register holds two bytes of a table, the low byte first."""

    _bus: ModbusBus

    async def read(self, address: int, size: int) -> bytes:
        """Return ``size`` bytes of registers from ``address`` on; raises `BusError`."""
        count = (size + 1) // 2
        values = await self._bus.read(
            self._hand, address, count, deadline=self.deadline, retries=self.retries
        )
        return struct.pack(f"<{count}H", *values)[:size]

    async def write(self, address: int, data: bytes) -> None:
        """Set registers from ``address`` on; raises `BusError`."""
        # A flag has one byte, but a register has two.
        padded = data + bytes(len(data) % 2)
        values = struct.unpack(f"<{len(padded) // 2}H", padded)
        await self._bus.write(
            self._hand, address, values, deadline=self.deadline, retries=self.retries
        )

    def read_time(self, size: int, turnaround: float) -> float:
        """Return the shortest time to read ``size`` bytes of registers [s]."""
        # The PDUs are function, address and count; then function, length and registers.
        return self._bus.exchange_time(5, 2 + size, turnaround=turnaround)

    def write_time(self, size: int, turnaround: float) -> float:
        """Return the shortest time to write ``size`` bytes of registers [s]."""
        return self._bus.exchange_time(6 + size, 5, turnaround=turnaround)


Rh56Link = FrameLink | ModbusLink
"""Either kind of link to a hand."""
