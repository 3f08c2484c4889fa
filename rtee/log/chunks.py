"""Chunks of an MCAP file: messages collected, compressed and indexed in memory."""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk, McapRecord
from numpy.typing import NDArray

from rtee.log.brief import INDEX_ENTRY
from rtee.messages.tick_columns import encode_ticks

MESSAGE = struct.Struct("<BQHIQQ")
"""Layout of the head of a message record: opcode, length, channel, sequence, two times [ns]."""

INDEX = struct.Struct("<BQHI")
"""Layout of the head of a message index record: opcode, length, channel, bytes of entries."""

AFTER_LENGTH = MESSAGE.size - 9  # bytes of a record's head behind opcode and length
_INDEX_AFTER_LENGTH = INDEX.size - 9  # the same of a message index
_LEAST_ROOM = 65536  # first size of a chunk's buffer [byte]: a second of a small hand
_SPARE = 1.25
"""A buffer is this many times as large as the chunk that it was made for: later chunks are about as
large."""


Entries = Mapping[int, tuple[NDArray[np.uint64], NDArray[np.uint64]]]
"""Channel to log times [ns since 1970] and offsets of its messages in a chunk."""


def _memory(size: int) -> mmap.mmap:
    """Return a mapping of this size [bytes], which returns to the system as a whole."""
    return mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)


def _array(values: list[int]) -> NDArray[np.uint64]:
    return np.array(values, dtype=np.uint64)


def message_head(channel: int, sequence: int, time: int, size: int) -> bytes:
    """Return the head of the record of a message of ``size`` bytes at ``time`` [ns]."""
    return MESSAGE.pack(Opcode.MESSAGE, AFTER_LENGTH + size, channel, sequence, time, time)


def record_bytes(record: McapRecord) -> bytes:
    """Return the bytes of a record."""
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A compressed chunk with its index, ready to be written.

    Attributes:
        index: The message index records that follow the chunk record.
        index_offsets: Channel to the offset of its record in ``index``.
        counts: Channel to its number of messages.
        start: Earliest log time [ns since 1970].
        end: Latest log time [ns since 1970].
        compression: ``zstd``, ``lz4`` or empty.
        digest: Its lines of the digest (`rtee.log.digest`); ``None``: not known.
    """

    record: bytes | memoryview
    index: bytes | memoryview
    index_offsets: Mapping[int, int]
    counts: Mapping[int, int]
    start: int
    end: int
    compressed_size: int
    uncompressed_size: int
    compression: str = "zstd"
    digest: Sequence[Sequence[Any]] | None = None

    @property
    def size(self) -> int:
        """Size of the chunk and its index in a file [bytes]."""
        return len(self.record) + len(self.index)

    @property
    def messages(self) -> int:
        """Number of messages in the chunk."""
        return sum(self.counts.values())


def index_records(entries: Entries) -> tuple[bytes, dict[int, int]]:
    """Return message index records and the offset of each channel's.

    The entries are, by channel, log times [ns] and offsets of its messages in the chunk.
    """
    records = bytearray()
    where: dict[int, int] = {}
    for channel, (times, offsets) in entries.items():
        where[channel] = len(records)
        size = INDEX_ENTRY * len(times)
        records += INDEX.pack(Opcode.MESSAGE_INDEX, _INDEX_AFTER_LENGTH + size, channel, size)
        table = np.empty((len(times), 2), dtype="<u8")
        table[:, 0] = times
        table[:, 1] = offsets
        records += table.tobytes()
    return bytes(records), where


@dataclass(frozen=True, slots=True)
class InColumns:
    """Settings for packing ticks column by column.

    Attributes:
        channel: Channel of their message.
        every: Every n-th tick is also written as messages, for other software.
    """

    channel: int
    every: int


class _Room:
    """Buffers of one size, reused for every chunk: buffers that grow would fragment the memory."""

    def __init__(self) -> None:
        self._memory = _memory(_LEAST_ROOM)
        self.size = 0

    def append(self, data: bytes | bytearray) -> None:
        begin, memory = self.size, self._memory
        self.size = end = begin + len(data)
        if end > len(memory):
            self._memory = larger = _memory(int(_SPARE * end))
            larger[:begin] = memory[:begin]
            memory = larger
        memory[begin:end] = data

    @contextmanager
    def taken(self) -> Iterator[memoryview]:
        """Return a view of the collected bytes, not a copy, and begin a new collection."""
        size, self.size = self.size, 0
        with memoryview(self._memory) as whole, whole[:size] as view:
            yield view
        # A writer that had fallen behind has made chunks of many seconds.
        if len(self._memory) > max(_LEAST_ROOM, 2 * size):
            self._memory = _memory(max(_LEAST_ROOM, int(_SPARE * size)))


class ChunkBuilder:
    """Collects messages and packs them into chunks.

    Besides single messages it accepts blocks, which hold the same messages on the same channels
    every time, as the recorder writes them at every tick. Their index is computed when the chunk is
    packed.

    Args:
        block: Channel and offset of each message record in a block.
        level: Level of zstd compression.
        columns: How blocks are packed column by column; ``None``: they are not.
    """

    def __init__(
        self,
        block: Sequence[tuple[int, int]] = (),
        level: int = 3,
        columns: InColumns | None = None,
    ) -> None:
        self._block = tuple(block)
        self._columns = columns
        self._compressor = zstandard.ZstdCompressor(level=level, write_content_size=True)
        self._room = _Room()
        self._ticks = self._room if columns is None else _Room()
        self._clear()

    def _clear(self) -> None:
        self._times: dict[int, list[int]] = {}
        self._offsets: dict[int, list[int]] = {}
        self._block_times: list[int] = []
        self._block_offsets: list[int] = []

    @property
    def size(self) -> int:
        """Size of the collected messages [bytes]."""
        return self._room.size + (self._ticks.size if self._columns else 0)

    @property
    def blocks(self) -> int:
        """Number of collected blocks."""
        return len(self._block_times)

    def add(self, channel: int, sequence: int, time: int, data: bytes) -> None:
        """Add a message of log time ``time`` [ns since 1970]."""
        self._times.setdefault(channel, []).append(time)
        self._offsets.setdefault(channel, []).append(self._room.size)
        self._room.append(message_head(channel, sequence, time, len(data)))
        self._room.append(data)

    def add_block(self, time: int, block: bytes | bytearray) -> None:
        """Add the message records of one tick of log time ``time`` [ns since 1970]."""
        self._block_times.append(time)
        self._block_offsets.append(self._ticks.size)
        self._ticks.append(block)

    def pack(self) -> PackedChunk | None:
        """Return the collected messages as a chunk, or ``None``, and begin a new collection."""
        if self._columns is not None and self._block_times:
            self._turn(self._columns)
        if not self._room.size:
            return None
        entries = {
            channel: (_array(self._times[channel]), _array(self._offsets[channel]))
            for channel in self._times
        }
        if self._block_times:
            times = _array(self._block_times)
            offsets = _array(self._block_offsets)
            for channel, begin in self._block:
                # All blocks have the same layout, so that the index of a channel is that of the
                # blocks, shifted.
                entries[channel] = (times, offsets + np.uint64(begin))
        self._clear()
        with self._room.taken() as data:
            return pack(data, entries, self._compressor)

    def _turn(self, columns: InColumns) -> None:
        """Pack all blocks into one message, and keep every n-th of them as it is."""
        last, ticks = self._block_times[-1], len(self._block_times)
        with self._ticks.taken() as data:
            rows = np.frombuffer(data, np.uint8).reshape(ticks, -1)
            self.add(
                columns.channel, 0, last, encode_ticks(rows, [b for _, b in self._block], last)
            )
            self._block_times = self._block_times[:: columns.every]
            self._block_offsets = []
            for row in rows[:: columns.every]:
                self._block_offsets.append(self._room.size)
                self._room.append(row.tobytes())
            del rows, row  # the view is released


def pack(
    data: bytes | bytearray | memoryview, entries: Entries, compressor: zstandard.ZstdCompressor
) -> PackedChunk:
    """Return message records, one after the other, as a chunk.

    The entries are, by channel, log times [ns] and offsets of its messages in the records.
    """
    # As a stream in pieces of 128 kB: one-shot compression would first allocate memory for the
    # longest possible result.
    stream = compressor.compressobj(size=len(data))
    compressed = stream.compress(data) + stream.flush()
    start = min(int(times.min()) for times, _ in entries.values())
    end = max(int(times.max()) for times, _ in entries.values())
    record = record_bytes(
        Chunk(
            compression="zstd",
            data=compressed,
            message_start_time=start,
            message_end_time=end,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
    )
    index, where = index_records(entries)
    return PackedChunk(
        record=record,
        index=index,
        index_offsets=where,
        counts={channel: len(times) for channel, (times, _) in entries.items()},
        start=start,
        end=end,
        compressed_size=len(compressed),
        uncompressed_size=len(data),
    )
