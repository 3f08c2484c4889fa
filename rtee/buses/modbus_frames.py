"""Modbus frames, sans-I/O: the answers a master waits for and the requests a slave hears."""

from __future__ import annotations

from dataclasses import dataclass

_MOST = 260
_TABLE: list[int] = []
for _byte in range(256):
    _crc = _byte
    for _ in range(8):
        _crc = _crc >> 1 ^ 0xA001 if _crc & 1 else _crc >> 1
    _TABLE.append(_crc)

READ_HOLDING = 0x03
READ_INPUT = 0x04
WRITE_ONE = 0x06
WRITE_MANY = 0x10
READ_WRITE = 0x17


def crc16(data: bytes) -> bytes:
    """Return the CRC-16/MODBUS of ``data`` in the order of transmission."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc.to_bytes(2, "little")


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """Return an RTU frame."""
    frame = bytes([unit]) + pdu
    return frame + crc16(frame)


def find_answer(data: bytes, unit: int, function: int) -> tuple[int, int]:
    """Return start and end of the first complete RTU answer in ``data``, or (-1, -1).

    Garbage before the answer does not matter.

    Args:
        data: What was received.
        unit: The slave that was asked.
        function: The function it was asked for; an exception counts as an answer.
    """
    start = data.find(unit)
    while 0 <= start <= len(data) - 5:
        end = start + _answer_size(data, start, function)
        if start < end <= len(data) and crc16(data[start : end - 2]) == data[end - 2 : end]:
            return start, end
        start = data.find(unit, start + 1)
    return -1, -1


def _answer_size(data: bytes, start: int, function: int) -> int:
    found = data[start + 1]
    if found == function | 0x80:
        return 5
    if found != function:
        return 0
    return 8 if found in (WRITE_ONE, WRITE_MANY) else 5 + data[start + 2]


@dataclass(frozen=True, slots=True)
class Request:
    """What a slave hears.

    Attributes:
        unit: The slave that is asked.
        pdu: Function code and data.
        header: What the answer must repeat of a TCP header; empty for RTU.
    """

    unit: int
    pdu: bytes
    header: bytes = b""

    def answer(self, pdu: bytes) -> bytes:
        """Return the frame that carries an answer to this request."""
        if not self.header:
            return rtu_frame(self.unit, pdu)
        return self.header + (len(pdu) + 1).to_bytes(2, "big") + bytes([self.unit]) + pdu


class RtuRequests:
    """Cuts the requests to one slave out of a line's bytes; frames for others are skipped.

    Attributes:
        unit: The slave; broadcasts (0) are heard too.
        errors: Bytes skipped because they belong to no frame of this slave.
    """

    def __init__(self, unit: int) -> None:
        self.unit = unit
        self.errors = 0
        self._buffer = b""

    def feed(self, data: bytes) -> list[Request]:
        """Take bytes and return the requests that they complete."""
        self._buffer += data
        found = []
        while (request := self._next()) is not None:
            found.append(request)
        if len(self._buffer) > _MOST:
            self.errors += len(self._buffer) - _MOST
            self._buffer = self._buffer[-_MOST:]
        return found

    def reset(self) -> None:
        """Forget the bytes of an incomplete request."""
        self._buffer = b""

    def _next(self) -> Request | None:
        data = self._buffer
        for start in range(len(data) - 3):
            if data[start] not in (self.unit, 0):
                continue
            end = start + _request_size(data, start)
            if start < end <= len(data) and crc16(data[start : end - 2]) == data[end - 2 : end]:
                self.errors += start
                self._buffer = data[end:]
                return Request(data[start], data[start + 1 : end - 2])
        return None

    @property
    def pending(self) -> int:
        """Bytes kept of an incomplete request."""
        return len(self._buffer)


def _request_size(data: bytes, start: int) -> int:
    function = data[start + 1]
    if 1 <= function <= 6:
        return 8
    if function in (0x0F, WRITE_MANY) and len(data) > start + 6:
        return 9 + data[start + 6]
    if function == READ_WRITE and len(data) > start + 10:
        return 13 + data[start + 10]
    return 0


class TcpRequests:
    """Cuts requests out of the bytes of a Modbus TCP connection.

    Attributes:
        errors: Bytes skipped because they belong to no frame.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._buffer = b""

    def feed(self, data: bytes) -> list[Request]:
        """Take bytes and return the requests that they complete."""
        self._buffer += data
        found = []
        while len(self._buffer) >= 8:
            size = int.from_bytes(self._buffer[4:6], "big")
            if self._buffer[2:4] != b"\0\0" or not 2 <= size <= 254:
                self.errors += 1
                self._buffer = self._buffer[1:]
                continue
            if len(self._buffer) < 6 + size:
                break
            frame, self._buffer = self._buffer[: 6 + size], self._buffer[6 + size :]
            found.append(Request(frame[6], frame[7:], frame[:4]))
        return found

    def reset(self) -> None:
        """Forget the bytes of an incomplete request."""
        self._buffer = b""

    @property
    def pending(self) -> int:
        """Bytes kept of an incomplete request."""
        return len(self._buffer)
