"""Frames of Feetech's serial bus servos: requests, replies, checksums. No I/O.

A request is ``FF FF id length instruction parameters checksum``; in a reply, the servo's status
replaces the instruction. All families share these frames but differ in the byte order of words; see
`rtee.drivers.feetech.table`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar, Self

from rtee.buses.parser import CodecError, FramedParser, Framing

HEADER = b"\xff\xff"
BROADCAST = 0xFE  # the id that all servos listen to
LARGEST_ID = 0xFD
OVERHEAD = 6
"""Bytes of a frame without its parameters: header, id, length, instruction or status, checksum."""
LONGEST = 250
"""Largest length field that the vendor's clients accept [byte]."""
_LARGEST_STATUS = 0x7F  # clients reject replies with a larger status


class Instruction(IntEnum):
    """Instructions of a host."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    RESTORE = 0x06
    REBOOT = 0x08
    BACK_UP = 0x09
    RESET = 0x0A
    CALIBRATE = 0x0B
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class Status(IntFlag):
    """The bits of a reply's status; each is set as long as its cause persists."""

    VOLTAGE = 0x01
    ANGLE = 0x02
    OVERHEATING = 0x04
    OVERCURRENT = 0x08
    OVERLOAD = 0x20
    KNOWN = 0x2F
    """Bits 4, 6 and 7 have no meaning."""


_FRAMING = Framing(HEADER, 1, lambda raw: bytes([~sum(raw[2:]) & 0xFF]), LONGEST, 2, 1)
"""Framing: the servo's id, then the length of code, parameters and checksum."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A request or a reply.

    Attributes:
        device: Id of the servo; in a request also `BROADCAST`.
        code: The request's instruction, or the reply's status.
        params: Parameters of a request, or data of a reply.
    """

    device: int
    code: int
    params: bytes = b""

    def to_bytes(self) -> bytes:
        """Return the frame as sent; raises `CodecError` if it is too long."""
        return _FRAMING.sealed((self.device,), bytes([self.code]) + self.params)

    @classmethod
    def from_bytes(cls, raw: bytes) -> Self:
        """Return the frame in ``raw``; raises `CodecError`."""
        if raw[2:3] > bytes([BROADCAST]):
            raise CodecError("a frame must begin with FF FF and an id")
        [device], body = _FRAMING.opened(raw)
        return cls(device, body[0], body[1:])


def sync_read(address: int, size: int, ids: Collection[int]) -> bytes:
    """Return the request that reads the same registers of several servos."""
    params = bytes([address, size, *ids])
    return Frame(BROADCAST, Instruction.SYNC_READ, params).to_bytes()


def sync_write(address: int, data: Mapping[int, bytes]) -> list[bytes]:
    """Return the requests that set registers of several servos: one, unless it is too long.

    ``data`` has the bytes to write by id, equally many for each servo.
    """
    if not data:
        return []
    size = len(next(iter(data.values())))
    entries = [bytes([number]) + values for number, values in data.items()]
    # The length counts instruction, address, size and checksum; each servo adds its id and values.
    most = (LONGEST - 4) // (size + 1)
    return [
        Frame(
            BROADCAST,
            Instruction.SYNC_WRITE,
            bytes([address, size]) + b"".join(entries[start : start + most]),
        ).to_bytes()
        for start in range(0, len(entries), most)
    ]


class _Parser(FramedParser[Frame]):
    FRAMING = _FRAMING
    FRAME = Frame
    LARGEST: ClassVar[int]

    def _length(self, at: int) -> int:
        # A byte above the largest id belongs to a header that begins later, or is noise.
        return super()._length(at) if self._buffer[at + 2] <= self.LARGEST else 0


class RequestParser(_Parser):
    """Finds requests in a stream, as a servo does."""

    LARGEST = BROADCAST


class ReplyParser(_Parser):
    """Finds replies in a stream, as a host does."""

    LARGEST = LARGEST_ID

    def _decode(self, raw: bytes) -> Frame:
        frame = super()._decode(raw)
        if frame.code > _LARGEST_STATUS:
            raise CodecError(f"no servo has a status of {frame.code:#04x}")
        return frame


class GroupParser:
    """Finds the replies of several servos to one request, and returns them together.

    Args:
        size: Data bytes of each reply; replies of other sizes belong to other requests.
    """

    def __init__(self, ids: Collection[int], size: int) -> None:
        self._ids = frozenset(ids)
        self._size = size
        self._replies = ReplyParser()
        self._found: dict[int, Frame] = {}

    @property
    def errors(self) -> int:
        """Replies dropped for a bad length, content or checksum."""
        return self._replies.errors

    @property
    def missing(self) -> list[int]:
        """The servos whose reply has not come since the last `reset`, by id."""
        return sorted(self._ids - self._found.keys())

    def reset(self) -> None:
        """Discard the received bytes."""
        self._replies.reset()
        self._found = {}

    def feed(self, data: bytes) -> list[dict[int, Frame]]:
        """Receive bytes and return the replies by id, once all are there."""
        for reply in self._replies.feed(data):
            if reply.device in self._ids and len(reply.params) == self._size:
                self._found[reply.device] = reply
        if self._found.keys() != self._ids:
            return []
        found, self._found = self._found, {}
        return [found]
