"""Read the summary at the end of a closed recording, without its messages and without NumPy."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Footer, SummaryOffset

from rtee.errors import LogError
from rtee.log.record_scanner import R, parsed
from rtee.messages.mcap_chunk import HEAD, MAGIC, records_of

DIGEST = "digest"
"""Name of the last attachment: goals, results, events and counts, as lines of JSON in a stream of
zlib, so that a summary reads only the end of a file."""

LARGEST_DIGEST = 1 << 25
"""Size from which a digest is left out [bytes]: 32 MB hold 90,000 goals, and would take memory."""

SECOND = 1_000_000_000
"""A second [ns]: here, too, as the modules of messages import NumPy."""

INDEX_ENTRY = 16
"""Bytes of an entry of a message index: log time and offset."""

_TAIL = HEAD.size + 20 + len(MAGIC)  # bytes of the footer and what follows it


@dataclass(frozen=True, slots=True)
class Brief:
    """The content of a recording's summary.

    Attributes:
        size: Size of the file [bytes].
        library: Name of the software that wrote it.
        hand: Name of the hand.
        metadata: Metadata that rtee wrote.
        topics: Each with the type and the number of its messages.
        attachments: Names and sizes [bytes].
        start: Earliest log time [ns since 1970]; 0 without messages.
        end: Latest log time [ns since 1970].
        told: Goals, plans, results, events and loop statistics, as `rtee.log.digest.line_of` makes
            them: each with its kind and its log time [ns since 1970] first.
        finished: Whether the file was closed.
        notes: Sentences about problems of the file.
        damage: Those notes that report damage.
    """

    path: Path
    size: int
    library: str
    hand: str
    metadata: Mapping[str, str]
    topics: Sequence[tuple[str, str, int]]
    attachments: Sequence[tuple[str, int]]
    start: int
    end: int
    told: Sequence[Sequence[Any]]
    finished: bool = True
    notes: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()

    def of(self, kind: str) -> Iterator[Sequence[Any]]:
        """Yield the entries of one kind, each without its first item, the kind."""
        return (each[1:] for each in self.told if each[0] == kind)


def brief(path: Path) -> Brief | None:
    """Read the summary at a file's end; ``None`` if rtee has not closed the file."""
    try:
        if not path.is_file():  # opening a named pipe would wait for its writer
            return None
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return None
            size = path.stat().st_size
            (footer,) = _found(Footer, Opcode.FOOTER, stream, size - _TAIL, _TAIL)
            begin = footer.summary_offset_start
            left = size - _TAIL - begin
            offsets = _found(SummaryOffset, Opcode.SUMMARY_OFFSET, stream, begin, left)
            group = {each.group_opcode: each for each in offsets}[Opcode.ATTACHMENT_INDEX]
            begin, length = group.group_start, group.group_length
            indexes = _found(AttachmentIndex, Opcode.ATTACHMENT_INDEX, stream, begin, length)
            index = {each.name: each for each in indexes}[DIGEST]
            length = min(index.length, LARGEST_DIGEST)
            (digest,) = _found(Attachment, Opcode.ATTACHMENT, stream, index.offset, length)
        lines = zlib.decompressobj().decompress(digest.data, 2 * LARGEST_DIGEST)
        *told, own = json.loads(b"[" + lines.rstrip().replace(b"\n", b",") + b"]")
        return Brief(path=path, size=size, told=told, **own)
    # Readers of the whole file report the damage.
    except (OSError, ValueError, KeyError, TypeError, zlib.error):
        return None


def _found(kind: type[R], opcode: Opcode, stream: BinaryIO, begin: int, size: int) -> list[R]:
    """Return the records of a kind in a part of a file, of ``size`` bytes."""
    stream.seek(begin)
    return [parsed(kind, content) for _, content in records_of(stream.read(size), opcode)]


def check_hands(hands: Mapping[Path, str]) -> None:
    """Raise `LogError` unless files, each with its hand, are recordings of one hand."""
    (_, first), *others = hands.items()
    for path, other in others:
        if other != first:
            raise LogError(f"is a recording of '{other}', not of '{first}'", path=path)


def actuators_of(metadata: Mapping[str, str]) -> list[str]:
    """Return the names of the actuators in the metadata of a file; none if it has none."""
    text = metadata.get("actuators", "")
    try:
        return [str(name) for name in json.loads(text)]
    except (ValueError, TypeError, RecursionError):
        return text.split()  # as older files have them


def rate_of(metadata: Mapping[str, str]) -> float:
    """Return the rate of the loop [Hz] in a recording's metadata; 0 if unknown."""
    try:
        return float(metadata.get("rate", "0"))
    except ValueError:
        return 0.0


def spans_of(
    goals: Iterable[tuple[float, str, str, Sequence[str]]],
    actions: Mapping[str, str],
    results: Mapping[str, tuple[float, str]],
    duration: float,
) -> Iterator[tuple[str, float, float, str, str]]:
    """Yield name, start and end [s], outcome and identifier of each goal, in order.

    Args:
        goals: Start [s], identifier, action and elements of each.
        actions: Actions of their plans by identifier.
        results: Ends [s] and outcomes by identifier.
        duration: Length of the recording [s].
    """
    goals = list(goals)
    # A goal whose result is missing was preempted by the next one at the latest.
    ends = [(t, "unknown") for t, *_ in goals[1:]] + [(duration, "running")]
    for (t, goal_id, action, elements), missing in zip(goals, ends, strict=False):
        end, outcome = results.get(goal_id, missing)
        yield " ".join((actions.get(goal_id, action), *elements)), t, end, outcome, goal_id
