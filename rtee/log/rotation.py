"""Names of recordings, the recordings of a hand, and the bound on their space."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from rtee.log.mcapfile import MAGIC, being_written
from rtee.log.record_scanner import Record, parsed, scan
from rtee.messages.codec import SECOND

METADATA = "rtee"
"""Name of the metadata record that every recording of rtee carries."""

FLIGHT = "flight"
"""Stands in a name instead of the part when the flight recorder wrote the file."""

_STAMP = r"\d{8}T\d{9}Z"
_NAME = re.compile(rf"(?P<hand>.+)_(?P<session>{_STAMP})_(?P<part>\d{{3,}}|{FLIGHT})\.mcap")
_FEW_RECORDS = 3  # records read to recognise a recording: header and metadata are the first


def session_name(wall_ns: int) -> str:
    """Return the part of a file's name that says when its recording began, in UTC."""
    moment = datetime.fromtimestamp(wall_ns // SECOND, UTC)
    return f"{moment:%Y%m%dT%H%M%S}{wall_ns // 1_000_000 % 1000:03d}Z"


def part_path(folder: Path, hand: str, session: str, part: int) -> Path:
    """Return the path of one part of a recording."""
    return folder / f"{hand}_{session}_{part:03d}.mcap"


def flight_path(folder: Path, hand: str, session: str) -> Path:
    """Return the path of what the flight recorder writes."""
    return folder / f"{hand}_{session}_{FLIGHT}.mcap"


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """A file that is a recording by its name.

    Attributes:
        path: The file.
        hand: The hand's name.
        session: When the recording began.
        part: Number of the part; ``None`` when the flight recorder wrote it.
        size: Its size [bytes].
    """

    path: Path
    hand: str
    session: str
    part: int | None
    size: int


def parse_name(path: Path) -> RecordingFile | None:
    """Return what a file's name says, ``None`` if it is not a recording's or the file is gone."""
    found = _NAME.fullmatch(path.name)
    if found is None:
        return None
    try:
        size = path.stat().st_size
    except OSError:
        return None
    part = None if found["part"] == FLIGHT else int(found["part"])
    return RecordingFile(path, found["hand"], found["session"], part, size)


def recordings(folder: Path, hand: str | None = None) -> list[RecordingFile]:
    """Return the files in a folder that are recordings by their names, oldest first."""
    try:
        paths = list(folder.glob("*.mcap"))
    except OSError:
        return []
    found = [file for path in paths if (file := parse_name(path)) is not None]
    return sorted(
        (file for file in found if hand in (None, file.hand)),
        key=lambda file: (file.session, file.part if file.part is not None else -1, file.path.name),
    )


def parts_of(path: Path) -> list[Path]:
    """Return all parts of the recording that a file belongs to, in order; itself at least."""
    file = parse_name(path)
    if file is None or file.part is None:
        return [path]
    return [
        other.path
        for other in recordings(path.parent, file.hand)
        if other.session == file.session and other.part is not None
    ]


def is_ours(path: Path, hand: str) -> bool:
    """Whether a file's content, too, says that it is a recording of this hand."""
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return False
            records: list[Record] = []
            for record in scan(stream):
                records.append(record)
                if len(records) == _FEW_RECORDS:
                    break
            for record in records:
                if record.opcode == Opcode.METADATA:
                    found = parsed(Metadata, record.read(stream))
                    if found.name == METADATA and found.metadata.get("hand") == hand:
                        return True
    except (OSError, ValueError):
        return False
    return False


class Retention:
    """Keeps the recordings of a hand within a bound by removing the oldest.

    Only files that are recordings of this hand by name and by content are ever removed.

    Args:
        folder: The folder.
        hand: The hand's name.
        limit: Bound on their sizes together [bytes].
    """

    def __init__(self, folder: Path, hand: str, limit: float) -> None:
        self._folder = folder
        self._hand = hand
        self._limit = limit
        self._others = 0
        self._ours: dict[Path, bool] = {}

    def look(self, *current: Path) -> None:
        """Look again at the files in the folder other than those that are being written."""
        self._others = sum(file.size for file in self._files(current))

    def _files(self, current: tuple[Path, ...]) -> list[RecordingFile]:
        return [file for file in recordings(self._folder, self._hand) if file.path not in current]

    def keep_within(self, size: int, *current: Path) -> list[Path]:
        """Remove the oldest recordings until the rest and ``size`` bytes are within the bound.

        Args:
            size: What the files that are being written take [bytes].
            current: Those files; never removed.

        Returns:
            The files removed.
        """
        removed: list[Path] = []
        # Usually so: then the folder is not even listed.
        if self._others + size <= self._limit:
            return removed
        self.look(*current)
        for file in self._files(current):
            if self._others + size <= self._limit:
                break
            if file.path not in self._ours:
                self._ours[file.path] = is_ours(file.path, self._hand)
            # By name alone it might be somebody else's file: removing needs the content's word,
            # too.
            if not self._ours[file.path] or being_written(file.path):
                continue
            try:
                file.path.unlink()
            except OSError:
                continue
            self._others -= file.size
            removed.append(file.path)
        return removed
