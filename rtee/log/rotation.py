"""Names of recordings, the recordings of a hand, and the limit of their disk space."""

from __future__ import annotations

import re
import stat
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from rtee.log.mcapfile import MAGIC, being_written
from rtee.log.record_scanner import parsed, scan
from rtee.messages.codec import SECOND

METADATA = "rtee"
"""Name of the metadata record that every recording of rtee carries."""

FLIGHT = "flight"
"""Replaces the number of the part in the names of the flight recorder's files."""

_STAMP = r"\d{8}T\d{9}Z"
_NAME = re.compile(rf"(?P<hand>.+)_(?P<session>{_STAMP})_(?P<part>\d{{3,}}|{FLIGHT})\.mcap")
_FEW_RECORDS = 3  # records read to recognise a recording: header and metadata are the first


def session_name(wall_ns: int) -> str:
    """Return the part of a file's name with the start of the recording, in UTC."""
    moment = datetime.fromtimestamp(wall_ns // SECOND, UTC)
    return f"{moment:%Y%m%dT%H%M%S}{wall_ns // 1_000_000 % 1000:03d}Z"


def part_path(folder: Path, hand: str, session: str, part: int) -> Path:
    """Return the path of one part of a recording."""
    return folder / f"{hand}_{session}_{part:03d}.mcap"


def flight_path(folder: Path, hand: str, session: str) -> Path:
    """Return the path of a file of the flight recorder."""
    return folder / f"{hand}_{session}_{FLIGHT}.mcap"


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """A file that is a recording by its name, with its size [bytes].

    The session is the start of the recording; a file of the flight recorder has no part.
    """

    path: Path
    hand: str
    session: str
    part: int | None
    size: int


def parse_name(path: Path) -> RecordingFile | None:
    """Return the recording at a path, ``None`` if its name is no recording's or it is gone."""
    match = _NAME.fullmatch(path.name)
    if match is None:
        return None
    try:
        status = path.stat()
    except OSError:
        return None
    if not stat.S_ISREG(status.st_mode):  # opening a named pipe would wait for ever
        return None
    part = None if match["part"] == FLIGHT else int(match["part"])
    return RecordingFile(path, match["hand"], match["session"], part, status.st_size)


def recordings(folder: Path, hand: str | None = None) -> list[RecordingFile]:
    """Return the files in a folder that are recordings by their names, oldest first."""
    try:
        paths = list(folder.glob("*.mcap"))
    except OSError:
        return []
    files = [file for path in paths if (file := parse_name(path)) is not None]
    return sorted(
        (file for file in files if hand in (None, file.hand)),
        key=lambda file: (file.session, file.part if file.part is not None else -1, file.path.name),
    )


def parts_of(path: Path) -> list[Path]:
    """Return all parts of a file's recording in order, at least the file itself."""
    file = parse_name(path)
    if file is None or file.part is None:
        return [path]
    return [
        other.path
        for other in recordings(path.parent, file.hand)
        if other.session == file.session and other.part is not None
    ]


def is_ours(path: Path, hand: str) -> bool:
    """Return whether the content of a file is a recording of this hand, too."""
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return False
            for record in islice(scan(stream), _FEW_RECORDS):
                if record.opcode == Opcode.METADATA:
                    metadata = parsed(Metadata, record.read(stream))
                    if metadata.name == METADATA and metadata.metadata.get("hand") == hand:
                        return True
    except (OSError, ValueError):
        return False
    return False


class Retention:
    """Limits the disk space of a hand's recordings in a folder [bytes] by removing the oldest.

    Removes only files that are recordings of this hand by name and by content.
    """

    def __init__(self, folder: Path, hand: str, limit: float) -> None:
        self._folder = folder
        self._hand = hand
        self._limit = limit
        self._others = 0
        self._ours: dict[Path, bool] = {}

    def look(self, *current: Path) -> None:
        """Read the sizes of the files in the folder again, except those being written."""
        self._others = sum(file.size for file in self._files(current))

    def _files(self, current: tuple[Path, ...]) -> list[RecordingFile]:
        return [file for file in recordings(self._folder, self._hand) if file.path not in current]

    def keep_within(self, size: int, *current: Path) -> list[Path]:
        """Remove the oldest recordings until the rest and ``size`` are within the limit.

        Returns the removed files. ``size`` is that of the files being written [bytes]; these, in
        ``current``, are never removed.
        """
        removed: list[Path] = []
        # The usual case, in which the folder is not even listed.
        if self._others + size <= self._limit:
            return removed
        self.look(*current)
        for file in self._files(current):
            if self._others + size <= self._limit:
                break
            if file.path not in self._ours:
                # Read once, since the head of a recording never changes.
                self._ours[file.path] = is_ours(file.path, self._hand)
            # A file of somebody else may have such a name, so that its content must agree.
            if not self._ours[file.path] or being_written(file.path):
                continue
            try:
                file.path.unlink()
            except OSError:
                # The next one may still be removable.
                continue
            self._others -= file.size
            removed.append(file.path)
        return removed
