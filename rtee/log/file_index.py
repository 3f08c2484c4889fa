"""Index the content of a file in one pass, without decompressing anything."""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from rtee.errors import LogError
from rtee.log.chunks import INDEX_ENTRY
from rtee.log.mcapfile import MAGIC
from rtee.log.record_scanner import (
    DamagedRecordError,
    Record,
    definitions_of,
    messages_of,
    parsed,
    scan,
)
from rtee.log.rotation import METADATA
from rtee.log.sink import reason

_DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_INDEX_HEAD = struct.Struct("<HI")
_CHUNK_TIMES = struct.Struct("<QQ")

_LIBRARY = "rtee"
"""Prefix of the library's name in files written by this software."""

_LATEST = 2**63 - 1
"""Latest log time accepted [ns since 1970]: in the year 2262, the limit of NumPy."""


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
class Survey:
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

    @property
    def values(self) -> Mapping[str, str]:
        """The metadata that rtee wrote; empty for files of other software."""
        return self.metadata.get(METADATA, {})

    @property
    def hand(self) -> str:
        """Name of the hand in the metadata, or else in the first topic with joint states."""
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

    @property
    def start(self) -> int:
        """Earliest log time [ns since 1970]; 0 without messages."""
        return min((chunk.start for chunk in self.chunks), default=0)

    @property
    def end(self) -> int:
        """Latest log time [ns since 1970]; 0 without messages."""
        return max((chunk.end for chunk in self.chunks), default=0)


def survey(path: Path | str) -> Survey:
    """Index the content of a file.

    Raises `LogError` if it cannot be opened or is not an MCAP file.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise LogError("is not a file", path=path)
        return _Surveyor(path).look()
    except OSError as error:
        raise LogError(f"cannot be read: {reason(error)}", path=path) from error


class _Surveyor:
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
        self._damage: list[str] = []

    def look(self) -> Survey:
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
                elif record.opcode == Opcode.DATA_END:
                    data = False
                # The summary after the data repeats the definitions; all other records have been
                # counted.
                elif data or record.opcode in _DEFINITIONS:
                    try:
                        self._take(record, stream)
                    except DamagedRecordError as error:
                        self._damage.append(str(error))
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
            self._notes.append(
                f"the file is damaged at byte {good}"
                if closed and left
                else "the file was not closed: it is being written, or its writer was killed"
            )
            if left:
                self._notes[-1] += f"; {left} bytes at its end are of no use"
        return Survey(
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
            notes=(*self._damage, *self._notes),
            damage=tuple(self._damage),
        )

    def _define_from_chunks(self, stream: BinaryIO) -> None:
        """Read schemas and channels inside chunks, where other software writes them."""
        for chunk in self._chunks:
            try:
                data, _ = messages_of(chunk.record.read(stream))
                for opcode, content in definitions_of(data):
                    self._define(opcode, content)
            except DamagedRecordError:
                continue

    def _define(self, opcode: int, content: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = parsed(Schema, content)
            self._schemas[schema.id] = schema
        else:
            channel = parsed(Channel, content)
            self._channels[channel.id] = channel

    def _take(self, record: Record, stream: BinaryIO) -> None:
        match record.opcode:
            case Opcode.CHUNK:
                times = record.read(stream, _CHUNK_TIMES.size)
                if len(times) < _CHUNK_TIMES.size:
                    raise DamagedRecordError("a chunk is shorter than any")
                start, end = _CHUNK_TIMES.unpack(times)
                if not start <= end <= _LATEST:
                    raise DamagedRecordError("a chunk says impossible times")
                self._chunks.append(ChunkPlace(record, start, end))
            case Opcode.MESSAGE_INDEX:
                head = record.read(stream, _INDEX_HEAD.size)
                if self._chunks and len(head) == _INDEX_HEAD.size:
                    channel, _ = _INDEX_HEAD.unpack(head)
                    # An index belongs to the chunk before it.
                    self._chunks[-1].indexes[channel] = record
            case Opcode.HEADER:
                self._library = parsed(Header, record.read(stream)).library
            case Opcode.METADATA:
                metadata = parsed(Metadata, record.read(stream))
                self._metadata[metadata.name] = metadata.metadata
            case Opcode.ATTACHMENT:
                content = record.read(stream)
                attachment = parsed(Attachment, content)
                if self._library.startswith(_LIBRARY) and not any(content[-4:]):
                    # Attachments written by rtee always have a checksum.
                    self._damage.append(f"attachment '{attachment.name}' has lost its checksum")
                self._attachments[attachment.name] = attachment
            case Opcode.SCHEMA | Opcode.CHANNEL:
                self._define(record.opcode, record.read(stream))
            case Opcode.MESSAGE:
                self._loose += 1
