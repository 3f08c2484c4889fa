"""Summarise a recording, a large one without reading all of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from operator import itemgetter
from pathlib import Path
from shlex import quote
from typing import Any

from rtee.errors import LogError
from rtee.log.brief import SECOND, Brief, brief, check_hands, rate_of, spans_of

_READ_WHOLE = 64_000_000
"""Size up to which recordings are read whole [bytes]: some four minutes of a large hand at 1 kHz,
for a third of a second."""

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
        damage: Those notes that report damage, one for each damaged file.
        checked: Whether all of the files was read, so that all damage is known.
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
    damage: tuple[str, ...]
    checked: bool

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

    Of files that rtee has closed, only the end is read if they are large. With ``deep`` all of
    them are read, so that damage in between is noticed. Raises `LogError` as `rtee.log.read` does.
    """
    ends = [brief(path) for path in paths]
    checked = deep or sum(each.size for each in ends if each is not None) <= _READ_WHOLE
    files = [
        _whole(path) if end is None else _checked(end) if checked else end
        for path, end in zip(paths, ends, strict=True)
    ]
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
        damage=tuple(note for each in files for note in each.damage),
        checked=checked,
    )


def _checked(end: Brief) -> Brief:
    """Return the summary of a file with what is damaged in the rest of it.

    Goals and events of a damaged chunk remain: the end of the file has them, too.
    """
    from rtee.log.file_index import MOST_TOLD, damaged_chunks, index_file, others_damaged

    try:
        file = index_file(end.path)
        lost = [*damaged_chunks(file)]
    except LogError as error:  # the disk does not give all of it
        return _noted(end, end.notes, [str(error)], recoverable=False)
    told = [file.lost(place, error) for place, error in lost[:MOST_TOLD]]
    if len(lost) > MOST_TOLD:
        told.append(others_damaged(len(lost) - MOST_TOLD))
    return _noted(
        replace(end, finished=file.finished),
        file.notes,
        (*file.damage, *told),
        recoverable=not file.loose and bool(file.repairable or lost),
    )


def _whole(path: Path) -> Brief:
    """Read all of a file, which need not be closed or written by rtee."""
    # Only here: NumPy and what imports it take longer than most summaries.
    from rtee.log.digest import lines_of
    from rtee.log.file_index import damaged_chunks, index_file
    from rtee.log.reader import read_indexed
    from rtee.messages.topics import DIGESTED

    file = index_file(path)
    recording = read_indexed([file], DIGESTED, every=True)
    summary = Brief(
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
    )
    repairable = file.repairable or any(True for _ in damaged_chunks(file))
    return _noted(
        summary,
        recording.notes,
        recording.damage,
        recoverable=not file.loose and bool(repairable),
    )


def _noted(file: Brief, notes: Iterable[str], damage: Sequence[str], *, recoverable: bool) -> Brief:
    """Return the summary of a file with one note about all damage, and its other notes."""
    name = f"{file.path.name}: "
    told: tuple[str, ...] = ()
    if damage:
        text = "; ".join(sentence.removeprefix(name) for sentence in damage)
        if recoverable:
            text += f"; `rtee log recover {quote(str(file.path))}` writes a file of the rest"
        told = (name + text,)
    others = (f"{name}{note.removeprefix(name)}" for note in notes if note not in damage)
    return replace(file, notes=(*told, *others), damage=told)
