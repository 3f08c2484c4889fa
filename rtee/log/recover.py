"""Repair a recording whose writer was killed."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
from mcap.opcode import Opcode

from rtee.errors import LogError
from rtee.hand.files import failing, replaced
from rtee.log import column_reader
from rtee.log.chunks import PackedChunk, index_records
from rtee.log.digest import lines_of
from rtee.log.file_index import FileIndex, damaged_chunks, index_file
from rtee.log.mcapfile import McapFile, Preamble
from rtee.log.reader import read_indexed
from rtee.log.record_scanner import DamagedRecordError, messages_of
from rtee.log.rotation import OPEN, being_written
from rtee.messages import topics
from rtee.messages.codec import SECOND
from rtee.messages.mcap_chunk import HEAD

_BLOCK: Final = 1 << 20
"""Bytes that are copied at once, which bounds the memory."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Report of a repair.

    Attributes:
        untouched: Whether the file was complete and needed no repair.
        chunks: Number of recovered chunks.
        messages: Number of recovered messages.
        damaged: Number of damaged chunks left out.
        lost_bytes: Length of the unusable end of the file [bytes].
        seconds: Time from the first to the last message [s].
        damage: Sentences about damage that cannot be repaired.
        left_out: Sentences about damage that the repaired file no longer has.
    """

    path: Path
    untouched: bool
    chunks: int
    messages: int
    damaged: int
    lost_bytes: int
    seconds: float
    damage: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def recover(
    path: Path | str, output: Path | str | None = None, *, in_place: bool = False
) -> Recovery:
    """Repair a recording that was never closed or is damaged.

    Keeps every intact chunk with a new index, in a file that appears only when it is complete.

    Args:
        path: The recording.
        output: Path of the repaired file, which must not exist. Unless given, it is
            ``NAME_recovered.mcap`` beside the recording, and not written if that is whole already.
        in_place: Replace the recording instead.

    Raises:
        LogError: if the file is being written, cannot be read, is not an MCAP file or has messages
            outside chunks, or if the repaired file exists or cannot be written.
    """
    path = Path(path)
    if being_written(path):
        raise LogError(OPEN, path=path)
    content = index_file(path)
    beside = path if in_place else path.with_name(f"{path.stem}_recovered{path.suffix}")
    target = beside if output is None else Path(output)
    with failing("cannot be recovered", path, LogError), path.open("rb") as stream:
        damaged = sum(1 for _ in damaged_chunks(content))
        whole = content.finished and not damaged and not content.repairable
        if whole and output is None:
            return _report(content, path, 0, untouched=True)
        if target.exists() and not in_place:
            raise LogError("exists already; give another file with --out", path=target)
        if whole:
            with _written(target) as temporary, temporary.open("wb") as copy:
                copy.writelines(_blocks(path, stream))
            return _report(content, target, 0, untouched=True)
        if content.loose:
            raise LogError(
                "has messages outside of chunks, which rtee never writes; recovering would lose "
                "them",
                path=path,
            )
        if not (content.chunks or content.channels or content.attachments or content.metadata):
            raise LogError("contains nothing to recover", path=path)
        with _written(target) as temporary:
            file = McapFile(temporary, _preamble(content), sync=False)
            try:
                for chunk in _chunks(content, stream):
                    file.write(chunk)
            finally:
                file.close()
    # Behind the data of a file that was closed is its summary, which is written again.
    lost = 0 if content.finished else content.size - content.good
    done = _report(index_file(target), target, damaged, untouched=False, lost=lost)
    lasting = tuple(note for note in content.damage if note not in content.repairable)
    return replace(done, damage=lasting, left_out=content.repairable)


@contextlib.contextmanager
def _written(target: Path) -> Iterator[Path]:
    """Yield a path whose file replaces the target, as `replaced`; raises `LogError`."""
    with failing("cannot be written", target, LogError), replaced(target) as temporary:
        yield temporary


def _blocks(path: Path, stream: BinaryIO) -> Iterator[bytes]:
    """Yield the content of an open file; raises `LogError` if it cannot be read."""
    with failing("cannot be read", path, LogError):
        stream.seek(0)
        while block := stream.read(_BLOCK):
            yield block


def _report(
    content: FileIndex, path: Path, damaged: int, *, untouched: bool, lost: int = 0
) -> Recovery:
    return Recovery(
        path=path,
        untouched=untouched,
        chunks=len(content.chunks),
        messages=sum(chunk.count(number) for chunk in content.chunks for number in chunk.indexes),
        damaged=damaged,
        lost_bytes=lost,
        seconds=(content.end - content.start) / SECOND,
        damage=content.damage,
    )


def _preamble(content: FileIndex) -> Preamble:
    return Preamble(
        library=content.library,
        metadata=content.metadata,
        attachments=tuple(content.attachments.values()),
        schemas=tuple(content.schemas.values()),
        channels=tuple(content.channels.values()),
    )


def _chunks(file: FileIndex, stream: BinaryIO) -> Iterator[PackedChunk]:
    """Yield the intact chunks, each with an index made from its messages."""
    try:
        digest = [*lines_of(read_indexed([file], topics.DIGESTED))]
    except LogError:  # a recording of other software
        digest = None
    for place in file.chunks:
        with failing("cannot be read", file.path, LogError):
            content = place.record.read(stream)
        try:
            data, chunk = messages_of(content)
        except DamagedRecordError:
            continue
        array = np.frombuffer(data, dtype=np.uint8)
        entries = {}
        for number, offsets in column_reader.walk(data).items():
            if number in file.channels:
                found = column_reader.messages(array, offsets)
                assert found is not None  # noqa: S101 - they were found there
                entries[number] = found.times.astype(np.uint64), found.starts.astype(np.uint64)
        if not entries:
            continue
        index, where = index_records(entries)
        yield PackedChunk(
            # The content as it is, still compressed, behind a head that may have been damaged.
            record=HEAD.pack(Opcode.CHUNK, len(content)) + content,
            index=index,
            index_offsets=where,
            counts={number: len(times) for number, (times, _) in entries.items()},
            start=chunk.message_start_time,
            end=chunk.message_end_time,
            compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
            compression=chunk.compression,
            digest=digest,
        )
        digest = digest and []  # the first part carries the whole digest
