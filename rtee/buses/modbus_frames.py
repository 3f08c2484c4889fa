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


def find_answer(data: bytes, unit: int, function: int, head: bytes = b"") -> tuple[int, int]:
    """Return start and end of the first complete RTU answer in ``data``, or (-1, -1).

    Garbage before the answer does not matter.

    Args:
        data: What was received.
        unit: The slave that was asked.
        function: The function it was asked for; an exception counts as an answer.
        head: What follows the function in the answer to just this request, from `answer_head`.
    """
    start = data.find(unit)
    while 0 <= start <= len(data) - 5:
        size = _answer_size(data[start + 1 : start + 7], function, head)
        end = start + size + 3
        if size and end <= len(data) and crc16(data[start : end - 2]) == data[end - 2 : end]:
            return start, end
        start = data.find(unit, start + 1)
    return -1, -1


def find_network_answer(
    data: bytes, transaction: int, unit: int, function: int, head: bytes = b""
) -> tuple[int, int]:
    """Return start and end of the first complete TCP answer in ``data``, or (-1, -1).

    Args:
        data: What was received.
        transaction: Number of the request.
        unit: The unit that was asked.
        function: The function it was asked for; an exception counts as an answer.
        head: What follows the function in the answer to just this request, from `answer_head`.
    """
    wanted = transaction.to_bytes(2, "big") + b"\0\0"
    start = data.find(wanted)
    while 0 <= start <= len(data) - 9:
        size = _answer_size(data[start + 7 : start + 13], function, head)
        told = int.from_bytes(data[start + 4 : start + 6], "big")
        end = start + 7 + size
        if size and told == size + 1 and data[start + 6] == unit and end <= len(data):
            return start, end
        start = data.find(wanted, start + 1)
    return -1, -1


def answer_head(function: int, address: int, count: int) -> bytes:
    """Return what follows the function code in the answer to a request.

    Args:
        function: What is asked for.
        address: First register written, for function 16.
        count: Registers read, or written by function 16.
    """
    if function == WRITE_MANY:
        return address.to_bytes(2, "big") + count.to_bytes(2, "big")
    return bytes([2 * count])


def _answer_size(pdu: bytes, function: int, head: bytes) -> int:
    """Return the size of the PDU that begins so, 0 if it is no answer to the request."""
    found = pdu[0]
    if found == function | 0x80:
        return 2
    if found != function or not head.startswith(pdu[1 : 1 + len(head)]):
        return 0
    return 5 if found in (WRITE_ONE, WRITE_MANY) else 2 + pdu[1]


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

    A frame carries no checksum, so its length has to fit its function, and a whole request at the
    beginning of a piece of data ends an incomplete one before it: garbage costs no good frame.

    Attributes:
        errors: Bytes skipped because they belong to no frame.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._buffer = b""

    def feed(self, data: bytes) -> list[Request]:
        """Take bytes and return the requests that they complete."""
        if self._buffer and _network_size(data) == len(data):
            self.errors += len(self._buffer)
            self._buffer = b""
        if not self._buffer and len(data) >= 8 and _told(data) == len(data):
            return [Request(data[6], data[7:], data[:4])]
        self._buffer += data
        found = []
        while len(self._buffer) >= 8:
            size = _network_size(self._buffer)
            if size == 0:
                self.errors += 1
                self._buffer = self._buffer[1:]
                continue
            if size < 0 or len(self._buffer) < size:
                break
            frame, self._buffer = self._buffer[:size], self._buffer[size:]
            found.append(Request(frame[6], frame[7:], frame[:4]))
        return found

    def reset(self) -> None:
        """Forget the bytes of an incomplete request."""
        self._buffer = b""

    @property
    def pending(self) -> int:
        """Bytes kept of an incomplete request."""
        return len(self._buffer)


def _network_size(data: bytes) -> int:
    """Return the length of the TCP request that begins so: 0 if none does, -1 if too few bytes."""
    if len(data) < 8:
        return -1
    size, function = _told(data), data[7]
    if not size or not 0 < function < 0x80:
        return 0
    if function <= 6:
        return 12 if size == 12 else 0
    at = {0x0F: 12, WRITE_MANY: 12, READ_WRITE: 16}.get(function)
    if at is None:  # a function of which only the header tells the length
        return size
    if len(data) <= at:
        return -1 if size > at + 1 else 0
    registers = int.from_bytes(data[at - 2 : at], "big")
    bytes_of = (registers + 7) // 8 if function == 0x0F else 2 * registers
    return size if data[at] == bytes_of and size == at + 1 + bytes_of else 0


def _told(data: bytes) -> int:
    """Return the length of the TCP frame that its header tells, 0 if there is no header."""
    told = int.from_bytes(data[4:6], "big")
    return 6 + told if data[2:4] == b"\0\0" and 2 <= told <= 254 else 0
