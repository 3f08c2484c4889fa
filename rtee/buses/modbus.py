"""Modbus RTU and TCP on a `SerialBus`, with pymodbus's PDUs and framers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pymodbus.framer import FramerBase, FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    ReadWriteMultipleRegistersRequest,
    WriteMultipleRegistersRequest,
)

from rtee.buses.link import Line
from rtee.buses.modbus_frames import READ_HOLDING, READ_INPUT, AnswerParser
from rtee.buses.serial import SerialBus
from rtee.buses.timing import silence, wire_time
from rtee.errors import BusError, BusTimeout

EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
"""Names of the exception codes (Modbus application protocol V1.1b3, section 7)."""


_PASSING = (4, 5, 6)
"""Exceptions of a device that has failed or is busy, which do not depend on the request."""

_OF_GATEWAYS = (10, 11)
"""Exceptions with which a gateway reports that a unit behind it does not answer."""


class UnitUnreachable(BusTimeout):
    """A gateway reports that the unit behind it does not answer."""


class ModbusRefusal(BusError):
    """The device answered with a Modbus exception.

    Attributes:
        function: Code of the refused function.
        code: Exception code; see `EXCEPTIONS`.
        passing: Whether the device has failed or is busy: this says nothing about its kind.
    """

    def __init__(self, bus: str, function: int, code: int) -> None:
        name = EXCEPTIONS.get(code, "a code that the specification does not name")
        super().__init__(bus, f"Modbus exception {code} for function {function:#04x}: {name}")
        self.function = function
        self.code = code
        self.passing = code in _PASSING


class ModbusBus(SerialBus):
    """A Modbus line or connection with one master and any number of slaves.

    An address ``tcp://host[:502]`` means Modbus TCP; any other means RTU, also through a socket.
    Transport, deadlines, retries and trace are those of `SerialBus`; pymodbus encodes and frames
    the requests and decodes the answers.

    An RTU answer does not identify its request. So a request is sent only after the line was silent
    for the gap, bytes received until then are discarded, and an answer is accepted only if unit,
    function and length (for a write, address and number of registers) match the request. One case
    remains: the late answer to an equal request that was abandoned or sent again, arriving while
    the next one waits. With TCP, the transaction number, which differs in each attempt, excludes
    this case, too.

    Attributes:
        rtu: Whether the frames are RTU frames; otherwise TCP frames.

    Args:
        gap: Silence kept before a request [s]; by default 3.5 characters, see `silence`.
        behind: How much smaller the transaction number of an answer may be than that of its request
            (TCP), for devices that count wrongly.
    """

    def __init__(
        self,
        name: str,
        line: Line,
        *,
        address: Callable[[], str] | None = None,
        gap: float | None = None,
        behind: int = 0,
    ) -> None:
        self.rtu = not name.startswith("tcp://")
        # Only silence separates RTU frames; TCP frames contain their length.
        usual = silence(line.baudrate, line.bits) if self.rtu else 0.0
        super().__init__(
            name, line, address=address, gap=usual if gap is None else gap, fresh=self.rtu
        )
        decoder = DecodePDU(is_server=False)
        self._framer: FramerBase = FramerRTU(decoder) if self.rtu else FramerSocket(decoder)
        self._number = 0
        self._behind = behind

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
            deadline: Longest time, including retries [s].
            retries: How often the request may be sent again within that time.
            function: 3 (holding registers) or 4 (input registers).

        Raises:
            BusTimeout: if no byte came in time.
            FrameError: if bytes came in time, but no valid frame.
            ModbusRefusal: if the device answered with a Modbus exception.
            BusBroken: if the link is broken.
            BusClosed: if the bus is closed.
        """
        kind = ReadInputRegistersRequest if function == READ_INPUT else ReadHoldingRegistersRequest
        request = kind(dev_id=unit, address=address, count=count)
        return await self._request(request, bytes([2 * count]), deadline, retries)

    async def write(
        self, unit: int, address: int, values: Sequence[int], *, deadline: float, retries: int = 1
    ) -> None:
        """Set registers from ``address`` on, in one frame (function 16). Errors as for `read`."""
        request = WriteMultipleRegistersRequest(dev_id=unit, address=address, registers=values)
        echo = address.to_bytes(2, "big") + len(values).to_bytes(2, "big")
        await self._request(request, echo, deadline, retries)

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
        request = ReadWriteMultipleRegistersRequest(
            read_address, count, address, values, dev_id=unit
        )
        return await self._request(request, bytes([2 * count]), deadline, retries)

    def exchange_time(self, sent: int, received: int, *, turnaround: float = 0.0) -> float:
        """Return the shortest time of an exchange on this wire [s].

        Args:
            sent: Bytes of the request's PDU.
            received: Bytes of the answer's PDU.
            turnaround: Time that the device needs after the silence that ends the request [s].
        """
        if not self.rtu:
            return turnaround
        # Each of the two frames consists of a unit number, its PDU and a checksum of two bytes.
        length = sent + received + 6
        return wire_time(length, self.line.baudrate, self.line.bits) + 2 * self.gap + turnaround

    async def _request(
        self, request: ModbusPDU, head: bytes, deadline: float, retries: int
    ) -> tuple[int, ...]:
        """Return the registers of the answer, which begins with the function and ``head``."""
        parser = AnswerParser(self._framer, request, head, self._behind)

        def numbered() -> bytes:
            # The header has two bytes for it; another number in each attempt.
            self._number = (self._number + 1) % 0x10000
            return parser.request(self._number)

        answer = await self.transact(
            numbered, parser, deadline, retries, whom=f"unit {request.dev_id}"
        )
        if isinstance(answer, ExceptionResponse):
            code = answer.exception_code
            # Only gateways report these codes, for units that do not answer.
            if code in _OF_GATEWAYS:
                raise UnitUnreachable(self.name, f"unit {request.dev_id}: {EXCEPTIONS[code]}")
            raise ModbusRefusal(self.name, request.function_code, answer.exception_code)
        return tuple(answer.registers)
