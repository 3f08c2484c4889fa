"""Write an MCAP file that is readable at any time up to its last chunk.

All records that a reader needs (metadata, attachments, schemas, channels) precede the first chunk.
A chunk is written whole or not at all: after a failed write, the file is truncated to the end of
the chunk before. `mcap.writer` cannot do that, so this module lays out the file, with the records
of `mcap.records`.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from rtee.hand.files import flush_to_disk
from rtee.log.brief import DIGEST, LARGEST_DIGEST
from rtee.log.chunks import PackedChunk, record_bytes
from rtee.log.digest import Digest
from rtee.messages.mcap_chunk import MAGIC

PROFILE = "ros2"

_MODE = 0o640
"""Mode of a recording, readable only for the robot's user and group."""


@dataclass(frozen=True, slots=True)
class Preamble:
    """The records before the first chunk of a file.

    The library is the name and version of the software that writes the file; metadata are keyed by
    name.
    """

    library: str
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    attachments: Sequence[Attachment] = ()
    schemas: Sequence[Schema] = ()
    channels: Sequence[Channel] = ()


class McapFile:
    """An MCAP file being written, which must not exist before.

    Raises `OSError` if it cannot be made or written; it is then removed. With ``sync``, every chunk
    is flushed to the disk, so that it survives a power cut.

    Attributes:
        size: Size of the file [bytes].
        start: Earliest log time [ns since 1970]; 0 without messages.
        end: Latest log time, likewise.
    """

    def __init__(self, path: Path, preamble: Preamble, *, sync: bool = True) -> None:
        self.path = path
        self._sync = sync
        self._preamble = preamble
        # Already encoded for the summary, which saves memory: a file may have 100,000 chunks.
        self._chunks = bytearray()
        self._chunk_count = 0
        self._counts: dict[int, int] = {}
        self.start = 0
        self.end = 0
        self._digest: Digest | None = Digest()
        self._indexes: list[McapRecord] = []
        begin = self._begin()
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _MODE)
        with contextlib.suppress(OSError):  # not every file system has locks
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self.size = 0
        try:
            self._append(*begin)
            if sync:
                flush_to_disk(path.parent)
        except OSError:
            os.close(self._descriptor)
            path.unlink(missing_ok=True)
            raise

    @property
    def linked(self) -> bool:
        """Whether the path still names this file: users may remove or replace it."""
        try:
            return os.path.samestat(self.path.stat(), os.fstat(self._descriptor))
        except FileNotFoundError:
            return False

    def _begin(self) -> list[bytes]:
        """Return the beginning of the file in parts, which avoids copies of large attachments."""
        header = record_bytes(Header(profile=PROFILE, library=self._preamble.library))
        parts = [MAGIC, header]
        offset = len(MAGIC) + len(header)
        for name, values in self._preamble.metadata.items():
            record = record_bytes(Metadata(name=name, metadata=dict(values)))
            self._indexes.append(MetadataIndex(offset=offset, length=len(record), name=name))
            parts.append(record)
            offset += len(record)
        for attachment in self._preamble.attachments:
            parts.append(self._attached(attachment, offset))
            offset += len(parts[-1])
        parts += map(record_bytes, (*self._preamble.schemas, *self._preamble.channels))
        return parts

    def _attached(self, attachment: Attachment, offset: int) -> bytes:
        """Return the record of an attachment that will be at an offset, and note its index."""
        record = record_bytes(attachment)
        self._indexes.append(
            AttachmentIndex(
                offset=offset,
                length=len(record),
                log_time=attachment.log_time,
                create_time=attachment.create_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )
        return record

    def _append(self, *parts: bytes | memoryview) -> None:
        """Write all parts or nothing."""
        try:
            for part in parts:
                view = memoryview(part)
                while view:
                    # A write may be partial, as on a disk that is nearly full.
                    view = view[os.write(self._descriptor, view) :]
            if self._sync:
                os.fdatasync(self._descriptor)
        except OSError:
            with contextlib.suppress(OSError):
                # No reader could get past half a chunk.
                os.ftruncate(self._descriptor, self.size)
            with contextlib.suppress(OSError):
                # Truncating leaves the position behind the end, and the next write would leave a
                # hole.
                os.lseek(self._descriptor, self.size, os.SEEK_SET)
            raise
        self.size += sum(len(part) for part in parts)

    def write(self, chunk: PackedChunk) -> None:
        """Append a chunk; after an `OSError` the file is unchanged, and the next chunk may fit."""
        offset = self.size
        self._append(chunk.record, chunk.index)
        after = offset + len(chunk.record)
        self._chunk_count += 1
        self._chunks += record_bytes(
            ChunkIndex(
                message_start_time=chunk.start,
                message_end_time=chunk.end,
                chunk_start_offset=offset,
                chunk_length=len(chunk.record),
                message_index_offsets={k: after + v for k, v in chunk.index_offsets.items()},
                message_index_length=len(chunk.index),
                compression=chunk.compression,
                compressed_size=chunk.compressed_size,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self.start = min(self.start, chunk.start) if self.start else chunk.start
        self.end = max(self.end, chunk.end)
        for channel, count in chunk.counts.items():
            self._counts[channel] = self._counts.get(channel, 0) + count
        if self._digest is not None:
            for line in chunk.digest or ():
                self._digest.add(line)
            if chunk.digest is None or self._digest.size > LARGEST_DIGEST:
                self._digest = None

    def attach(self, name: str, data: bytes) -> None:
        """Append an attachment between two chunks; raises `OSError` as `write` does."""
        attachment = Attachment(self.end, self.end, name, "application/json", data)
        indexes = len(self._indexes)
        try:
            self._append(self._attached(attachment, self.size))
        except OSError:
            del self._indexes[indexes:]
            raise

    def close(self) -> None:
        """Write the summary and close the file; further calls do nothing.

        If the summary cannot be written, raises `OSError`; the file is closed without it and can be
        recovered.
        """
        if self._descriptor < 0:
            return
        try:
            self._append(*self._ending())
            # Without `sync`, too: a recording that was closed survives a power cut.
            os.fsync(self._descriptor)
        finally:
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=sum(isinstance(each, AttachmentIndex) for each in self._indexes),
            channel_count=len(self._preamble.channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunk_count,
            message_count=sum(self._counts.values()),
            metadata_count=len(self._preamble.metadata),
            message_start_time=self.start,
            message_end_time=self.end,
            schema_count=len(self._preamble.schemas),
        )

    def _own(self) -> dict[str, Any]:
        """Return the fields of `rtee.log.brief.Brief` that the file itself contains."""
        types = {schema.id: schema.name for schema in self._preamble.schemas}
        values = self._preamble.metadata.get("rtee", {})
        return {
            "library": self._preamble.library,
            "hand": values.get("hand", ""),
            "metadata": values,
            "topics": [
                (channel.topic, types.get(channel.schema_id, ""), self._counts.get(channel.id, 0))
                for channel in self._preamble.channels
            ],
            "attachments": [
                (each.name, each.data_size)
                for each in self._indexes
                if isinstance(each, AttachmentIndex)
            ],
            "start": self.start,
            "end": self.end,
        }

    def _ending(self) -> tuple[bytes, bytes]:
        last = b""
        if self._digest is not None and self.end:
            digest = self._digest.content(self._own())
            attachment = Attachment(self.end, self.end, DIGEST, "application/zlib", digest)
            last = self._attached(attachment, self.size)
        # 0: no checksum over the data, as each chunk has one.
        data_end = record_bytes(DataEnd(0))
        summary_start = self.size + len(last) + len(data_end)
        attachments = [index for index in self._indexes if isinstance(index, AttachmentIndex)]
        metadata = [index for index in self._indexes if isinstance(index, MetadataIndex)]
        groups: list[tuple[Opcode, bytes | bytearray]] = [
            (Opcode.SCHEMA, _joined(self._preamble.schemas)),
            (Opcode.CHANNEL, _joined(self._preamble.channels)),
            (Opcode.STATISTICS, _joined([self._statistics()])),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, _joined(attachments)),
            (Opcode.METADATA_INDEX, _joined(metadata)),
        ]
        summary = bytearray()
        offsets = bytearray()
        for opcode, records in groups:
            begin = len(summary)
            summary += records
            if len(summary) > begin:
                offsets += record_bytes(
                    SummaryOffset(
                        group_opcode=opcode,
                        group_start=summary_start + begin,
                        group_length=len(summary) - begin,
                    )
                )
        offset_start = summary_start + len(summary)
        summary += offsets
        # The checksum covers the summary and the footer up to itself: opcode, length 20, two
        # offsets.
        footer_head = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offset_start)
        footer = Footer(
            summary_start=summary_start,
            summary_offset_start=offset_start,
            summary_crc=zlib.crc32(footer_head, zlib.crc32(summary)),
        )
        return last, data_end + bytes(summary) + record_bytes(footer) + MAGIC


def _joined(records: Sequence[McapRecord]) -> bytes:
    return b"".join(map(record_bytes, records))
