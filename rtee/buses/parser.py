"""The contract of sans-I/O frame parsers, and parsers for frames with a header and for lines."""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, Protocol, TypeVar

F = TypeVar("F")


class CodecError(ValueError):
    """Bytes that a codec cannot read, or values that it cannot write."""


class Parser(Protocol[F]):
    """Finds frames in a stream of bytes; does no I/O and never raises, whatever the bytes.

    The longest frame of the protocol limits its buffer. Garbage does not hide the next good frame.
    """

    @property
    def errors(self) -> int:
        """Number of frames with a wrong checksum or format so far."""
        ...

    def feed(self, data: bytes) -> list[F]:
        """Receive bytes and return the frames that they complete, in order."""
        ...

    def reset(self) -> None:
        """Forget the bytes of an incomplete frame."""
        ...


@dataclass(frozen=True, slots=True)
class Framing:
    """The frames of a protocol: header, fields, length, body, check.

    Attributes:
        header: The first bytes.
        fields: Bytes between header and length.
        check: Returns the check of all bytes before it.
        most: Largest value of the length field.
        least: Smallest value of the length field.
        extra: Bytes that the length field counts besides the body.
        size: Size of the length field [bytes], 1 or 2, low byte first.
        tail: Size of the check [bytes].
        head: Bytes before the body.
        around: Bytes of a frame that its length field does not count.
    """

    header: bytes
    fields: int
    check: Callable[[bytes], bytes]
    most: int
    least: int = 0
    extra: int = 0
    size: int = 1
    tail: int = 1

    head: int = field(init=False)
    around: int = field(init=False)

    def __post_init__(self) -> None:
        # Computed once, since every frame needs them.
        head = len(self.header) + self.fields + self.size
        object.__setattr__(self, "head", head)
        object.__setattr__(self, "around", head + self.tail - self.extra)

    def length(self, raw: bytes | bytearray, at: int = 0) -> int:
        """Return the size of the frame at an index [bytes]; 0 if its length field is invalid."""
        end = at + self.head - 1
        length = raw[end] if self.size == 1 else raw[end - 1] | raw[end] << 8
        return length + self.around if self.least <= length <= self.most else 0

    def sealed(self, fields: Sequence[int], body: bytes) -> bytes:
        """Return a frame as sent; raises `CodecError` for one that is too long or short."""
        length = len(body) + self.extra
        counted = (length,) if self.size == 1 else (length & 0xFF, length >> 8)
        try:
            raw = self.header + bytes((*fields, *counted)) + body
        except ValueError:  # more than a byte
            length = -1
        if not self.least <= length <= self.most:
            raise CodecError(f"a frame cannot carry {len(body)} bytes with {list(fields)}")
        return raw + self.check(raw)

    def opened(self, raw: bytes) -> tuple[bytes, bytes]:
        """Return the fields and the body of a frame; raises `CodecError`."""
        if len(raw) < self.head + self.tail or not raw.startswith(self.header):
            start = self.header.hex(" ").upper()
            raise CodecError(
                f"a frame must begin with {start} and have at least {self.head + self.tail} bytes"
            )
        if len(raw) != self.length(raw):
            length = raw[self.head - self.size : self.head].hex(" ")
            raise CodecError(f"the frame declares a length of {length}, but has {len(raw)} bytes")
        sealed, tail = raw[: -self.tail], raw[-self.tail :]
        if self.check(sealed) != tail:
            raise CodecError("the checksum does not match")
        return raw[len(self.header) : self.head - self.size], sealed[self.head :]


class FramedParser(ABC, Generic[F]):
    """Finds frames that begin with a header and contain their length.

    A bad frame does not hide a good one.

    Attributes:
        FRAMING: The frames; sets ``HEADER``, ``HEAD``, ``PIECE`` and ``LIMIT``, which a parser
            without it sets by itself.
        FRAME: Their class, with the method ``from_bytes``.
        HEADER: The first bytes of every frame.
        HEAD: Number of bytes from which the length can be read.
        PIECE: Most bytes examined at once: the longest frame.
        LIMIT: Most bytes kept.
        INSIDE: Shortest frame to look for inside an incomplete one; shorter ones occur too often by
            chance.
        errors: Number of frames dropped for a bad length, content or checksum.
    """

    FRAMING: ClassVar[Framing]
    FRAME: ClassVar[Any]
    HEADER: ClassVar[bytes]
    HEAD: ClassVar[int]
    PIECE: ClassVar[int]
    LIMIT: ClassVar[int]
    INSIDE: ClassVar[int] = 1

    def __init_subclass__(cls) -> None:
        """Derive the attributes that follow from `FRAMING`."""
        if (framing := cls.__dict__.get("FRAMING")) is not None:
            cls.HEADER, cls.HEAD = framing.header, framing.head
            cls.PIECE = framing.most + framing.around
            cls.LIMIT = 2 * cls.PIECE

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.errors = 0

    def _length(self, at: int) -> int:
        """Return the size of the frame with its header at ``at`` [bytes]; 0 if it is invalid."""
        return self.FRAMING.length(self._buffer, at)

    def _decode(self, raw: bytes) -> F:
        """Decode the bytes of a whole frame; raises `ValueError`."""
        frame: F = self.FRAME.from_bytes(raw)
        return frame

    @property
    def pending(self) -> int:
        """Number of bytes kept of an incomplete frame."""
        return len(self._buffer)

    def reset(self) -> None:
        """Discard the bytes of an incomplete frame."""
        self._buffer.clear()

    def feed(self, data: bytes) -> list[F]:
        """Receive bytes and return the frames that they complete."""
        if not self._buffer and len(data) <= self.PIECE:
            frame = self._only(data)
            if frame is not None:
                return [frame]
        frames: list[F] = []
        # In pieces, so that a flood of garbage cannot make the buffer grow.
        for start in range(0, len(data), self.PIECE):
            self._buffer += data[start : start + self.PIECE]
            self._scan(frames)
        return frames

    def _only(self, data: bytes) -> F | None:
        """Return the frame if ``data`` is exactly one, as most answers are; otherwise ``None``."""
        # In the buffer only because `_length` reads it there.
        self._buffer += data
        length = self._length(0) if len(data) >= self.HEAD else 0
        self._buffer.clear()
        if length != len(data) or not data.startswith(self.HEADER):
            return None
        try:
            return self._decode(data)
        except ValueError:
            return None

    def _scan(self, frames: list[F]) -> None:
        buffer, header = self._buffer, self.HEADER
        while buffer:
            start = buffer.find(header)
            if start < 0:
                sizes = range(len(header) - 1, 0, -1)
                # The beginning of a header at the very end may be completed by the next bytes.
                keep = next((k for k in sizes if buffer.endswith(header[:k])), 0)
                del buffer[: len(buffer) - keep]
                return
            del buffer[:start]
            if len(buffer) < self.HEAD:
                return
            length = self._length(0)
            if length > len(buffer):
                inside = self._inside()
                if not inside:
                    return
                self.errors += 1
                del buffer[:inside]
                continue
            frame = self._tried(0, length)
            if frame is None:
                self.errors += 1
                # Only one byte instead of the frame, since a good one may begin inside a bad one.
                del buffer[:1]
            else:
                frames.append(frame)
                del buffer[:length]

    def _tried(self, at: int, length: int) -> F | None:
        if not length:
            return None
        try:
            return self._decode(bytes(self._buffer[at : at + length]))
        except ValueError:
            return None

    def _inside(self) -> int:
        """Return the offset of a whole frame inside an incomplete one, or 0.

        A header within noise announces bytes that never come; it must not delay the next frame.
        """
        buffer = self._buffer
        start = buffer.find(self.HEADER, 1)
        while 0 < start <= len(buffer) - self.HEAD:
            length = self._length(start)
            fits = length >= self.INSIDE and start + length <= len(buffer)
            if fits and self._tried(start, length) is not None:
                return start
            start = buffer.find(self.HEADER, start + 1)
        return 0


class LineParser:
    """Finds lines of printable ASCII characters.

    Attributes:
        errors: Number of lines dropped: too long, or with other bytes.
    """

    def __init__(self, end: bytes = b"\r\n", most: int = 256) -> None:
        """Look for lines that end with ``end`` and have at most ``most`` characters before it."""
        self.errors = 0
        self._end, self._most = end, most
        self._buffer = b""

    def reset(self) -> None:
        """Forget an incomplete line."""
        self._buffer = b""

    def feed(self, data: bytes) -> list[str]:
        """Receive bytes and return the lines that they complete, without their ends."""
        *found, rest = (self._buffer + data).split(self._end)
        # Keep enough of an overlong line to recognise it as such.
        self._buffer = rest[-self._most - len(self._end) :]
        lines = []
        for raw in found:
            text = raw.decode("ascii", "replace")
            if len(raw) <= self._most and raw.isascii() and text.isprintable():
                lines.append(text)
            else:
                self.errors += 1
        return lines
