"""The digest at the end of a recording, read by `rtee.log.brief`."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rtee.loop.plan import Plan
from rtee.types import Event, EventKind, Goal, LoopStatistics, Result

if TYPE_CHECKING:
    from rtee.log.recording import Recording


def line_of(item: object, wall: int) -> list[Any]:
    """Return a digest's line for a recorded item at a time [ns since 1970], or an empty list."""
    match item:
        case Goal():
            what = item.what
            return ["goal", wall, item.goal_id, getattr(what, "action", ""), [*what.elements]]
        case Plan():
            return ["plan", wall, item.goal_id, item.action, item.timed]
        case Result():
            return ["result", wall, item.goal_id, item.outcome]
        # Traces of bus bytes are left out: there may be several in each tick.
        case Event() if item.kind != EventKind.TRACE:
            return ["event", wall, item.kind, item.source, item.text, item.severity]
        case LoopStatistics():
            return ["loop", wall, asdict(item)]
    return []


def lines_of(recording: Recording) -> Iterable[list[Any]]:
    """Yield the lines of a recording's digest."""
    topics = (
        recording.goals,
        recording.plans,
        recording.results,
        recording.events,
        recording.loop_statistics,
    )
    entries = sorted(
        (entry for topic in topics for entry in topic),
        key=lambda entry: (entry.wall, entry.sequence),
    )
    return filter(None, (line_of(entry.value, entry.wall) for entry in entries))


class Digest:
    """Lines of JSON, compressed as they come."""

    def __init__(self) -> None:
        # A small window, which takes an eighth of the usual memory: the lines are alike.
        self._stream = zlib.compressobj(wbits=12, memLevel=5)
        self._data = bytearray()
        self._last: Sequence[Any] = ()
        self.size = 0

    def add(self, line: Sequence[Any]) -> None:
        """Add a line; of the loop statistics only the last are kept, which cover the whole run."""
        if line[0] == "loop":
            self._last = line
        else:
            self._add(line)

    def _add(self, line: object) -> None:
        data = json.dumps(line, separators=(",", ":")).encode() + b"\n"
        self._data += self._stream.compress(data)
        self.size += len(data)

    def content(self, more: Mapping[str, Any]) -> bytes:
        """Return all lines, the last with fields of the file; no line may be added afterwards."""
        if self._last:
            self._add(self._last)
        self._add(more)
        return bytes(self._data + self._stream.flush())
