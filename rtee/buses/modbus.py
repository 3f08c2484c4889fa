"""Modbus through pymodbus's asynchronous client: RTU on a line or through a socket, and TCP."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from pymodbus.exceptions import ModbusException

from rtee.buses.bus import Bus
from rtee.buses.link import Line, ended, open_link
from rtee.buses.modbus_client import Client, Relay, Sender
from rtee.buses.modbus_frames import (
    READ_HOLDING,
    READ_INPUT,
    READ_WRITE,
    WRITE_MANY,
    answer_head,
)
from rtee.buses.timing import Pause, silence, wire_time
from rtee.errors import BusBroken, BusError, BusTimeout, FrameError

# What pymodbus logs as errors is a retry here, counted and reported by this bus.
logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)


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
        self._client: Client | None = None
        self._link: asyncio.Transport | None = None
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

        def request(client: Client) -> Awaitable[Any]:
            asked = client.read_input_registers if function == READ_INPUT else None
            return (asked or client.read_holding_registers)(address, count=count, device_id=unit)

        head = answer_head(function, address, count)
        return await self._transact(request, (unit, function, head), count, deadline, retries)

    async def write(
        self, unit: int, address: int, values: Sequence[int], *, deadline: float, retries: int = 1
    ) -> None:
        """Set registers from ``address`` on, in one frame (function 16). Errors as for `read`."""

        def request(client: Client) -> Awaitable[Any]:
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

        def request(client: Client) -> Awaitable[Any]:
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
        request: Callable[[Client], Awaitable[Any]],
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
        request: Callable[[Client], Awaitable[Any]],
        expected: tuple[int, int, bytes],
        share: float,
    ) -> tuple[int, ...] | None:
        client = self._client
        if client is None:
            raise BusBroken(self.name, "no link")
        before = self.counters.bytes_received
        function = expected[1]
        task = asyncio.current_task()
        cancelled = 0 if task is None else task.cancelling()
        try:
            async with asyncio.timeout(share):
                client.wanted = expected
                response = await request(client)
                if task is not None and task.cancelling() > cancelled:
                    # pymodbus's asyncio.wait_for, before Python 3.12, keeps an answer that comes
                    # together with a cancellation, and loses the cancellation.
                    raise asyncio.CancelledError
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

    def send(self, client: Client, data: bytes) -> None:
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

    def received(self, data: bytes) -> None:
        """Note what came in; called by the link."""
        self._last = time.monotonic()
        self.counters.bytes_received += len(data)
        if self.trace is not None:
            self.trace(self.name, "rx", data, self._last)

    def lost(self, client: Client, error: Exception | None) -> None:
        """End what waits on a link that broke; called by the link."""
        if client is self._client:
            self._client = None
            self._broke(str(error) if error else "")
            client.abandon(BusBroken(self.name, f"the link broke: {self._cause}"))

    async def _open(self) -> None:
        await self._close()
        client = Client(self)
        transport, _ = await open_link(
            self._address(), self.line, lambda: Relay(self, client), name=self.name
        )
        self._link = transport
        if transport.is_closing():
            raise BusBroken(self.name, "the other end hung up at once")
        client.link = transport
        client.ctx.transport = Sender(self, client)  # type: ignore[assignment]
        self._client = client

    async def _close(self) -> None:
        client, self._client = self._client, None
        self._pause.close()
        if client is not None:
            client.abandon(BusBroken(self.name, "the bus was closed meanwhile"))
            client.close()
        link, self._link = self._link, None
        if link is not None:
            link.abort()
            await ended(link)
