"""The frames of the ORCA hand's touch board and their data; no I/O.

Source: framing, registers and data from the hand's open-source client. The board answers requests
and, once its stream is started, sends frames by itself; frames of joint encoders may share the
line. Every frame ends with the two's complement of the sum of all bytes before it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from rtee.buses.parser import CodecError, FramedParser
from rtee.sample import FloatArray

BAUDRATES = (921_600, 2_000_000)
"""Rates of the board's own adapter and of the line shared with the encoders [baud]."""

NEWTONS = 0.1
"""Force of one count [N]."""

LONGEST = 8192 + 6
"""Bytes of the longest frame that the board sends by itself."""

ENCODERS = 17
"""Number of joint encoders of a hand."""

_HEAD = struct.Struct("<BBHH")  # 0, function, address, count
_OVERHEAD = 9  # bytes around a request's or reply's data: header, the four above, checksum
_AROUND = 6  # bytes around a streamed frame's data: header, 0, length, checksum
_LARGEST = 512
"""Largest number of register bytes in an exchange: more than the largest table, 168."""
_ANGLE = 0x3FFF
_TURN = 2.0 * math.pi / (_ANGLE + 1)  # one count of an encoder [rad]


class Function(IntEnum):
    """Functions of requests."""

    READ = 0x03
    WRITE = 0x10


class Register(IntEnum):
    """Addresses of registers."""

    CONNECTED = 0x0010
    CONTENT = 0x0016
    STREAM = 0x0017
    COUNTS = 0x0030
    RESULTANTS = 0x0500


class Content(IntFlag):
    """Contents of streamed frames."""

    RESULTANTS = 1
    TAXELS = 2


CONNECTED_SIZE, COUNTS_SIZE = 4, 56

FINGERS = ("thumb", "index", "middle", "ring", "pinky")
"""The slots of the board, in the order of its data."""

_SLOTS: Mapping[str, tuple[int, int]] = {
    "thumb": (0, 2),
    "index": (0, 6),
    "middle": (1, 2),
    "ring": (1, 6),
    "pinky": (2, 2),
}
"""Byte and bit in `Register.CONNECTED` of each fingertip."""

_PER_SLOT = 4  # modules of a slot; the third is the fingertip
_TIP = 2
_NORMAL = 2  # axis of a resultant normal to the sensor, which is never negative
_TAXEL, _RESULTANT = 3, 6  # bytes of each


def check_of(data: bytes) -> int:
    """Return the checksum of a frame, the byte that follows ``data``."""
    return -sum(data) & 0xFF


def _sealed(raw: bytes) -> bytes:
    return raw + bytes([check_of(raw)])


@dataclass(frozen=True, slots=True)
class Request:
    """A request.

    Attributes:
        function: Read or write.
        address: First register.
        count: Number of register bytes.
        data: The bytes to write.
    """

    HEADER: ClassVar[bytes] = b"\x55\xaa"

    function: int
    address: int
    count: int
    data: bytes = b""

    def to_bytes(self) -> bytes:
        """Return the frame as sent."""
        head = _HEAD.pack(0, self.function, self.address, self.count)
        return _sealed(self.HEADER + head + self.data)

    @classmethod
    def from_bytes(cls, raw: bytes) -> Self:
        """Return the frame that ``raw`` holds; raises `CodecError`."""
        if len(raw) < _OVERHEAD or check_of(raw[:-1]) != raw[-1]:
            raise CodecError("the check does not match")
        zero, function, address, count = _HEAD.unpack_from(raw, 2)
        if zero or function not in (Function.READ, Function.WRITE):
            raise CodecError(f"unknown function {function:#04x}")
        return cls(function, address, count, raw[_HEAD.size + 2 : -1])


@dataclass(frozen=True, slots=True)
class Reply(Request):
    """The answer to a request; after a write, its data are one byte, 0 for success."""

    HEADER = b"\xaa\x55"


@dataclass(frozen=True, slots=True)
class Stream:
    """A frame that the board sends by itself.

    Attributes:
        error: 0 for none; the meaning of other values is not published.
        data: Resultants and taxels of the connected fingers.
    """

    HEADER: ClassVar[bytes] = b"\xaa\x56"

    error: int
    data: bytes

    def to_bytes(self) -> bytes:
        """Return the frame as sent."""
        head = struct.pack("<BHB", 0, 1 + len(self.data), self.error)
        return _sealed(self.HEADER + head + self.data)

    @classmethod
    def from_bytes(cls, raw: bytes) -> Self:
        """Return the frame that ``raw`` holds; raises `CodecError`."""
        if len(raw) <= _AROUND or check_of(raw[:-1]) != raw[-1] or raw[2]:
            raise CodecError("the check does not match")
        return cls(raw[5], raw[6:-1])


@dataclass(frozen=True, slots=True)
class Encoders(Stream):
    """A frame of the joint encoders, with a word for each encoder."""

    HEADER = b"\xaa\xa9"

    def angles(self) -> FloatArray:
        """Return the joints' angles ``(17,)`` [rad]; ``NaN`` where an encoder reports an error."""
        found = np.frombuffer(self.data, dtype="<u2").astype(np.int64)
        ones = np.array([bin(word).count("1") for word in found.tolist()])
        # Bit 14 is an error of the encoder, bit 15 makes the number of ones even.
        bad = (found & 0x4000 != 0) | (ones % 2 != 0)
        return np.where(bad, math.nan, (found & _ANGLE) * _TURN)


Answer = Reply | Stream
_ANSWERS: Mapping[bytes, type[Reply | Stream]] = {
    kind.HEADER: kind for kind in (Reply, Stream, Encoders)
}


class RequestParser(FramedParser[Request]):
    """Finds requests in a stream, for the board."""

    FRAME = Request
    HEADER = Request.HEADER
    HEAD = 8
    PIECE = _OVERHEAD + _LARGEST
    LIMIT = 2 * PIECE

    def _length(self, at: int) -> int:
        _, function, _, count = _HEAD.unpack_from(self._buffer, at + 2)
        if count > _LARGEST:
            return 0
        return _OVERHEAD + (count if function == Function.WRITE else 0)


class AnswerParser(FramedParser[Answer]):
    """Finds replies and streamed frames, for a host."""

    HEADER = b"\xaa"
    HEAD = 8
    PIECE = LONGEST
    LIMIT = 2 * PIECE
    INSIDE = 13  # the shortest frame with data that the board sends by itself

    def _length(self, at: int) -> int:
        buffer = self._buffer
        kind = bytes(buffer[at : at + 2])
        if kind == Reply.HEADER:
            _, function, _, count = _HEAD.unpack_from(buffer, at + 2)
            if count > _LARGEST:
                return 0
            return _OVERHEAD + (count if function == Function.READ else 1)
        if kind not in _ANSWERS:
            return 0
        size = _AROUND + int.from_bytes(buffer[at + 3 : at + 5], "little")
        right = size <= LONGEST if kind == Stream.HEADER else size == _AROUND + 35
        return size if right else 0

    def _decode(self, raw: bytes) -> Answer:
        return _ANSWERS[raw[:2]].from_bytes(raw)


def connected(data: bytes) -> tuple[str, ...]:
    """Return the fingers whose tips are connected; raises `CodecError` for unknown slots."""
    known = bytearray(CONNECTED_SIZE)
    for byte, bit in _SLOTS.values():
        known[byte] |= 1 << bit
    if len(data) != CONNECTED_SIZE or any(b & ~k for b, k in zip(data, known, strict=True)):
        raise CodecError(f"a touch board cannot have the connected slots {data.hex(' ')}")
    return tuple(name for name, (byte, bit) in _SLOTS.items() if data[byte] >> bit & 1)


def connected_bytes(fingers: Sequence[str]) -> bytes:
    """Return `Register.CONNECTED` of a board with the tips of some fingers."""
    slots = bytearray(CONNECTED_SIZE)
    for name in fingers:
        byte, bit = _SLOTS[name]
        slots[byte] |= 1 << bit
    return bytes(slots)


def tip_counts(data: bytes) -> dict[str, int]:
    """Return the number of taxels of each fingertip; raises `CodecError`."""
    if len(data) != COUNTS_SIZE:
        raise CodecError(f"{len(data)} bytes are not a table of taxels")
    counts = struct.unpack(f"<{COUNTS_SIZE // 2}H", data)
    return {name: counts[_PER_SLOT * i + _TIP] for i, name in enumerate(FINGERS)}


def counts_bytes(counts: Mapping[str, int]) -> bytes:
    """Return `Register.COUNTS` of a board, for the number of taxels of each fingertip."""
    table = [0] * (COUNTS_SIZE // 2)
    for name, count in counts.items():
        table[_PER_SLOT * FINGERS.index(name) + _TIP] = count
    return struct.pack(f"<{len(table)}H", *table)


def resultants_bytes(fingers: Sequence[str], resultants: bytes) -> bytes:
    """Return `Register.RESULTANTS`, for the resultants of the connected fingertips."""
    table = bytearray(COUNTS_SIZE // 2 * _RESULTANT)
    for i, name in enumerate(fingers):
        at = _RESULTANT * (_PER_SLOT * FINGERS.index(name) + _TIP)
        table[at : at + _RESULTANT] = resultants[_RESULTANT * i : _RESULTANT * (i + 1)]
    return bytes(table)


def data_size(content: Content, counts: Sequence[int]) -> int:
    """Return the length of a frame's data [bytes], given the number of taxels of each finger."""
    resultants = _RESULTANT * len(counts) if content & Content.RESULTANTS else 0
    return resultants + (_TAXEL * sum(counts) if content & Content.TAXELS else 0)


@dataclass(frozen=True, slots=True)
class Forces:
    """The forces in a frame.

    Attributes:
        resultants: Forces on the connected fingertips ``(k, 3)`` [N]; z is the pressing force;
            ``NaN``: not in the frame.
        taxels: Forces on all of their taxels ``(n, 3)`` [N]; ``(0, 3)``: not in the frame.
    """

    resultants: FloatArray
    taxels: FloatArray

    @classmethod
    def from_bytes(cls, data: bytes, content: Content, counts: Sequence[int]) -> Self:
        """Decode a frame's data, given its content and the number of taxels of each finger.

        Raises `CodecError` if the length does not match.
        """
        if len(data) != data_size(content, counts):
            raise CodecError(f"{len(data)} bytes are not the data of {len(counts)} fingertips")
        resultants = np.full((len(counts), 3), math.nan)
        taxels, at = [np.zeros((0, 3))], 0
        for finger, count in enumerate(counts):
            if content & Content.RESULTANTS:
                # The high byte only extends the sign, and for z not even that is certain.
                raw = np.frombuffer(data, np.uint8, _RESULTANT, at)[::2]
                resultants[finger] = _newtons(raw.reshape(1, 3))[0]
                at += _RESULTANT
            if content & Content.TAXELS:
                raw = np.frombuffer(data, np.uint8, _TAXEL * count, at)
                taxels.append(_newtons(raw.reshape(count, 3)))
                at += _TAXEL * count
        return cls(resultants, np.concatenate(taxels))


def _newtons(raw: NDArray[np.uint8]) -> FloatArray:
    """Return forces ``(n, 3)`` [N] from bytes: x and y are signed, z is not."""
    forces = raw.astype(np.float64)
    sideways = raw[:, :2].view(np.int8)
    forces[:, :2] = sideways
    return forces * NEWTONS


def forces_bytes(resultants: FloatArray, taxels: Sequence[FloatArray], content: Content) -> bytes:
    """Return the data of a frame; arguments as in `Forces`, with the taxels by finger."""
    data = bytearray()
    for resultant, of_finger in zip(resultants, taxels, strict=True):
        if content & Content.RESULTANTS:
            for axis, force in enumerate(np.rint(resultant / NEWTONS).astype(int).tolist()):
                low = max(0, min(force, 255)) if axis == _NORMAL else max(-128, min(force, 127))
                data += bytes((low & 0xFF, 0xFF if low < 0 else 0))
        if content & Content.TAXELS:
            counts = np.rint(of_finger / NEWTONS)
            # Saturated, so that a large force does not wrap to the other sign.
            counts[:, :2] = counts[:, :2].clip(-128, 127)
            counts[:, 2] = counts[:, 2].clip(0, 255)
            data += (counts.astype(np.int64) & 0xFF).astype(np.uint8).tobytes()
    return bytes(data)
