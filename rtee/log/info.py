"""Summarise a recording without reading all of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from operator import itemgetter
from pathlib import Path
from typing import Any

from rtee.log.brief import SECOND, Brief, brief, check_hands, rate_of, spans_of

_STATISTICS = ("rate", "ticks", "missed", "lateness_p99", "lateness_max", "dropped")


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a recording, with the type, the number and the rate [Hz] of its messages."""

    topic: str
    type: str
    messages: int
    rate: float


@dataclass(frozen=True, slots=True)
class GoalInfo:
    """A goal, with times since the recording's start [s]; `rtee.log.Span` has the outcomes."""

    name: str
    start: float
    end: float
    outcome: str
    goal_id: str


@dataclass(frozen=True, slots=True)
class EventInfo:
    """An event, with its time since the recording's start [s]."""

    t: float
    kind: str
    source: str
    text: str
    severity: str


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """Summary of a recording.

    Attributes:
        files: Files with their sizes [bytes].
        library: Name of the software that wrote the files.
        start: Time of the first message since 1970 [ns].
        duration: Time from the first to the last message [s].
        finished: Whether all files were closed properly.
        attachments: Names with sizes [bytes].
        loop: The last loop statistics by name (`rtee.types.LoopStatistics`).
        notes: Sentences about problems of the files.
    """

    files: tuple[tuple[Path, int], ...]
    hand: str
    library: str
    start: int
    duration: float
    finished: bool
    metadata: Mapping[str, str]
    topics: tuple[TopicInfo, ...]
    attachments: tuple[tuple[str, int], ...]
    goals: tuple[GoalInfo, ...]
    events: tuple[EventInfo, ...]
    loop: Mapping[str, float] | None
    notes: tuple[str, ...]

    @property
    def rate(self) -> float:
        """Rate of the loop [Hz]; 0 if unknown."""
        return rate_of(self.metadata)

    @property
    def size(self) -> int:
        """Size of all files [bytes]."""
        return sum(size for _, size in self.files)

    @property
    def size_per_minute(self) -> float:
        """Average size per minute [bytes]; 0 for an empty recording."""
        return 60.0 * self.size / self.duration if self.duration else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as data for JSON."""
        return asdict(self) | {
            "files": [{"path": str(path), "bytes": size} for path, size in self.files],
            "start": iso(self.start),
            "bytes": self.size,
            "bytes_per_minute": round(self.size_per_minute),
            "topics": [asdict(each) | {"rate": round(each.rate, 3)} for each in self.topics],
            "attachments": dict(self.attachments),
            "loop": self.loop and {name: self.loop[name] for name in _STATISTICS},
        }


def iso(wall_ns: int) -> str:
    """Return a time since 1970 [ns] as ISO 8601 in UTC; empty for 0."""
    if not wall_ns:
        return ""
    return datetime.fromtimestamp(wall_ns / SECOND, UTC).isoformat(timespec="milliseconds")


def info(paths: Sequence[Path], *, deep: bool = False) -> RecordingInfo:
    """Return the summary of a recording's files.

    Of files that rtee has closed, only the end is read; with ``deep`` every record is, so that
    damage in between is noticed. Raises `LogError` as `rtee.log.read` does.
    """
    files = [(None if deep else brief(path)) or _whole(path) for path in paths]
    check_hands({each.path: each.hand for each in files})
    start = min((each.start for each in files if each.end), default=0)
    duration = (max(each.end for each in files) - start) / SECOND

    def all_of(kind: str) -> list[list[Any]]:
        told = (entry for each in files for entry in each.of(kind))
        return [[(wall - start) / SECOND, *rest] for wall, *rest in sorted(told, key=itemgetter(0))]

    counts: dict[tuple[str, str], int] = {}
    for each in files:
        for topic, kind, count in each.topics:
            counts[topic, kind] = counts.get((topic, kind), 0) + count
    spans = spans_of(
        ((t, *rest) for t, *rest in all_of("goal")),
        {goal_id: action for _, goal_id, action, _ in all_of("plan")},
        {goal_id: (t, outcome) for t, goal_id, outcome in all_of("result")},
        duration,
    )
    loop = all_of("loop")
    return RecordingInfo(
        files=tuple((each.path, each.size) for each in files),
        hand=files[0].hand,
        library=files[0].library,
        start=start,
        duration=duration,
        finished=all(each.finished for each in files),
        metadata=files[0].metadata,
        topics=tuple(
            TopicInfo(topic, kind, count, count / duration if duration else 0.0)
            for (topic, kind), count in sorted(counts.items())
            if count
        ),
        attachments=tuple((name, size) for name, size in files[0].attachments),
        goals=tuple(GoalInfo(*span) for span in spans),
        events=tuple(EventInfo(*event) for event in all_of("event")),
        loop=loop[-1][1] if loop else None,
        notes=tuple(note for each in files for note in each.notes),
    )


def _whole(path: Path) -> Brief:
    """Read all of a file, which need not be closed or written by rtee."""
    # Only here: NumPy and what imports it take longer than most summaries.
    from rtee.log.digest import lines_of
    from rtee.log.file_index import index_file
    from rtee.log.reader import read_indexed
    from rtee.messages.topics import DIGESTED

    file = index_file(path)
    recording = read_indexed([file], DIGESTED)
    return Brief(
        path=path,
        size=file.size,
        library=file.library,
        hand=file.hand,
        metadata=recording.metadata,
        topics=[
            (channel.topic, schema.name if schema else "", file.count(number))
            for number, channel in file.channels.items()
            for schema in (file.schemas.get(channel.schema_id),)
        ],
        attachments=[(name, len(each.data)) for name, each in file.attachments.items()],
        start=recording.start,
        end=recording.end,
        told=list(lines_of(recording)),
        finished=recording.finished,
        notes=recording.notes,
    )
