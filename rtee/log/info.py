"""Summarise a recording without reading all of it."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from rtee.errors import MessageError
from rtee.log import column_reader
from rtee.log.file_index import FileIndex, index_file
from rtee.log.reader import read_indexed
from rtee.log.record_scanner import messages_of
from rtee.log.recording import Recording
from rtee.log.resync import DamagedRecordError
from rtee.messages import topics
from rtee.messages.codec import SECOND
from rtee.messages.convert import LOOP_STATISTICS
from rtee.types import LoopStatistics

_STATISTICS = ("rate", "ticks", "missed", "lateness_p99", "lateness_max", "dropped")
_FEW = topics.DIGESTED - {topics.LOOP_STATISTICS}


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a recording, with the type, the number and the rate [Hz] of its messages."""

    topic: str
    kind: str
    messages: int
    rate: float


@dataclass(frozen=True, slots=True)
class Info:
    """Summary of a recording: files and attachments with their sizes [bytes], topics with messages.

    Attributes:
        library: Name of the software that wrote the files.
        statistics: The last loop statistics.
        recording: Goals, results and events.
    """

    files: tuple[tuple[Path, int], ...]
    library: str
    topics: tuple[TopicInfo, ...]
    attachments: tuple[tuple[str, int], ...]
    statistics: LoopStatistics | None
    recording: Recording

    @property
    def size(self) -> int:
        """Size of all files [bytes]."""
        return sum(size for _, size in self.files)

    @property
    def size_per_minute(self) -> float:
        """Average size per minute [bytes]; 0 for an empty recording."""
        duration = self.recording.duration
        return 60.0 * self.size / duration if duration else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as data for JSON."""
        recording = self.recording
        return {
            "hand": recording.hand,
            "files": [{"path": str(path), "bytes": size} for path, size in self.files],
            "finished": recording.finished,
            "library": self.library,
            "start": iso(recording.start),
            "duration": recording.duration,
            "bytes": self.size,
            "bytes_per_minute": round(self.size_per_minute),
            "metadata": dict(recording.metadata),
            "topics": [
                {"topic": t.topic, "type": t.kind, "messages": t.messages, "rate": round(t.rate, 3)}
                for t in self.topics
            ],
            "attachments": dict(self.attachments),
            "goals": [
                _chosen(span, "name", "start", "end", "outcome", "goal_id")
                for span in recording.spans
            ],
            "events": [
                {"t": entry.t} | _chosen(entry.value, "kind", "source", "text", "severity")
                for entry in recording.events
                if entry.value.kind != "trace"
            ],
            "loop": self.statistics and _chosen(self.statistics, *_STATISTICS),
            "notes": list(recording.notes),
        }


def _chosen(value: object, *names: str) -> dict[str, Any]:
    return {name: getattr(value, name) for name in names}


def iso(wall_ns: int) -> str:
    """Return a time since 1970 [ns] as ISO 8601 in UTC; empty for 0."""
    if not wall_ns:
        return ""
    return datetime.fromtimestamp(wall_ns / SECOND, UTC).isoformat(timespec="milliseconds")


def info(paths: Sequence[Path], *, deep: bool = False) -> Info:
    """Return the summary of a recording's files.

    Of files that rtee has closed, only begin and end are read; with ``deep`` every record is, so
    that damage in between is noticed. Raises `LogError` as `rtee.log.read` does.
    """
    file_indexes = [index_file(path, brief=not deep) for path in paths]
    recording = read_indexed(file_indexes, _FEW)
    return Info(
        files=tuple((each.path, each.size) for each in file_indexes),
        library=file_indexes[0].library,
        topics=tuple(_topics(file_indexes, recording.duration)),
        attachments=tuple(
            (name, len(attachment.data)) for name, attachment in file_indexes[0].attachments.items()
        ),
        statistics=_statistics(file_indexes[-1]),
        recording=recording,
    )


def _topics(file_indexes: Sequence[FileIndex], duration: float) -> list[TopicInfo]:
    counts: dict[tuple[str, str], int] = {}
    for each in file_indexes:
        for number, channel in each.channels.items():
            schema = each.schemas.get(channel.schema_id)
            key = (channel.topic, schema.name if schema else "")
            counts[key] = counts.get(key, 0) + each.count(number)
    return [
        TopicInfo(topic, kind, count, count / duration if duration else 0.0)
        for (topic, kind), count in sorted(counts.items())
        if count
    ]


def _statistics(file: FileIndex) -> LoopStatistics | None:
    """Return the last loop statistics of a file."""
    topic = topics.log_topic(file.hand, topics.LOOP_STATISTICS)
    number = next((k for k, channel in file.channels.items() if channel.topic == topic), None)
    if number is None:
        return None
    if file.digest is not None:
        return _last(file.digest, number)
    with file.path.open("rb") as stream:
        # The last ones cover the whole run, so that no other chunk need be decompressed.
        for place in reversed(file.chunks):
            # The last chunk of a killed writer has no index and must be decompressed.
            if place.indexes and number not in place.indexes:
                continue
            try:
                data, _ = messages_of(place.record.read(stream))
            except DamagedRecordError:
                continue
            if (last := _last(data, number)) is not None:
                return last
    return None


def _last(data: bytes, number: int) -> LoopStatistics | None:
    """Return the last valid loop statistics on a channel among records."""
    starts = column_reader.walk(data).get(number, ())[-1:]
    last = column_reader.messages(np.frombuffer(data, dtype=np.uint8), starts)
    for message in () if last is None else last.contents():
        with contextlib.suppress(MessageError):
            return LOOP_STATISTICS.decode(message)
    return None
