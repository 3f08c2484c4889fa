"""Modbus through pymodbus's asynchronous client: RTU on a line or through a socket, and TCP."""

from __future__ import annotations

import asyncio
import logging
import struct
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from pymodbus.client.base import ModbusBaseClient
from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerRTU, FramerSocket, FramerType
from pymodbus.transport import CommParams, CommType

from rtee.buses.bus import Bus
from rtee.buses.link import Line, SerialTransport, open_link
from rtee.buses.modbus_frames import (
    READ_HOLDING,
    READ_INPUT,
    READ_WRITE,
    WRITE_MANY,
    answer_head,
    find_answer,
    find_network_answer,
)
from rtee.buses.timing import Pause, silence, wire_time
from rtee.errors import BusBroken, BusError, BusTimeout, FrameError

# What pymodbus logs as errors is a retry here, counted and reported by this bus.
logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)

_FOR_EVER = 3600.0


class ModbusRefusal(BusError):
    """The device answered with a Modbus exception.

    Attributes:
        function: The function it refused.
        code: The exception's code: 1 function, 2 address, 3 value, 4 failure, 10 and 11 gateway.
    """

    def __init__(self, bus: str, function: int, code: int) -> None:
        super().__init__(bus, f"Modbus exception {code} for function {function:#04x}")
        self.function = function
        self.code = code


class ModbusBus(Bus):
    """A Modbus line or connection with one master and any number of slaves.

    ``tcp://host[:502]`` speaks Modbus TCP; everything else speaks RTU, also through a socket. The
    client is pymodbus's; link, deadlines and retries are those of all buses, so a cancelled
    request stays cancelled and a broken link ends what waits for it at once.

    On an RTU line an answer does not tell which request it belongs to. So a request goes out only
    when the line has been silent for the gap, whatever was received until then is thrown away, and
    an answer counts only if unit, function and length (or, of a write, address and number of
    registers) are those of the request. What remains: the answer to a request that was given up
    and asked again, or to an equal request before it, that comes while the next one waits.

    Attributes:
        line: How the line is set.
        rtu: Whether it speaks RTU.
        gap: Silence kept before a request [s].
    """

    def __init__(
        self,
        name: str,
        line: Line,
        *,
        address: Callable[[], str] | None = None,
        gap: float | None = None,
    ) -> None:
        super().__init__(name)
        self.line = line
        self.rtu = not name.startswith("tcp://")
        usual = silence(line.baudrate, line.bits) if self.rtu else 0.0
        self.gap = usual if gap is None else gap
        self._address = address or (lambda: name)
        self._lock = asyncio.Lock()
        self._pause = Pause()
        self._client: _Client | None = None
        self._last = 0.0

    async def read(
        self,
        unit: int,
        address: int,
        count: int,
        *,
        deadline: float,
        retries: int = 1,
        function: int = READ_HOLDING,
    ) -> tuple[int, ...]:
        """Return ``count`` registers from ``address`` on.

        Args:
            unit: The slave.
            address: First register.
            count: Number of registers.
            deadline: Longest time, retries included [s].
            retries: How often it may be asked again within that time.
            function: 3 (holding registers) or 4 (input registers).

        Raises:
            BusTimeout: if no answer came in time.
            FrameError: if only garbage came.
            ModbusRefusal: if the device refused.
            BusBroken: if the link is broken.
            BusClosed: if the bus is closed.
        """

        def request(client: _Client) -> Awaitable[Any]:
            asked = client.read_input_registers if function == READ_INPUT else None
            return (asked or client.read_holding_registers)(address, count=count, device_id=unit)

        head = answer_head(function, address, count)
        return await self._transact(request, (unit, function, head), count, deadline, retries)

    async def write(
        self, unit: int, address: int, values: Sequence[int], *, deadline: float, retries: int = 1
    ) -> None:
        """Set registers from ``address`` on, in one frame (function 16). Errors as for `read`."""

        def request(client: _Client) -> Awaitable[Any]:
            return client.write_registers(address, list(values), device_id=unit)

        head = answer_head(WRITE_MANY, address, len(values))
        await self._transact(request, (unit, WRITE_MANY, head), 0, deadline, retries)

    async def exchange(
        self,
        unit: int,
        address: int,
        values: Sequence[int],
        read_address: int,
        count: int,
        *,
        deadline: float,
        retries: int = 1,
    ) -> tuple[int, ...]:
        """Set registers, then return others, in one exchange (function 23). Errors: see `read`."""

        def request(client: _Client) -> Awaitable[Any]:
            return client.readwrite_registers(
                read_address=read_address,
                read_count=count,
                write_address=address,
                values=list(values),
                device_id=unit,
            )

        head = answer_head(READ_WRITE, read_address, count)
        return await self._transact(request, (unit, READ_WRITE, head), count, deadline, retries)

    def exchange_time(self, sent: int, received: int, *, turnaround: float = 0.0) -> float:
        """Return the shortest time of an exchange on this wire [s].

        Args:
            sent: Bytes of the request's PDU.
            received: Bytes of the answer's PDU.
            turnaround: What the device needs beyond the silence that ends the request [s].
        """
        if not self.rtu:
            return turnaround
        length = sent + received + 6
        return wire_time(length, self.line.baudrate, self.line.bits) + 2 * self.gap + turnaround

    async def _transact(
        self,
        request: Callable[[_Client], Awaitable[Any]],
        expected: tuple[int, int, bytes],
        count: int,
        deadline: float,
        retries: int,
    ) -> tuple[int, ...]:
        unit = expected[0]
        end = time.monotonic() + deadline
        try:
            async with asyncio.timeout(deadline):
                await self._lock.acquire()
        except TimeoutError:
            self.counters.timeouts += 1
            raise BusTimeout(self.name, f"the line was not free within {deadline:.3f} s") from None
        try:
            self.check()
            self.counters.transactions += 1
            before = self.counters.bytes_received
            for attempt in range(retries + 1):
                share = (end - time.monotonic()) / (retries + 1 - attempt)
                if share <= 0.0:
                    break
                self.counters.retries += attempt > 0
                answer = await self._attempt(request, expected, share)
                if answer is not None and len(answer) == count:
                    return answer
            received = self.counters.bytes_received - before
        finally:
            self._lock.release()
        where = f"unit {unit}: "
        if received:
            raise FrameError(
                self.name, f"{where}{received} bytes but no valid answer in {deadline:.3f} s"
            )
        raise BusTimeout(self.name, f"{where}no answer within {deadline:.3f} s")

    async def _attempt(
        self,
        request: Callable[[_Client], Awaitable[Any]],
        expected: tuple[int, int, bytes],
        share: float,
    ) -> tuple[int, ...] | None:
        client = self._client
        if client is None:
            raise BusBroken(self.name, "no link")
        before = self.counters.bytes_received
        function = expected[1]
        try:
            async with asyncio.timeout(share):
                client.wanted = expected
                response = await request(client)
        except TimeoutError:
            self.counters.timeouts += 1
            self.counters.checksum_errors += self.counters.bytes_received > before
            return None
        except ModbusException:
            self.counters.strays += 1  # an answer to another request
            return None
        finally:
            client.wanted = client.expected = None
            self._pause.cancel()
        if response.isError():
            raise ModbusRefusal(self.name, function, int(response.exception_code))
        if response.function_code != function:
            self.counters.strays += 1
            return None
        return tuple(int(v) for v in getattr(response, "registers", ())) if function != 16 else ()

    def send(self, client: _Client, data: bytes) -> None:
        """Write a request when the line has been silent long enough; called by the client."""
        due = self._last + self.gap
        if self.gap and due > time.monotonic():
            # The frame is made while the silence lasts, and goes out from the timer's callback.
            self._pause.start(due, lambda: self.send(client, data))
            return
        if client is not self._client or client.link is None or client.wanted is None:
            return
        client.discard()
        client.expected = client.wanted
        self._last = time.monotonic()
        self.counters.bytes_sent += len(data)
        if self.trace is not None:
            self.trace(self.name, "tx", data, self._last)
        client.link.write(data)

    def _received(self, data: bytes) -> None:
        self._last = time.monotonic()
        self.counters.bytes_received += len(data)
        if self.trace is not None:
            self.trace(self.name, "rx", data, self._last)

    def _lost(self, client: _Client, error: Exception | None) -> None:
        if client is self._client:
            self._client = None
            self._broke(str(error) if error else "")
            client.abandon(BusBroken(self.name, f"the link broke: {self._cause}"))

    async def _open(self) -> None:
        await self._close()
        client = _Client(self)
        transport, _ = await open_link(
            self._address(), self.line, lambda: _Relay(self, client), name=self.name
        )
        if transport.is_closing():
            raise BusBroken(self.name, "the other end hung up at once")
        client.link = transport
        client.ctx.transport = _Sender(self, client)  # type: ignore[assignment]
        self._client = client

    async def _close(self) -> None:
        client, self._client = self._client, None
        self._pause.close()
        if client is not None:
            client.abandon(BusBroken(self.name, "the bus was closed meanwhile"))
            client.close()
            if client.link is not None:
                client.link.abort()
            await asyncio.sleep(0)  # the transport closes its file descriptor in its next callback


class _Client(ModbusBaseClient):
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


class _Sender:
    """What pymodbus takes for its transport: it sends when the bus lets it."""

    def __init__(self, bus: ModbusBus, client: _Client) -> None:
        self._bus = bus
        self._client = client

    def write(self, data: bytes) -> None:
        self._bus.send(self._client, data)

    def close(self) -> None:
        """The bus closes the link."""

    def abort(self) -> None:
        """The bus closes the link."""


class _Framer(FramerRTU):
    """pymodbus's RTU framer, but one that finds the answer to its request also behind noise."""

    def __init__(self, client: _Client, decoder: Any) -> None:
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

    def __init__(self, client: _Client, decoder: Any) -> None:
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


class _Relay(asyncio.Protocol):
    """Between the link and pymodbus: counts, traces, and keeps bad frames from ending the link."""

    def __init__(self, bus: ModbusBus, client: _Client) -> None:
        self._bus = bus
        self._client = client

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        sender: Any = _Sender(self._bus, self._client)
        self._client.ctx.connection_made(sender)

    def data_received(self, data: bytes) -> None:
        self._bus._received(data)  # noqa: SLF001 - a part of the bus
        if self._client.expected is None:
            self._bus.counters.strays += len(data)
            return
        try:
            self._client.ctx.data_received(data)
        except (ModbusException, struct.error, IndexError, ValueError):
            self._bus.counters.checksum_errors += 1
            self._client.ctx.recv_buffer = b""

    def connection_lost(self, exc: Exception | None) -> None:
        self._bus._lost(self._client, exc)  # noqa: SLF001 - a part of the bus
