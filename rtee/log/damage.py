"""What a recording has lost to damage, in sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from rtee.log.resync import Record
from rtee.messages.codec import SECOND

_SHORTEST_CHUNK = 49
"""Least length of a chunk [bytes]: its head, and the fields of one without records."""

_TOLD = 5
"""Most damaged places told one by one, so that the notes stay readable."""


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
        """Return the damage in sentences; times are those of each chunk's ends [ns]."""
        told = [_gap(record, chunks, times) for record, chunks in self.gaps[:_TOLD]]
        others = self.gaps[_TOLD:]
        if others:
            size = sum(record.length for record, _ in others)
            told.append(f"{size} bytes in {len(others)} further places are damaged and lost")
        if self.summary:
            told.append("the summary at the end of the file is damaged; nothing recorded is lost")
        return tuple(told)


def _gap(record: Record, chunks: int, times: Sequence[tuple[int, int]]) -> str:
    """Return what damaged bytes behind so many chunks have cost."""
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
