"""Walk through the records of an MCAP file, complete or truncated, with checks of each."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Header,
    Metadata,
    Schema,
)

from rtee.log.brief import MAGIC
from rtee.log.resync import DAMAGE, HEAD, DamagedRecordError, Finder, Record
from rtee.messages.mcap_chunk import DamagedChunkError, decompressed

R = TypeVar(
    "R",
    Header,
    Metadata,
    Attachment,
    Schema,
    Channel,
    Chunk,
)


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
        record: R = kind.read(ReadDataStream(BytesIO(content)))
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


def records_of(data: bytes, *opcodes: int) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of the records of some kinds, such as those in a chunk."""
    position = 0
    while position + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, position)
        position += HEAD.size
        if opcode in opcodes:
            yield opcode, data[position : position + length]
        position += length
