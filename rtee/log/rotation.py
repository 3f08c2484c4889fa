"""Names of recordings, the recordings of a hand, and the limit of their disk space."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import stat
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.opcode import Opcode
from mcap.records import Metadata

from rtee.errors import LogError
from rtee.hand.files import failing
from rtee.log.brief import SECOND
from rtee.log.record_scanner import parsed
from rtee.messages.mcap_chunk import MAGIC, records_of

if TYPE_CHECKING:
    from rtee.log.settings import RecorderSettings

METADATA = "rtee"
"""Name of the metadata record that every recording of rtee carries."""

OPEN = "is still being written; end its run, or the recording in the GUI, first"
"""What is said of a recording that must be complete and is not yet."""

MESHES = "meshes"
"""Name of the metadata record that maps addresses of meshes to attachments."""

FLIGHT = "flight"
"""Replaces the number of the part in the names of the flight recorder's files."""

_FIRST = 65536  # bytes that contain the metadata, which follow the header
_STAMP = r"\d{8}T\d{9}Z"
# With the characters of a hand's name only: others must not reach a terminal.
_NAME = re.compile(
    rf"(?P<hand>[A-Za-z0-9_.-]+)_(?P<session>{_STAMP})_(?P<part>\d{{3,}}|{FLIGHT})\.mcap"
)


def being_written(path: Path) -> bool:
    """Return whether a recorder has the file open."""
    try:
        # Without O_NONBLOCK, opening a named pipe would wait for its writer.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        # The kernel drops the recorder's lock with its process, unlike a lock file. This lock is
        # shared, so that two programs that look at once do not take each other for a recorder.
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in (errno.EWOULDBLOCK, errno.EACCES)
    finally:
        os.close(descriptor)
    return False


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

    Attributes:
        session: The start of the recording.
        part: Number of the part; ``None`` for a file of the flight recorder.
        owner: The hand by the file's content; empty if rtee did not write it.
        run: Number of the recording among those bounded together, which no clock changes; 0 in
            files of earlier versions.
    """

    path: Path
    hand: str
    session: str
    part: int | None
    size: int
    owner: str
    run: int


def parse_name(path: Path) -> RecordingFile | None:
    """Return the recording at a path; ``None`` if it is not named as one, or is gone."""
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
    head = _head(path, status.st_ino)
    return RecordingFile(path, match["hand"], match["session"], part, status.st_size, *head)


_heads: dict[tuple[Path, int], tuple[str, int]] = {}


def _head(path: Path, inode: int) -> tuple[str, int]:
    """Return hand and run in a file's metadata; an empty name if rtee did not write it."""
    if (path, inode) not in _heads:
        try:
            with path.open("rb") as stream:
                data = stream.read(_FIRST)
            records = records_of(data.removeprefix(MAGIC), Opcode.METADATA)
            for first in (parsed(Metadata, content) for _, content in records):
                if data.startswith(MAGIC) and first.name == METADATA:
                    # Read once, since the head of a recording never changes.
                    values = first.metadata
                    _heads[path, inode] = values.get("hand", ""), int(values.get("run", 0))
                    break
        except (OSError, ValueError):
            return "", 0
    return _heads.get((path, inode), ("", 0))


def recordings(folder: Path, hand: str | None = None, *, pattern: str = "*") -> list[RecordingFile]:
    """Return the files in a folder that are recordings by their names, oldest first."""
    try:
        paths = list(folder.glob(f"{pattern}.mcap"))
    except OSError:
        return []
    files = [file for path in paths if (file := parse_name(path)) is not None]
    return sorted(
        (file for file in files if hand in (None, file.hand)),
        # Not by time alone: a clock may have been set back.
        key=lambda file: (
            file.run,
            file.session,
            -1 if file.part is None else file.part,
            file.path,
        ),
    )


def bounded(settings: RecorderSettings) -> list[RecordingFile]:
    """Return the recordings whose size is bounded together, oldest first."""
    common = settings.common_directory
    return recordings(settings.folder) if common is None else recordings(common, pattern="**/*")


def next_run(settings: RecorderSettings) -> int:
    """Return the number of a recording that begins now."""
    return 1 + max((file.run for file in bounded(settings)), default=0)


def free_space(folder: Path) -> int:
    """Return the free space on the disk of a folder [bytes]."""
    status = os.statvfs(folder)
    return status.f_bavail * status.f_frsize


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


def paths_of(path: Path | str | Iterable[Path | str], *, series: bool = False) -> list[Path]:
    """Return the files that `read` would read, each once.

    Raises:
        LogError: if a folder holds no recording, or the path is no path.
    """
    if not isinstance(path, (str, Path)):
        several = isinstance(path, Iterable) and not isinstance(path, (bytes, Mapping))
        files = list(path) if several else []
        if not several or not all(isinstance(each, (str, Path)) for each in files):
            raise LogError(f"a recording is a path, or a list of paths, not {path!r:.100}")
        if not files:
            raise LogError("give a recording")
        return list({Path(each).resolve(): Path(each) for each in files}.values())
    path = Path(path)
    with failing("cannot be read", path, LogError):
        folder = path.is_dir()
    if folder:
        # Not the flight recorder's files, which contain only the time before a fault.
        parts = [file for file in recordings(path) if file.part is not None]
        if not parts:
            others = any(path.glob("*.mcap"))
            text = "; give the file, since none is named HAND_TIME_PART.mcap" if others else ""
            raise LogError(f"there is no recording in this folder{text}", path=path)
        return parts_of(parts[-1].path)
    return parts_of(path) if series else [path]


class Retention:
    """Limits the disk space of recordings by removing the oldest.

    The settings limit the hand's own recordings and those of all hands, and keep some of the disk
    free. Removes only files that are recordings by name and by content, and none that is being
    written; parts of running recordings go last.
    """

    def __init__(self, settings: RecorderSettings, hand: str) -> None:
        self._settings = settings
        self._hand = hand
        self._own = self._all = 0  # sizes of the files but those being written [bytes]

    def look(self, *current: Path) -> None:
        """Read the sizes of the files in the folder again, except those being written."""
        files = self._files(current)
        self._all = sum(file.size for file in files)
        self._own = sum(file.size for file in files if file.hand == self._hand)

    def _files(self, current: tuple[Path, ...]) -> list[RecordingFile]:
        return [each for each in bounded(self._settings) if each.path not in current]

    def short(self) -> bool:
        """Return whether the free disk space is below the reserve."""
        reserve = self._settings.reserve
        return reserve > 0.0 and free_space(self._settings.folder) < reserve

    def keep_within(self, size: int, session: str, *current: Path) -> list[Path]:
        """Remove the oldest recordings until the rest and ``size`` are within the limits.

        Returns the removed files. ``size`` is that of the files being written [bytes]; these, in
        ``current``, are never removed. The session is that of the running recording.
        """
        removed: list[Path] = []
        # The usual case, in which the folder is not even listed.
        if not self._over(size):
            return removed
        self.look(*current)
        files = self._files(current)
        running = {(each.hand, each.session) for each in files if being_written(each.path)}
        running.add((self._hand, session))
        files.sort(key=lambda file: (file.hand, file.session) in running)
        for file in files:
            if not self._over(size):
                break
            # Other hands' recordings are removed only for the limits that all hands share.
            if file.hand != self._hand and not self._beyond(size):
                continue
            # Somebody else's file may have such a name, so its content must agree, too.
            if file.owner != file.hand or being_written(file.path):
                continue
            try:
                file.path.unlink()
            except OSError:
                # The next one may still be removable.
                continue
            self._all -= file.size
            self._own -= file.size if file.hand == self._hand else 0
            removed.append(file.path)
        return removed

    def _over(self, size: int) -> bool:
        return self._own + size > self._settings.max_total_size or self._beyond(size)

    def _beyond(self, size: int) -> bool:
        return self._all + size > self._settings.max_folder_size or self.short()
