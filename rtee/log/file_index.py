"""Index the content of a file in one pass, without decompressing anything."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Footer, Header, Metadata, Schema

from rtee.errors import LogError
from rtee.hand.files import failing
from rtee.log.brief import DIGEST, INDEX_ENTRY, SECOND
from rtee.log.record_scanner import (
    DAMAGE,
    LATEST,
    DamagedRecordError,
    Record,
    messages_of,
    parsed,
    scan,
)
from rtee.log.rotation import METADATA, being_written
from rtee.messages.mcap_chunk import HEAD, MAGIC, records_of

_DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_INDEX_HEAD = struct.Struct("<HI")
_CHUNK_TIMES = struct.Struct("<QQ")
_CHECKSUM = 4  # bytes of the checksum at the end of the footer
_BLOCK = 1 << 20  # most bytes read at once for a checksum, which bounds the memory

_LIBRARY = "rtee"
"""Prefix of the library's name in files written by this software."""

_SUMMARY = (
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.STATISTICS,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
)
"""Kinds of records that only follow the data."""


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """Position of a chunk in a file, its log times [ns since 1970], and its indexes by channel."""

    record: Record
    start: int
    end: int
    indexes: dict[int, Record] = field(default_factory=dict)

    def count(self, channel: int) -> int:
        """Return the number of messages on a channel, according to the index."""
        index = self.indexes.get(channel)
        return 0 if index is None else (index.length - _INDEX_HEAD.size) // INDEX_ENTRY


@dataclass(frozen=True, slots=True)
class FileIndex:
    """The content of a file.

    Attributes:
        size: Size of the file [bytes].
        library: Name of the software that wrote it.
        finished: Whether the file was closed; otherwise it is being written, or its writer was
            killed.
        good: Offset up to which the file is intact [bytes].
        metadata: Records of metadata by name.
        attachments: The attachments by name.
        schemas: The schemas by identifier.
        channels: The channels by identifier.
        loose: Number of messages outside chunks, which only other software writes.
        notes: Sentences about problems of the file.
        damage: Those notes that report damage.
        repairable: Those of them about damage that a recovered file no longer has.
    """

    path: Path
    size: int
    library: str
    finished: bool
    good: int
    metadata: Mapping[str, Mapping[str, str]]
    attachments: Mapping[str, Attachment]
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]
    chunks: tuple[ChunkPlace, ...]
    loose: int
    notes: tuple[str, ...]
    damage: tuple[str, ...] = ()
    repairable: tuple[str, ...] = ()

    @property
    def values(self) -> Mapping[str, str]:
        """The metadata that rtee wrote; empty for files of other software."""
        return self.metadata.get(METADATA, {})

    @property
    def hand(self) -> str:
        """Name of the hand in the metadata, otherwise in the first topic with joint states."""
        if "hand" in self.values:
            return self.values["hand"]
        for channel in self.channels.values():
            head, _, tail = channel.topic.strip("/").rpartition("/")
            if tail == "joint_states":
                return head
        return ""

    def count(self, channel: int) -> int:
        """Return the number of messages on a channel, according to the indexes."""
        return sum(chunk.count(channel) for chunk in self.chunks)

    def lost(self, place: ChunkPlace, error: DamagedRecordError) -> str:
        """Describe a damaged chunk and what is lost with it."""
        count = sum(map(place.count, place.indexes))
        what, verb = (f"{count} messages", "are") if count > 1 else ("anything", "is")
        start, end = ((at - self.start) / SECOND for at in (place.start, place.end))
        return f"{error}; {what} recorded from {start:.2f} s to {end:.2f} s of the file {verb} lost"

    @property
    def start(self) -> int:
        """Earliest log time [ns since 1970]; 0 without messages."""
        return min((chunk.start for chunk in self.chunks), default=0)

    @property
    def end(self) -> int:
        """Latest log time [ns since 1970]; 0 without messages."""
        return max((chunk.end for chunk in self.chunks), default=0)


def index_file(path: Path | str) -> FileIndex:
    """Index the content of a file; raises `LogError` if it cannot be opened or is not MCAP."""
    path = Path(path)
    with failing("cannot be read", path, LogError):
        if path.exists() and not path.is_file():
            raise LogError("is not a file", path=path)
        return _Indexer(path).look()


def damaged_chunks(file: FileIndex) -> Iterator[tuple[ChunkPlace, DamagedRecordError]]:
    """Read all chunks of a file, and yield those that are damaged.

    Raises `LogError` if the file cannot be read.
    """
    with failing("cannot be read", file.path, LogError), file.path.open("rb") as stream:
        for place in file.chunks:
            try:
                messages_of(place.record.read(stream))
            except DamagedRecordError as error:
                yield place, error


def _summary_sound(footer: Record, stream: BinaryIO) -> bool:
    """Return whether the checksum of the summary and the footer is right, or absent (0)."""
    said = parsed(Footer, footer.read(stream))
    if not said.summary_crc:
        return True
    position = said.summary_start or footer.offset - HEAD.size
    end = footer.end - _CHECKSUM
    if not 0 < position < end:
        return False
    stream.seek(position)
    found = 0
    while position < end:
        block = stream.read(min(_BLOCK, end - position))
        if not block:
            return False
        found = zlib.crc32(block, found)
        position += len(block)
    return found == said.summary_crc


class _Indexer:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._library = ""
        self._metadata: dict[str, Mapping[str, str]] = {}
        self._attachments: dict[str, Attachment] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[ChunkPlace] = []
        self._loose = 0
        self._notes: list[str] = []
        self._unreadable: list[str] = []
        self._damage = Damage()
        self._indexing = False
        self._repeats = False  # whether the summary is read, which repeats the definitions
        self._defined: tuple[dict[tuple[int, int], bytes], ...] = ({}, {})

    def look(self) -> FileIndex:
        with self._path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise LogError("is not an MCAP file", path=self._path)
            size = self._path.stat().st_size
            good = len(MAGIC)
            data = True
            finished = False
            for record in scan(stream):
                if record.opcode == Opcode.FOOTER:
                    stream.seek(record.end)
                    finished = stream.read(len(MAGIC)) == MAGIC
                    if finished and not _summary_sound(record, stream):
                        self._damage.summary = True
                elif record.opcode == Opcode.DATA_END or record.opcode in _SUMMARY:
                    data = False
                elif record.opcode == DAMAGE and not data:
                    self._damage.summary = True
                # The summary repeats the definitions, which only files of other software lack in
                # the data; all other records have been counted.
                elif data or record.opcode in _DEFINITIONS:
                    self._repeats = not data
                    try:
                        self._take(record, stream)
                    except DamagedRecordError as error:
                        self._unreadable.append(str(error))
                    good = record.end if data else good
            # Other software may write the definitions only inside chunks.
            if not self._channels:
                self._define_from_chunks(stream)
            stream.seek(-len(MAGIC), os.SEEK_END)
            closed = size > len(MAGIC) and stream.read() == MAGIC
        if not finished:
            if self._chunks:
                self._chunks[-1].indexes.clear()  # the index of the last chunk may be incomplete
            left = size - good if data else 0
            if not closed:
                self._notes.append(
                    "the file is still being written"
                    if being_written(self._path)
                    else "the file was not closed: its writer was killed"
                )
                if left:
                    self._notes[-1] += f"; {left} bytes at its end are unusable"
            elif left:
                self._lose(Record(DAMAGE, good, left))
                good = size
            else:
                self._damage.summary = True
        if all(self._defined) and self._defined[0] != self._defined[1] and self._ours:
            self._unreadable.append("the definitions of its messages are altered")
        repairable = self._damage.sentences([(chunk.start, chunk.end) for chunk in self._chunks])
        damage = (*self._unreadable, *repairable)
        return FileIndex(
            path=self._path,
            size=size,
            library=self._library,
            finished=finished,
            good=good,
            metadata=self._metadata,
            attachments=self._attachments,
            schemas=self._schemas,
            channels=self._channels,
            chunks=tuple(self._chunks),
            loose=self._loose,
            notes=(*damage, *self._notes),
            damage=damage,
            repairable=repairable,
        )

    def _define_from_chunks(self, stream: BinaryIO) -> None:
        """Read schemas and channels inside chunks, where other software writes them."""
        for chunk in self._chunks:
            try:
                data, _ = messages_of(chunk.record.read(stream))
                for opcode, content in records_of(data, *_DEFINITIONS):
                    self._define(opcode, content)
            except DamagedRecordError:
                continue

    def _define(self, opcode: int, content: bytes) -> None:
        """Take a schema or channel; the first of several copies counts."""
        # Definitions have no checksum, but two copies: in the data, and in the summary.
        defined = self._defined[self._repeats]
        if opcode == Opcode.SCHEMA:
            schema = parsed(Schema, content)
            self._schemas.setdefault(schema.id, schema)
            defined[opcode, schema.id] = content
        else:
            channel = parsed(Channel, content)
            self._channels.setdefault(channel.id, channel)
            defined[opcode, channel.id] = content

    def _take(self, record: Record, stream: BinaryIO) -> None:
        # An index belongs to the chunk before it, unless damage is in between.
        indexing, self._indexing = self._indexing, False
        match record.opcode:
            case Opcode.CHUNK:
                times = record.read(stream, _CHUNK_TIMES.size)
                if len(times) < _CHUNK_TIMES.size:
                    raise DamagedRecordError("a chunk is shorter than the shortest possible")
                start, end = _CHUNK_TIMES.unpack(times)
                if not start <= end <= LATEST:
                    raise DamagedRecordError("a chunk declares impossible times")
                self._chunks.append(ChunkPlace(record, start, end))
                self._indexing = True
            case Opcode.MESSAGE_INDEX:
                head = record.read(stream, _INDEX_HEAD.size)
                if indexing and len(head) == _INDEX_HEAD.size:
                    channel, _ = _INDEX_HEAD.unpack(head)
                    self._chunks[-1].indexes[channel] = record
                self._indexing = indexing
            case Opcode.HEADER:
                self._library = parsed(Header, record.read(stream)).library
            case Opcode.METADATA:
                metadata = parsed(Metadata, record.read(stream))
                self._metadata[metadata.name] = metadata.metadata
            case Opcode.ATTACHMENT:
                content = record.read(stream)
                attachment = parsed(Attachment, content)
                if self._ours and not any(content[-4:]):
                    # Attachments written by rtee always have a checksum.
                    self._unreadable.append(f"attachment '{attachment.name}' has lost its checksum")
                if attachment.name != DIGEST:  # a copy of messages, of which a part may be lost
                    self._attachments[attachment.name] = attachment
            case Opcode.SCHEMA | Opcode.CHANNEL:
                self._define(record.opcode, record.read(stream))
            case Opcode.MESSAGE if not self._ours:
                self._loose += 1
            case _ if record.opcode == DAMAGE:
                self._lose(record)
            case _ if self._ours:
                begin = record.offset - HEAD.size
                self._lose(Record(DAMAGE, begin, record.end - begin))

    @property
    def _ours(self) -> bool:
        """Whether rtee wrote the file, so that all kinds of its records are known."""
        return self._library.startswith(_LIBRARY)

    def _lose(self, record: Record) -> None:
        self._damage.gaps.append((record, len(self._chunks)))
        if self._chunks:
            self._chunks[-1].indexes.clear()  # some of its indexes may be damaged


_SHORTEST_CHUNK = 49
"""Least length of a chunk [bytes]: its head, and the fields of one without records."""

MOST_TOLD = 5
"""Most damaged places listed one by one, so that the notes stay readable."""


@dataclass(slots=True)
class Damage:
    """Damage that leaves the rest of a file readable.

    Attributes:
        gaps: Damaged bytes, each with the number of chunks before them.
        summary: Whether the summary at the end of the file is damaged.
    """

    gaps: list[tuple[Record, int]] = field(default_factory=list)
    summary: bool = False

    def sentences(self, times: Sequence[tuple[int, int]]) -> tuple[str, ...]:
        """Describe the damage in sentences, given each chunk's start and end time [ns]."""
        told = [_gap(record, chunks, times) for record, chunks in self.gaps[:MOST_TOLD]]
        others = self.gaps[MOST_TOLD:]
        if others:
            size = sum(record.length for record, _ in others)
            told.append(f"{size} bytes in {len(others)} further places are damaged and lost")
        if self.summary:
            told.append("the summary at the end of the file is damaged; nothing recorded is lost")
        return tuple(told)


def others_damaged(chunks: int) -> str:
    """Describe the damaged chunks, by their number, that are not listed one by one."""
    return f"further damaged chunks, which are lost: {chunks}"


def _gap(record: Record, chunks: int, times: Sequence[tuple[int, int]]) -> str:
    """Describe the data lost after the given number of chunks."""
    damaged = f"{record.length} bytes from byte {record.offset} on are damaged"
    if record.length < _SHORTEST_CHUNK:
        return damaged
    if not chunks:
        return f"{damaged}; what they held is lost"
    start = min(begin for begin, _ in times)
    before = (times[chunks - 1][1] - start) / SECOND
    if chunks == len(times):
        return f"{damaged}; anything recorded after {before:.2f} s of the file is lost"
    after = (times[chunks][0] - start) / SECOND
    return f"{damaged}; anything recorded from {before:.2f} s to {after:.2f} s of the file is lost"
