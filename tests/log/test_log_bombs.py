"""Recordings that expand to gigabytes, or claim to: little memory is used, and a sentence said."""

from __future__ import annotations

import contextlib
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

from rtee.drivers.replay.states import RecordedStates
from rtee.errors import LogError
from rtee.log import read
from rtee.log.info import info
from rtee.log.recover import recover
from rtee.messages.mcap_chunk import LARGEST_CHUNK, DamagedChunkError, decompressed
from rtee.messages.schema import message_type
from rtee.messages.topics import ACTUATOR_STATES, TYPES

SIZE = 30_000_000
"""Bytes of the bomb: enough to be seen, and made within a tenth of a second."""


@pytest.fixture
def bomb(tmp_path: Path) -> Path:
    """A recording of some kilobytes with one state of a hand and megabytes of zeros."""
    kind = message_type(TYPES[ACTUATOR_STATES])
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2 * SIZE, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema(kind.name, "ros2msg", b"")
        channel = writer.register_channel(f"/claw/{ACTUATOR_STATES}", "cdr", schema)
        for k in range(4):
            writer.add_message(channel, k, bytes(SIZE // 4), k)
        writer.finish()
    assert path.stat().st_size < 10_000
    return path


def peak(do: Callable[[], object]) -> int:
    """Return the most memory that a call takes [bytes]; an error in words is an answer, too."""
    tracemalloc.start()
    with contextlib.suppress(LogError):
        do()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most


def test_zeros_without_end_are_not_unpacked(bomb: Path, tmp_path: Path) -> None:
    for do in (
        lambda: RecordedStates(bomb, "claw", ("a",)),
        lambda: read(bomb),
        lambda: info([bomb]),
        lambda: recover(bomb, tmp_path / "whole.mcap"),
    ):
        assert peak(do) < SIZE / 2
    with pytest.raises(LogError, match="a chunk is larger than the largest allowed"):
        RecordedStates(bomb, "claw", ("a",))


@pytest.mark.parametrize("size", [1 << 60, (1 << 64) - 1, 1 << 40])
@pytest.mark.parametrize("what", ["uncompressed", "records"])
def test_sizes_that_no_memory_has_are_refused(bomb: Path, size: int, what: str) -> None:
    data = bytearray(bomb.read_bytes())
    at = data.index(bytes([Opcode.CHUNK]), 8)
    # Behind opcode and length: two times, the uncompressed size, its checksum, and the name.
    place = at + 9 + 16 if what == "uncompressed" else at + 9 + 28 + 4 + len("zstd")
    data[place : place + 8] = struct.pack("<Q", size)
    bomb.write_bytes(data)
    for do in (
        lambda: RecordedStates(bomb, "claw", ("a",)),
        lambda: read(bomb),
        lambda: info([bomb]),
    ):
        assert peak(do) < SIZE / 2
    with pytest.raises(LogError):
        RecordedStates(bomb, "claw", ("a",))


def test_what_a_frame_says_counts_as_much_as_what_the_chunk_says() -> None:
    zstandard = pytest.importorskip("zstandard")
    lz4 = pytest.importorskip("lz4.frame")
    zeros = bytes(10_000_000)

    def chunk(compression: str, data: bytes, size: int) -> Chunk:
        return Chunk(compression, data, 0, 0, 0, size)

    small = [
        chunk("zstd", zstandard.compress(zeros), 100),
        chunk("zstd", zstandard.ZstdCompressor(write_content_size=False).compress(zeros), 100),
        chunk("lz4", lz4.compress(zeros), 100),
        chunk("lz4", lz4.compress(zeros, store_size=False), 100),
        chunk("zstd", zstandard.compress(b"x"), LARGEST_CHUNK + 1),
        chunk("zstd", b"no frame", 100),
        chunk("bzip2", b"", 0),
    ]
    tracemalloc.start()
    for each in small:
        with pytest.raises(DamagedChunkError):
            decompressed(each)
    assert tracemalloc.get_traced_memory()[1] < len(zeros) / 2
    tracemalloc.stop()
    right = chunk("lz4", lz4.compress(b"x" * 500), 500)
    assert decompressed(right) == b"x" * 500
