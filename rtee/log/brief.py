"""Read the summary at the end of a closed recording, without its messages and without NumPy."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode

from rtee.errors import LogError

MAGIC = b"\x89MCAP0\r\n"

DIGEST = "digest"
"""Name of the last attachment: goals, results, events and counts, as lines of JSON in a stream of
zlib, so that a summary reads only the end of a file."""

LARGEST_DIGEST = 1 << 25
"""Size from which a digest is left out [bytes]: 32 MB hold 90,000 goals, and would take memory."""

SECOND = 1_000_000_000
"""A second [ns]: here, too, as the modules of messages import NumPy."""

INDEX_ENTRY = 16
"""Bytes of an entry of a message index: log time and offset."""

_FIRST = 65536  # bytes in which the metadata are, behind the header alone
_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_FOOTER = struct.Struct("<BQQQI")  # its head, beginning of the summary, of its offsets, checksum
_OFFSET = struct.Struct("<BQBQQ")  # head of an offset, opcode of its group, begin, length
_ATTACHED = struct.Struct("<BQQQ")  # head of an attachment's index, its offset, its length
_TAIL = len(MAGIC) + _FOOTER.size
_NAMED = struct.pack("<I", len(DIGEST)) + DIGEST.encode()


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
        """Yield the entries of a kind, without the kind itself."""
        return (each[1:] for each in self.told if each[0] == kind)


def brief(path: Path) -> Brief | None:
    """Read the summary at a file's end; ``None`` if rtee has not closed the file."""
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return None
            size = path.stat().st_size
            stream.seek(size - _TAIL)
            tail = stream.read()
            opcode, length, _, offsets, _ = _FOOTER.unpack(tail[: _FOOTER.size])
            if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - _HEAD.size):
                return None
            stream.seek(offsets)
            groups = {
                group: (begin, length)
                for _, _, group, begin, length in _OFFSET.iter_unpack(
                    stream.read(size - _TAIL - offsets)
                )
            }
            begin, length = groups[Opcode.ATTACHMENT_INDEX]
            stream.seek(begin)
            indexes = stream.read(length)
            at = indexes.rindex(_NAMED) - _ATTACHED.size - 24  # two times and the size
            _, _, begin, length = _ATTACHED.unpack_from(indexes, at)
            stream.seek(begin)
            record = stream.read(min(length, LARGEST_DIGEST))
        content, checksum = record[_HEAD.size : -4], record[-4:]
        if zlib.crc32(content) != int.from_bytes(checksum, "little"):
            return None
        data = content[content.index(_NAMED) + len(_NAMED) :]
        data = data[
            4 + int.from_bytes(data[:4], "little") + 8 :
        ]  # media type, and size of the data
        lines = zlib.decompressobj().decompress(data, 2 * LARGEST_DIGEST)
        *told, own = json.loads(b"[" + lines.rstrip().replace(b"\n", b",") + b"]")
        return Brief(path=path, size=size, told=told, **own)
    # Readers of the whole file report the damage.
    except (OSError, ValueError, KeyError, TypeError, struct.error, zlib.error):
        return None


def check_hands(hands: Mapping[Path, str]) -> None:
    """Raise `LogError` unless files, each with its hand, are recordings of one hand."""
    (_, first), *others = hands.items()
    for path, other in others:
        if other != first:
            raise LogError(f"is a recording of '{other}', not of '{first}'", path=path)


def metadata_of(path: Path, name: str) -> dict[str, str] | None:
    """Return one of a file's first metadata records; ``None`` if it is not there, or not intact.

    Raises `OSError` if the file cannot be read.
    """
    with path.open("rb") as stream:
        data = stream.read(_FIRST)
    position = len(MAGIC)
    try:
        while data.startswith(MAGIC):
            opcode, length = _HEAD.unpack_from(data, position)
            position += _HEAD.size
            if opcode == Opcode.METADATA:
                found, at = _text(data, position)
                texts, end = [], at + 4 + int.from_bytes(data[at : at + 4], "little")
                at += 4
                while at < end:
                    text, at = _text(data, at)
                    texts.append(text)
                if found == name:
                    return dict(zip(texts[::2], texts[1::2], strict=True))
            position += length
    except (ValueError, struct.error):
        pass
    return None


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Return the text at a position, behind its length, and where it ends."""
    end = at + 4 + int.from_bytes(data[at : at + 4], "little")
    if not at + 4 <= end <= len(data):
        raise ValueError("is cut off")
    return data[at + 4 : end].decode(), end


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
