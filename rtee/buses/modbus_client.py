"""pymodbus's client on a link of ours: it sends when the bus lets it and knows its answer."""

from __future__ import annotations

import asyncio
import struct
from typing import TYPE_CHECKING, Any

from pymodbus.client.base import ModbusBaseClient
from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerRTU, FramerSocket, FramerType
from pymodbus.transport import CommParams, CommType

from rtee.buses.link import SerialTransport
from rtee.buses.modbus_frames import find_answer, find_network_answer

if TYPE_CHECKING:
    from rtee.buses.modbus import ModbusBus

_FOR_EVER = 3600.0


class Client(ModbusBaseClient):
    """pymodbus's client on a link of ours; it neither reconnects nor times out by itself."""

    def __init__(self, bus: ModbusBus) -> None:
        params = CommParams(
            comm_type=CommType.SERIAL if bus.rtu else CommType.TCP,
            comm_name=bus.name,
            reconnect_delay=0.0,
            timeout_connect=_FOR_EVER,
        )
        framer = FramerType.RTU if bus.rtu else FramerType.SOCKET
        super().__init__(framer, 0, params, None, None, None)
        decoder = self.ctx.framer.decoder
        self.ctx.framer = _Framer(self, decoder) if bus.rtu else _NetworkFramer(self, decoder)
        self.link: asyncio.Transport | None = None
        self.wanted: tuple[int, int, bytes] | None = None
        self.expected: tuple[int, int, bytes] | None = None

    def discard(self) -> None:
        """Throw away what the port has received and nobody has read."""
        if isinstance(self.link, SerialTransport):
            self.link.read_now()

    def abandon(self, error: Exception) -> None:
        """End the request that waits, if any."""
        waiting = self.ctx.response_future
        if not waiting.done() and self.ctx.request_dev_id:
            waiting.set_exception(error)
            waiting.exception()


class Sender:
    """What pymodbus takes for its transport: it sends when the bus lets it."""

    def __init__(self, bus: ModbusBus, client: Client) -> None:
        self._bus = bus
        self._client = client

    def write(self, data: bytes) -> None:
        """Hand a request to the bus."""
        self._bus.send(self._client, data)

    def close(self) -> None:
        """The bus closes the link."""

    def abort(self) -> None:
        """The bus closes the link."""


class _Framer(FramerRTU):
    """pymodbus's RTU framer, but one that finds the answer to its request also behind noise."""

    def __init__(self, client: Client, decoder: Any) -> None:
        super().__init__(decoder)
        self._client = client

    def decode(self, data: bytes) -> tuple[int, int, int, bytes]:
        """Return bytes used, unit, 0 and the PDU of the answer that is expected."""
        expected = self._client.expected
        start, end = (-1, -1) if expected is None else find_answer(data, *expected)
        if start < 0:
            return 0, 0, 0, self.EMPTY
        return len(data), data[start], 0, data[start + 1 : end - 2]


class _NetworkFramer(FramerSocket):
    """pymodbus's TCP framer, but one that finds the answer to its request also behind garbage."""

    def __init__(self, client: Client, decoder: Any) -> None:
        super().__init__(decoder)
        self._client = client

    def decode(self, data: bytes) -> tuple[int, int, int, bytes]:
        """Return bytes used, unit, transaction and the PDU of the answer that is expected."""
        expected, transaction = self._client.expected, self._client.ctx.request_transaction_id
        if expected is None:
            return 0, 0, 0, self.EMPTY
        start, end = find_network_answer(data, transaction, *expected)
        if start < 0:
            return 0, 0, 0, self.EMPTY
        return len(data), data[start + 6], transaction, data[start + 7 : end]


class Relay(asyncio.Protocol):
    """Between the link and pymodbus: counts, traces, and keeps bad frames from ending the link."""

    def __init__(self, bus: ModbusBus, client: Client) -> None:
        self._bus = bus
        self._client = client

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Show pymodbus the sender instead of the link."""
        sender: Any = Sender(self._bus, self._client)
        self._client.ctx.connection_made(sender)

    def data_received(self, data: bytes) -> None:
        """Hand on what came, unless nobody waits for it."""
        self._bus.received(data)
        if self._client.expected is None:
            self._bus.counters.strays += len(data)
            return
        try:
            self._client.ctx.data_received(data)
        except (ModbusException, struct.error, IndexError, ValueError):
            self._bus.counters.checksum_errors += 1
            self._client.ctx.recv_buffer = b""

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell the bus."""
        self._bus.lost(self._client, exc)
