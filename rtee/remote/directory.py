"""Which hands run on this computer: one file per hand in the user's runtime folder.

A server keeps the file of its hand locked for as long as it lives. A file without a lock was left
behind by a process that was killed.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import stat
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rtee.errors import ConfigError
from rtee.hand.files import reason
from rtee.hand.names import check_name

VARIABLE = "RTEE_RUNTIME_DIR"
"""Environment variable with the path of another runtime folder."""

SERVICES = Path("/run/rtee")
"""Where hands that run as services are announced, for users who may read it."""

_ATTEMPTS = 20
"""Attempts to lock the file of a hand, together 0.2 s: a reader locks it for microseconds only."""

_PAUSE = 0.01
"""Time between two of these attempts [s]."""

_LONGEST = 65536
"""Most that is read of a hand's file [bytes]; a valid one has some hundred."""


@dataclass(frozen=True, slots=True)
class Running:
    """A running hand.

    Attributes:
        hand: Its name.
        pid: The process.
        endpoints: Zenoh endpoints on this computer.
    """

    hand: str
    pid: int
    endpoints: tuple[str, ...]


def runtime_folder() -> Path:
    """Return the folder with the files of running hands: this user's, and emptied at a restart.

    ``RTEE_RUNTIME_DIR``, else ``rtee`` in ``XDG_RUNTIME_DIR``, else ``rtee-<uid>`` in the temporary
    folder.
    """
    if given := os.environ.get(VARIABLE):
        return Path(given)
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "rtee"
    return Path(tempfile.gettempdir()) / f"rtee-{os.getuid()}"


def _own_folder() -> Path:
    """Return the folder, made if necessary; raises `ConfigError` if it is not ours alone."""
    folder = runtime_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise ConfigError(f"cannot be made: {reason(error)}", path=folder) from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise ConfigError(
            f"must be a folder that only you can write to; remove it or set {VARIABLE}", path=folder
        )
    return folder


class Place:
    """The place of a hand in the runtime folder, while its file is locked; made by `claimed`.

    Attributes:
        path: The hand's file.
        socket: Where the hand's Unix socket belongs.
    """

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path, self.socket = path, path.with_suffix(".sock")
        self._descriptor = descriptor

    def write(self, endpoints: Sequence[str]) -> None:
        """Announce the hand with its endpoints on this computer."""
        entry = json.dumps({"pid": os.getpid(), "endpoints": list(endpoints)})
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, entry.encode(), 0)

    def withdraw(self) -> None:
        """Announce the hand no longer."""
        os.ftruncate(self._descriptor, 0)


@contextlib.contextmanager
def claimed(hand: str) -> Iterator[Place]:
    """Keep the place of a hand for as long as the context lasts, so that it runs once.

    Args:
        hand: Its name.

    Raises:
        ConfigError: if the hand runs already, or the folder cannot be used.
    """
    path = _own_folder() / f"{check_name(hand, 'hand')}.json"
    descriptor = _locked(path, hand)
    try:
        place = Place(path, descriptor)
        place.withdraw()  # what a killed server may have left
        yield place
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(descriptor)


@contextlib.contextmanager
def announced(hand: str, endpoints: Sequence[str]) -> Iterator[Path]:
    """Announce a hand for as long as the context lasts; errors are those of `claimed`.

    Args:
        hand: Its name.
        endpoints: Zenoh endpoints of the hand on this computer.
    """
    with claimed(hand) as place:
        place.write(endpoints)
        yield place.path


def _locked(path: Path, hand: str) -> int:
    for _ in range(_ATTEMPTS):
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o640)
        except OSError as error:
            raise ConfigError(f"cannot be written: {reason(error)}", path=path) from None
        # The previous server may have removed the file between opening and locking it.
        if _lock(descriptor, fcntl.LOCK_EX) and _same_file(descriptor, path):
            return descriptor
        os.close(descriptor)
        time.sleep(_PAUSE)  # another process may just be checking whether the hand runs
    pid = _read(path).get("pid", "unknown")
    raise ConfigError(f"the hand '{hand}' runs already, in process {pid}")


def _lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _same_file(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:
        return False


def _read(path: Path) -> dict[str, object]:
    try:
        with path.open("rb") as file:
            entry = json.loads(file.read(_LONGEST))
    except (OSError, ValueError):
        return {}
    return entry if isinstance(entry, dict) else {}


def _in_use(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return not _lock(descriptor, fcntl.LOCK_SH)
    finally:
        os.close(descriptor)


def running() -> dict[str, Running]:
    """Return the hands that run on this computer, this user's and services, by name."""
    found: dict[str, Running] = {}
    own = sorted(runtime_folder().glob("*.json"))
    # A folder that is named explicitly, as in tests, is the only one.
    services = [] if os.environ.get(VARIABLE) else sorted(SERVICES.glob("*.json"))
    for path in (*services, *own):
        entry = _read(path)
        pid, endpoints = entry.get("pid"), entry.get("endpoints")
        if isinstance(pid, int) and isinstance(endpoints, list) and _in_use(path):
            found[path.stem] = Running(path.stem, pid, tuple(map(str, endpoints)))
    return found
