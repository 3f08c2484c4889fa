"""Chunks of MCAP files of unknown origin, decompressed within bounds.

A file of a megabyte may claim, or expand to, any size. The declarations of a chunk are checked
before memory is used for it: against an absolute size, and against the compression that
measurements can reach.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import zstandard
from mcap.records import Chunk

MAGIC = b"\x89MCAP0\r\n"
"""The first and the last bytes of a file."""

HEAD = struct.Struct("<BQ")
"""Layout of the head of a record: opcode and length of the content."""

LARGEST_CHUNK = 1 << 27
"""Largest uncompressed size of a chunk that is accepted [bytes]: 128 MiB, a hundred times that of
rtee's chunks, and thirty times what other writers make."""

_MOST_RATIO = 1000
"""Largest factor of compression that is accepted: measurements have up to a hundred."""

_SPARE = 1 << 20
"""Size up to which any factor is accepted [bytes]: little harm, and small chunks of zeros exist."""


class DamagedChunkError(ValueError):
    """A damaged chunk, or one with impossible contents."""


def decompressed(chunk: Chunk) -> bytes:
    """Return the records in a chunk; raises `DamagedChunkError`."""
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK or size > _SPARE + _MOST_RATIO * len(chunk.data):
        raise DamagedChunkError("a chunk is larger than the largest allowed")
    data = _expanded(chunk, size)
    if len(data) != size:
        raise DamagedChunkError("a chunk does not have the size it declares")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise DamagedChunkError("a chunk fails its checksum")
    return data


def records_of(data: bytes, *opcodes: int) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of the records of some kinds, such as those in a chunk."""
    position = 0
    while position + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, position)
        position += HEAD.size
        if opcode in opcodes:
            yield opcode, data[position : position + length]
        position += length


def _expanded(chunk: Chunk, size: int) -> bytes:
    if not chunk.compression:
        return chunk.data
    try:
        if chunk.compression == "zstd":
            # Checked before decompressing, since a small frame may expand to any size.
            if zstandard.frame_content_size(chunk.data) > size:
                raise DamagedChunkError("a chunk does not have the size it declares")
            return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
        if chunk.compression == "lz4":
            import lz4.frame

            # One byte more than the given size reveals a larger content without expanding it.
            data: bytes = lz4.frame.LZ4FrameDecompressor().decompress(
                chunk.data, max_length=size + 1
            )
            return data
    except (zstandard.ZstdError, RuntimeError) as error:
        raise DamagedChunkError(f"a chunk cannot be decompressed: {error}") from None
    raise DamagedChunkError(f"a chunk has the unknown compression '{chunk.compression}'")
