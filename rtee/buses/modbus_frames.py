"""Modbus frames, sans-I/O: the answers a master waits for and the requests a slave receives.

The master's side uses pymodbus. The slave's side, for emulated devices, is independent of pymodbus
except for the checksum, so that both sides can be tested against each other.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from pymodbus.framer import FramerBase, FramerRTU, FramerSocket
from pymodbus.pdu import ModbusPDU

_MOST = 260
"""Longest frame [byte]: a TCP header of 7 bytes and a PDU of 253."""

READ_HOLDING = 0x03  # function codes (Modbus application protocol 1.1b3, section 6)
READ_INPUT = 0x04
WRITE_ONE = 0x06
WRITE_MANY = 0x10
READ_WRITE = 0x17


def crc16(data: bytes) -> bytes:
    """Return the CRC-16/MODBUS of ``data`` in the order of transmission."""
    return FramerRTU.compute_CRC(data).to_bytes(2, "big")


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """Return an RTU frame."""
    frame = bytes([unit]) + pdu
    return frame + crc16(frame)


class AnswerParser:
    """Finds the answer to one request in the bytes of a line or connection.

    pymodbus's framers expect a frame at the beginning of their input, and wait for the rest of
    anything that looks like one. So they only get bytes that begin like the answer to this request
    or like its exception; garbage and other answers before these bytes are skipped.

    Args:
        framer: pymodbus's framer for RTU or TCP.
        head: Bytes between the function and the registers of its answer: the number of bytes, or,
            for a write, its address and number of registers.
        behind: How much smaller the transaction number of an answer may be than that of its
            request, for devices that count wrongly.
    """

    def __init__(
        self, framer: FramerBase, request: ModbusPDU, head: bytes, behind: int = 0
    ) -> None:
        self._framer = framer
        self._behind = behind
        self._request = request
        function = bytes([request.function_code])
        # The PDU of an answer is function, address and number of registers for a write, or
        # function, number of bytes and these bytes for a read.
        size = 5 if request.function_code == WRITE_MANY else 2 + head[0]
        # An exception consists of the function with its highest bit set, and a code.
        self._pdus = ((function + head, size), (bytes([request.function_code | 0x80]), 2))
        self._openings: tuple[bytes, ...] = ()
        self._failed = 0
        self._buffer = b""

    @property
    def errors(self) -> int:
        """Number of attempts that received bytes, but no answer."""
        return self._failed + bool(self._buffer)

    def reset(self) -> None:
        """Discard the bytes received so far."""
        self._failed = self.errors
        self._buffer = b""

    def request(self, number: int) -> bytes:
        """Return the frame of the request; `feed` then finds only an answer to this frame.

        Only TCP frames contain the transaction number.
        """
        self._request.transaction_id = number
        unit = self._request.dev_id
        if isinstance(self._framer, FramerSocket):
            self._openings = tuple(
                # MBAP header: transaction number, protocol 0, length of the rest, unit.
                struct.pack(">HHHB", transaction, 0, size + 1, unit) + pdu
                for transaction in [(number - lag) % 0x10000 for lag in range(self._behind + 1)]
                for pdu, size in self._pdus
            )
        else:
            self._openings = tuple(bytes([unit]) + pdu for pdu, _ in self._pdus)
        return self._framer.buildFrame(self._request)

    def feed(self, data: bytes) -> list[ModbusPDU]:
        """Receive bytes and return the answer when it is complete."""
        self._buffer += data
        for opening in self._openings:
            start = self._buffer.find(opening)
            while start >= 0:
                pdu = self._framer.decode(self._buffer[start:])[3]
                answer = self._framer.decoder.decode(pdu) if pdu else None
                if answer is not None:
                    self._buffer = b""
                    return [answer]
                # It only looked like an answer; the real one may begin inside it.
                start = self._buffer.find(opening, start + 1)
        self._buffer = self._buffer[-_MOST:]
        return []


@dataclass(frozen=True, slots=True)
class ModbusRequest:
    """A request to a slave.

    Attributes:
        unit: Unit number of the slave; 0 for a broadcast.
        pdu: Function code and data.
        header: The bytes of the TCP header that the answer repeats; empty for RTU.
    """

    unit: int
    pdu: bytes
    header: bytes = b""

    def answer(self, pdu: bytes) -> bytes:
        """Return the frame that answers this request with a PDU."""
        if not self.header:
            return rtu_frame(self.unit, pdu)
        return self.header + (len(pdu) + 1).to_bytes(2, "big") + bytes([self.unit]) + pdu


class _Requests:
    """Finds requests in a stream of bytes.

    Attributes:
        errors: Number of skipped bytes that belong to no frame of the slave.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._buffer = b""

    @property
    def pending(self) -> int:
        """Bytes kept of an incomplete request."""
        return len(self._buffer)

    def reset(self) -> None:
        """Forget the bytes of an incomplete request."""
        self._buffer = b""


class RtuRequests(_Requests):
    """Finds the requests to one slave in the bytes of a line; frames for others are skipped.

    Attributes:
        unit: Unit number of the slave; broadcasts (0) are found, too.
    """

    def __init__(self, unit: int) -> None:
        super().__init__()
        self.unit = unit

    def feed(self, data: bytes) -> list[ModbusRequest]:
        """Receive bytes and return the requests that they complete."""
        self._buffer += data
        requests = []
        while (request := self._next()) is not None:
            requests.append(request)
        if len(self._buffer) > _MOST:
            self.errors += len(self._buffer) - _MOST
            self._buffer = self._buffer[-_MOST:]
        return requests

    def _next(self) -> ModbusRequest | None:
        data = self._buffer
        # A request may begin anywhere after garbage; the checksum decides.
        for start in range(len(data) - 3):
            if data[start] not in (self.unit, 0):
                continue
            end = start + _request_size(data, start)
            if start < end <= len(data) and crc16(data[start : end - 2]) == data[end - 2 : end]:
                self.errors += start
                self._buffer = data[end:]
                return ModbusRequest(data[start], data[start + 1 : end - 2])
        return None


def _request_size(data: bytes, start: int) -> int:
    function = data[start + 1]
    if 1 <= function <= 6:
        return 8
    if function in (0x0F, WRITE_MANY) and len(data) > start + 6:
        return 9 + data[start + 6]
    if function == READ_WRITE and len(data) > start + 10:
        return 13 + data[start + 10]
    return 0


class TcpRequests(_Requests):
    """Finds requests in the bytes of a Modbus TCP connection.

    TCP frames have no checksum. To keep garbage from hiding a good frame, a frame's length must fit
    its function, and data that is exactly one request discards an incomplete one before it.
    """

    def feed(self, data: bytes) -> list[ModbusRequest]:
        """Receive bytes and return the requests that they complete."""
        if self._buffer and _network_size(data) == len(data):
            self.errors += len(self._buffer)
            self._buffer = b""
        if not self._buffer and len(data) >= 8 and _length(data) == len(data):
            return [ModbusRequest(data[6], data[7:], data[:4])]
        self._buffer += data
        requests = []
        while len(self._buffer) >= 8:
            size = _network_size(self._buffer)
            if size == 0:
                self.errors += 1
                self._buffer = self._buffer[1:]
                continue
            if size < 0 or len(self._buffer) < size:
                break
            frame, self._buffer = self._buffer[:size], self._buffer[size:]
            requests.append(ModbusRequest(frame[6], frame[7:], frame[:4]))
        return requests


def _network_size(data: bytes) -> int:
    """Return the length of the TCP request at the start of ``data``.

    0 if ``data`` cannot be the start of a request, -1 if it is too short to decide.
    """
    if len(data) < 8:
        return -1
    size, function = _length(data), data[7]
    if not size or not 0 < function < 0x80:
        return 0
    if function <= 6:
        return 12 if size == 12 else 0
    at = {0x0F: 12, WRITE_MANY: 12, READ_WRITE: 16}.get(function)
    if at is None:  # only the header gives the length of this function
        return size
    if len(data) <= at:
        return -1 if size > at + 1 else 0
    registers = int.from_bytes(data[at - 2 : at], "big")
    bytes_of = (registers + 7) // 8 if function == 0x0F else 2 * registers
    return size if data[at] == bytes_of and size == at + 1 + bytes_of else 0


def _length(data: bytes) -> int:
    """Return the length of the TCP frame according to its header, 0 if there is no header."""
    length = int.from_bytes(data[4:6], "big")
    return 6 + length if data[2:4] == b"\0\0" and 2 <= length <= 254 else 0
