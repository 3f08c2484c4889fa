"""The hands that run on this computer: one file per hand in the user's runtime folder.

A server keeps the file of its hand locked for as long as it lives. A file without a lock was left
behind by a process that was killed. Programs that clean temporary folders may remove a file that
is in use, so a server also keeps a name in the kernel, and writes its file again. A process that is
about to run hands says so in a file of its own, until it has those of the hands.

Servers and clients use a folder and its files only if no other user could have made them.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import socket
import stat
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rtee.errors import ConfigError
from rtee.hand.files import NO_LINKS, failing, is_trusted, reason
from rtee.hand.names import check_name
from rtee.values import Value

VARIABLE = "RTEE_RUNTIME_DIR"
"""Environment variable with the path of another runtime folder."""

SERVICES = Path("/run/rtee")
"""Folder in which hands that run as services are announced, to users who may read it."""

_ATTEMPTS = 20
"""Attempts to lock the file of a hand, together 0.2 s: readers lock it for microseconds only."""

_PAUSE = 0.01
"""Time between two of these attempts [s], many times longer than a reader's lock."""

_LONGEST = 65536
"""Most bytes that are read of a hand's file [bytes]: a valid one has a few hundred."""

_WATCH_PERIOD = 1.0
"""Interval of checks that a hand's file still exists [s]; until then, clients may not find it."""

_ASKING = 64
"""Processes that may ask for the owner of a name between two of these checks: more than ever start
a hand at once."""

_HAND, _STARTS = ".json", ".starts"
"""Suffixes of the files of hands, and of processes that are about to run hands."""


@dataclass(frozen=True, slots=True)
class Running(Value):
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
    """Return this user's folder with the files of running hands, which a restart empties.

    It is ``RTEE_RUNTIME_DIR``, otherwise ``rtee`` in ``XDG_RUNTIME_DIR``, otherwise ``rtee-<uid>``
    in the temporary folder.
    """
    if given := os.environ.get(VARIABLE):
        return Path(os.path.expanduser(given))
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "rtee"
    return Path(tempfile.gettempdir()) / f"rtee-{os.getuid()}"


def _own_folder(*, make: bool) -> int | None:
    """Return a descriptor of this user's folder; ``None`` if it doesn't exist and isn't made.

    Raises `ConfigError` if others can write to the folder.
    """
    folder = runtime_folder()
    descriptor = None
    try:
        if make:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | NO_LINKS)
        # Checks the open folder, not its path, which somebody could replace in between.
        if is_trusted(os.fstat(descriptor), os.getuid()):
            return descriptor
    except FileNotFoundError:
        return None
    except NotADirectoryError:  # a link, too
        pass
    except OSError as error:
        raise ConfigError(
            f"cannot be used: {reason(error)}; set {VARIABLE} to a folder of yours", path=folder
        ) from None
    if descriptor is not None:
        os.close(descriptor)
    raise ConfigError(
        f"must be a folder that only you can write to; remove it or set {VARIABLE}", path=folder
    )


def own_folder() -> Path:
    """Return this user's folder, which is made if it does not exist.

    Raises `ConfigError` if others can write to it.
    """
    if (folder := _own_folder(make=True)) is not None:
        os.close(folder)
    return runtime_folder()


def _services() -> int | None:
    """Return a descriptor of the services' folder; ``None`` if missing or writable by everyone.

    Its owner can be trusted, since only root can make it in ``/run``.
    """
    try:
        descriptor = os.open(SERVICES, os.O_RDONLY | os.O_DIRECTORY | NO_LINKS)
    except OSError:
        return None
    if os.fstat(descriptor).st_mode & stat.S_IWOTH:
        os.close(descriptor)
        return None
    return descriptor


class HandLock:
    """A hand's locked file in the runtime folder, and its Unix socket; made by `claimed`."""

    def __init__(self, path: Path, hand: str, name: socket.socket | None) -> None:
        """Lock the file; raises `ConfigError` if another process has locked it.

        The socket ``name`` keeps the hand's name in the kernel, and accepts those who ask for its
        owner.
        """
        self.path, self.socket = path, path.with_suffix(".sock")
        self._hand, self._name = hand, name
        self._entry = b""
        self._descriptor = _locked(path, hand)
        os.ftruncate(self._descriptor, 0)  # a killed server may have left an entry
        self._changing = threading.Lock()
        self._ended = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name=f"place {hand}", daemon=True)
        self._watcher.start()

    def write(self, endpoints: Sequence[str]) -> None:
        """Announce the hand with its endpoints on this computer."""
        self._put(json.dumps({"pid": os.getpid(), "endpoints": list(endpoints)}).encode())

    def withdraw(self) -> None:
        """Withdraw the announcement of the hand, which ends: clients do not wait for it."""
        self._put(json.dumps({"pid": os.getpid(), "ends": True}).encode())

    def close(self) -> None:
        """Remove the file."""
        self._ended.set()
        self._watcher.join()
        # Before the lock is released: after that, it may be the next server's file.
        if _same_file(self._descriptor, self.path):
            with contextlib.suppress(OSError):
                self.path.unlink()
        os.close(self._descriptor)

    def _put(self, entry: bytes) -> None:
        with self._changing:
            self._entry = entry
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, entry, 0)

    def _watch(self) -> None:
        while not self._ended.wait(_WATCH_PERIOD):
            with contextlib.suppress(OSError):
                while (
                    self._name is not None
                ):  # until no connection is left: `accept` does not block
                    self._name.accept()[0].close()
            if not _same_file(self._descriptor, self.path):
                with contextlib.suppress(ConfigError, OSError):
                    self._replace()

    def _replace(self) -> None:
        """Write the file again after it was removed."""
        own_folder()
        descriptor = _locked(self.path, self._hand)
        with self._changing:
            self._descriptor, old = descriptor, self._descriptor
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, self._entry, 0)
        os.close(old)


@contextlib.contextmanager
def claimed(hand: str) -> Iterator[HandLock]:
    """Lock the file of a hand for as long as the context lasts, so that the hand runs only once.

    Raises `ConfigError` if the hand runs already, or the folder cannot be used.
    """
    path = runtime_folder() / f"{check_name(hand, 'hand')}{_HAND}"
    folder = _own_folder(make=True)
    if folder is None:
        raise ConfigError("cannot be created", path=path.parent)
    with contextlib.ExitStack() as stack:
        stack.callback(os.close, folder)
        # systemd-tmpfiles spares the files of a locked folder.
        _lock(folder, fcntl.LOCK_SH)
        name = stack.enter_context(_named(hand, folder, path.parent))
        place = HandLock(path, hand, name)
        stack.callback(place.close)
        _unlink(f"{os.getpid()}{_STARTS}", folder)
        yield place


@contextlib.contextmanager
def about_to_run(hands: Sequence[str]) -> Iterator[None]:
    """Tell clients that this process is about to run hands, until it has `claimed` the first.

    They wait for it instead of being told that no hand runs. Whatever is wrong with the folder is
    left to `claimed`, which says so.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(ConfigError, OSError):
            folder = _own_folder(make=True)
            if folder is not None:
                stack.callback(os.close, folder)
                for name in os.listdir(folder):  # what killed processes have left
                    if name.endswith(_STARTS) and _entry(folder, name) is None:
                        os.unlink(name, dir_fd=folder)
                name = f"{os.getpid()}{_STARTS}"
                descriptor = os.open(name, os.O_RDWR | os.O_CREAT | NO_LINKS, 0o640, dir_fd=folder)
                stack.callback(os.close, descriptor)
                _lock(descriptor, fcntl.LOCK_EX)
                os.pwrite(descriptor, json.dumps({"hands": list(hands)}).encode(), 0)
                stack.callback(_unlink, name, folder)
        yield


def _unlink(name: str, folder: int) -> None:
    with contextlib.suppress(OSError):
        os.unlink(name, dir_fd=folder)


@contextlib.contextmanager
def _named(hand: str, descriptor: int, folder: Path) -> Iterator[socket.socket | None]:
    """Keep a name in the kernel, where no cleaner removes it: an abstract Unix socket of Linux.

    Raises `ConfigError` if a process of this user has the name, so that the hand runs already.
    """
    if not sys.platform.startswith("linux"):
        yield None
        return
    # By device and path, since the folder itself may be removed and made again.
    key = f"{os.fstat(descriptor).st_dev} {folder.resolve()} {hand}"
    name = f"\0rtee-{os.getuid()}-{hashlib.sha256(key.encode()).hexdigest()[:32]}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as named:
        named.setblocking(False)
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(OSError):
                named.bind(name)
                named.listen(_ASKING)
                break
            time.sleep(_PAUSE)  # the previous server may just be ending
        else:
            owner = _owner(name)
            # If another user occupies the name, maliciously, only the file decides.
            if owner is not None and owner[1] == os.getuid():
                raise ConfigError(f"the hand '{hand}' is already running, in process {owner[0]}")
        yield named


def _owner(name: str) -> tuple[int, int] | None:
    """Return the ids of the process and the user that listen on a Unix socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(name)
        except OSError:
            return None
        return peer_of(asking)


def peer_of(link: socket.socket) -> tuple[int, int]:
    """Return the ids of the process and the user at the other side of a Unix socket, on Linux."""
    peer = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    process, user, _ = struct.unpack("3i", peer)
    return process, user


def _locked(path: Path, hand: str) -> int:
    for _ in range(_ATTEMPTS):
        with failing("cannot be written", path):
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | NO_LINKS, 0o640)
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or not is_trusted(status, os.getuid()):
            os.close(descriptor)
            raise ConfigError("must be a file that only you can write to; remove it", path=path)
        # The previous server may have removed the file between opening and locking it.
        if _lock(descriptor, fcntl.LOCK_EX) and _same_file(descriptor, path):
            return descriptor
        os.close(descriptor)
        time.sleep(_PAUSE)  # another process may just be checking whether the hand runs
    pid = "unknown"
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | NO_LINKS)
        pid = str(_read(descriptor).get("pid", pid))
        os.close(descriptor)
    raise ConfigError(f"the hand '{hand}' is already running, in process {pid}")


def _lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _same_file(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except OSError:
        return False


def _read(descriptor: int) -> dict[str, object]:
    try:
        entry = json.loads(os.pread(descriptor, _LONGEST, 0))
    except (OSError, ValueError, RecursionError):
        return {}
    return entry if isinstance(entry, dict) else {}


def _entry(folder: int, name: str) -> dict[str, object] | None:
    """Return what a living process has written to a file, ``None`` if its process has ended."""
    try:
        descriptor = os.open(name, os.O_RDONLY | NO_LINKS, dir_fd=folder)
    except OSError:
        return None
    try:
        status = os.fstat(descriptor)
        owner = os.fstat(folder).st_uid
        if not stat.S_ISREG(status.st_mode) or not is_trusted(status, owner):
            return None
        entry = _read(descriptor)
        # A shared lock, so that several readers do not mistake each other for the process.
        return None if _lock(descriptor, fcntl.LOCK_SH) else entry
    finally:
        os.close(descriptor)


def hands_running() -> dict[str, Running]:
    """Return the hands of this user and of services that run on this computer, by name.

    Raises `ConfigError` if others can write to this user's folder.
    """
    hands: dict[str, Running] = {}
    for name, entry in _entries(_HAND).items():
        pid, endpoints = entry.get("pid", 0), entry.get("endpoints", [])
        if isinstance(pid, int) and isinstance(endpoints, list) and endpoints:
            hands[name] = Running(name, pid, tuple(map(str, endpoints)))
    return hands


def starting() -> list[str]:
    """Return the names of hands that a process has or is about to have, but does not announce yet.

    Raises `ConfigError` if others can write to this user's folder.
    """
    names = [name for name, entry in _entries(_HAND).items() if not entry]
    for entry in _entries(_STARTS).values():
        hands = entry.get("hands")
        names += map(str, hands) if isinstance(hands, list) else ()
    return names


def _entries(suffix: str) -> dict[str, dict[str, object]]:
    """Return what living processes have written to files of a suffix, by name without suffix."""
    entries: dict[str, dict[str, object]] = {}
    # A folder that is given explicitly, as in tests, is the only one.
    services = None if os.environ.get(VARIABLE) else _services()
    try:
        own = _own_folder(make=False)
        try:
            for folder in (services, own):
                if folder is None:
                    continue
                for name in sorted(os.listdir(folder)):
                    entry = _entry(folder, name) if name.endswith(suffix) else None
                    if entry is not None:
                        entries[name.removesuffix(suffix)] = entry
        finally:
            if own is not None:
                os.close(own)
    finally:
        if services is not None:
            os.close(services)
    return entries
