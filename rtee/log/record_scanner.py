"""Walk through the records of an MCAP file, complete or truncated, with checks of each."""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO, NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk, McapRecord

from rtee.messages.mcap_chunk import HEAD, LARGEST_CHUNK, MAGIC, DamagedChunkError, decompressed

DAMAGE = 0
"""Opcode of bytes that are not a record; real records never have it."""

LATEST = 2**63 - 1
"""Latest log time accepted [ns since 1970]: in the year 2262, the limit of NumPy."""

_OWN = 0x80  # first opcode of records that other software may define for itself
_FOOTER = struct.Struct("<BQQQI")  # head, beginning of the summary, of its offsets, checksum
_CHUNK = struct.Struct("<QQQI")  # beginning of a chunk's content: start, end, size, checksum
_REACH = HEAD.size + _CHUNK.size + 8  # bytes that the pattern of a chunk looks at, at most
_FIRST_BLOCK = 4096  # bytes searched first: most damage is short
_LARGEST_BLOCK = 1 << 20  # most bytes searched at once, which bounds the memory
_PREFIXES = {4: struct.Struct("<I"), 8: struct.Struct("<Q")}

_BEGIN = re.compile(
    rb"\x06(?=.{%d}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0))" % (8 + _CHUNK.size), re.S
)
"""The beginning of a chunk: opcode, and a compression's name with its length in its place."""


class _RecordLayout(NamedTuple):
    """Layout of a content (MCAP specification, "Records").

    Attributes:
        parts: For each string, map or array: bytes before it, and bytes of its length [bytes].
        rest: Bytes behind the last one.
    """

    parts: tuple[tuple[int, int], ...]
    rest: int = 0


_LAYOUTS: dict[int, _RecordLayout] = {
    Opcode.HEADER: _RecordLayout(((0, 4), (0, 4))),
    Opcode.FOOTER: _RecordLayout((), 20),
    Opcode.SCHEMA: _RecordLayout(((2, 4), (0, 4), (0, 4))),
    Opcode.CHANNEL: _RecordLayout(((4, 4), (0, 4), (0, 4))),
    Opcode.CHUNK: _RecordLayout(((_CHUNK.size, 4), (0, 8))),
    Opcode.MESSAGE_INDEX: _RecordLayout(((2, 4),)),
    Opcode.CHUNK_INDEX: _RecordLayout(((32, 4), (8, 4)), 16),
    Opcode.ATTACHMENT: _RecordLayout(((16, 4), (0, 4), (0, 8)), 4),
    Opcode.ATTACHMENT_INDEX: _RecordLayout(((40, 4), (0, 4))),
    Opcode.STATISTICS: _RecordLayout(((42, 4),)),
    Opcode.METADATA: _RecordLayout(((0, 4), (0, 4))),
    Opcode.METADATA_INDEX: _RecordLayout(((16, 4),)),
    Opcode.SUMMARY_OFFSET: _RecordLayout((), 17),
    Opcode.DATA_END: _RecordLayout((), 4),
}

_CHECKED = (
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.CHUNK,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
)
"""Kinds whose content is checked when it is read."""


class DamagedRecordError(ValueError):
    """A record whose content is invalid."""


@dataclass(frozen=True, slots=True)
class Record:
    """A record in a file.

    Attributes:
        opcode: Its kind, or `DAMAGE` for bytes that are not a record.
        offset: Offset of its content in the file [bytes].
        length: Length of its content [bytes].
    """

    opcode: int
    offset: int
    length: int

    @property
    def end(self) -> int:
        """Offset of the end in the file [bytes]."""
        return self.offset + self.length

    def read(self, stream: BinaryIO, most: int | None = None) -> bytes:
        """Return the content, or at most its first ``most`` bytes."""
        stream.seek(self.offset)
        length = self.length if most is None else min(most, self.length)
        data = stream.read(length)
        if len(data) != length:
            raise DamagedRecordError("the file ends within a record")
        return data


class Finder:
    """Finds records in a file of ``size`` bytes.

    A search never begins before the end of the previous find, so scanning a file takes a time
    proportional to its size.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.size = os.fstat(stream.fileno()).st_size

    def at(self, position: int) -> Record | None:
        """Return the record that begins at a position [bytes], or ``None`` if none does."""
        head = self._read(position, HEAD.size)
        if len(head) < HEAD.size:
            return None
        opcode, length = HEAD.unpack(head)
        offset = position + HEAD.size
        said = self._length(opcode, offset)
        if said == length:
            return Record(opcode, offset, length)
        if opcode == DAMAGE or not self._followed(offset + length):
            return None
        if opcode in _CHECKED or opcode not in _LAYOUTS or (said or length) < length:
            # Written by a later version, or damaged in a way that its reader notices.
            return Record(opcode, offset, length)
        return Record(DAMAGE, position, HEAD.size + length)

    def after(self, position: int) -> int | None:
        """Return where the scan continues after damage that begins at a position [bytes].

        This is the next chunk, otherwise the summary, otherwise the footer. Returns ``None`` if
        there is none of them.
        """
        ends = [end for end in self._ends() if end > position]
        chunk = self._search(position + 1, ends[0] if ends else self.size)
        if chunk is not None:
            return chunk
        return next((end for end in ends if self._confirmed(end)), None)

    def _read(self, position: int, size: int) -> bytes:
        self._stream.seek(position)
        return self._stream.read(size)

    def _length(self, opcode: int, offset: int) -> int | None:
        """Return the length that a content has as a record of a kind [bytes]."""
        layout = _LAYOUTS.get(opcode)
        if layout is None:
            return None
        position = offset
        for before, width in layout.parts:
            prefix = self._read(position + before, width)
            if len(prefix) < width:
                return None
            position += before + width + _PREFIXES[width].unpack(prefix)[0]
            if position > self.size:
                return None
        position += layout.rest
        return position - offset if position <= self.size else None

    def _is_chunk(self, position: int) -> bool:
        """Return whether a record that looks like a chunk agrees with its content."""
        if not self._confirmed(position):
            return False
        start, end, size, checksum = _CHUNK.unpack(self._read(position + HEAD.size, _CHUNK.size))
        # Without a checksum, a chunk could not be distinguished from other bytes.
        return bool(checksum and start <= end <= LATEST and size <= LARGEST_CHUNK)

    def _confirmed(self, position: int) -> bool:
        """Return whether the head at a position is plausible and agrees with its content."""
        head = self._read(position, HEAD.size)
        if len(head) < HEAD.size:
            return False
        opcode, length = HEAD.unpack(head)
        offset = position + HEAD.size
        if opcode == Opcode.MESSAGE or opcode >= _OWN:
            return int(offset + length) <= self.size
        return bool(self._length(opcode, offset) == length)

    def _followed(self, end: int) -> bool:
        """Return whether the file, or a record, ends at an offset [bytes]."""
        return end == self.size or (end < self.size and self._confirmed(end))

    def _search(self, position: int, stop: int) -> int | None:
        """Return the offset of the first chunk from a position on, below a stop [bytes]."""
        block = _FIRST_BLOCK
        while position < stop:
            # The overlap contains the bytes that the pattern needs after the last opcode.
            data = self._read(position, block + _REACH)
            for match in _BEGIN.finditer(data):
                begin = position + match.start()
                if match.start() >= block or begin >= stop:
                    break
                if self._is_chunk(begin):
                    return begin
            position += block
            block = min(2 * block, _LARGEST_BLOCK)
        return None

    def _ends(self) -> tuple[int, ...]:
        """Return the offsets of summary and footer of a file that was closed, otherwise nothing."""
        position = self.size - _FOOTER.size - len(MAGIC)
        data = self._read(max(position, 0), _FOOTER.size + len(MAGIC))
        if position < len(MAGIC) or data[_FOOTER.size :] != MAGIC:
            return ()
        opcode, length, summary, _, _ = _FOOTER.unpack_from(data)
        if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - HEAD.size):
            return ()
        return (summary, position) if 0 < summary < position else (position,)


R = TypeVar("R", bound=McapRecord)


def scan(stream: BinaryIO) -> Iterator[Record]:
    """Yield the records of a file in order, up to the footer or the end of a truncated file.

    Damage in between is yielded as a record of kind `DAMAGE`.
    """
    finder = Finder(stream)
    position = len(MAGIC)
    while position + HEAD.size <= finder.size:
        record = finder.at(position)
        if record is None:
            end = finder.after(position)
            if end is None:
                return
            record = Record(DAMAGE, position, end - position)
        yield record
        if record.opcode == Opcode.FOOTER:
            return
        position = record.end


def parsed(kind: type[R], content: bytes) -> R:
    """Return the record of a kind in a content; raise `DamagedRecordError` if it is invalid."""
    try:
        # Every kind of record has it, but not their base.
        record: R = kind.read(ReadDataStream(BytesIO(content)))  # type: ignore[attr-defined]
    except (McapError, ValueError, OverflowError, struct.error, EOFError) as error:
        raise DamagedRecordError(f"damaged record: {error}") from error
    # Only attachments have a checksum of their own; chunks are checked when decompressed.
    if isinstance(record, Attachment) and not _checked(content):
        raise DamagedRecordError(f"attachment '{record.name}' fails its checksum")
    return record


def _checked(content: bytes) -> bool:
    """Return whether the checksum at the end of a content is right, or 0, which means none."""
    return int.from_bytes(content[-4:], "little") in (0, zlib.crc32(content[:-4]))


def messages_of(content: bytes) -> tuple[bytes, Chunk]:
    """Return the uncompressed records of a chunk, and the chunk."""
    chunk = parsed(Chunk, content)
    try:
        return decompressed(chunk), chunk
    except DamagedChunkError as error:
        raise DamagedRecordError(str(error)) from None
