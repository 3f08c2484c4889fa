"""Read and write files, completely or not at all; every failure is a one-sentence error."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

from rtee.errors import ConfigError, UserError

MAX_SIZE: Final = 64_000_000
"""Size of the largest file that is read [byte]: more than any mesh or model of a hand needs."""


NO_LINKS: Final = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
"""Flags for opening files: no links are followed, and a named pipe does not block."""


def write_atomically(path: Path | str, data: str | bytes) -> None:
    """Write a file so that a reader sees the old content or the new one, never a part.

    The data is written to a temporary file in the same folder, which is flushed to the disk and
    renamed.

    Raises:
        ConfigError: if the file cannot be written; nothing has changed.
    """
    write_together({Path(path): data})


def write_together(files: Mapping[Path, str | bytes], *, private: bool = False) -> None:
    """Write several files, each as `write_atomically` does; none unless there is space for all.

    A symbolic link is kept, and the file that it leads to is written. Devices and pipes are errors.

    Args:
        files: Content by path.
        private: Only the owner can read the files, also while they are written; a symbolic link is
            replaced instead of followed.

    Raises:
        ConfigError: if one of the files cannot be written; nothing has changed.
    """
    staged: dict[Path, str] = {}
    target = Path()
    try:
        for target, data in files.items():
            content = data.encode() if isinstance(data, str) else data
            place = target if private else _place_of(target)
            # In the same folder, since renaming is atomic only within a file system.
            descriptor, staged[place] = tempfile.mkstemp(
                dir=place.parent, prefix=f".{place.name[:40]}.", suffix=".tmp"
            )
            with os.fdopen(descriptor, "wb") as file:
                # Only the owner can read a file made by mkstemp.
                if not private:
                    os.fchmod(file.fileno(), _mode_of(place))
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        # Everything that could fail for lack of space or permission is already done.
        folders = {place.parent for place in staged}
        for target in list(staged):
            os.replace(staged[target], target)
            # Files that are left in `staged` after an error are removed below.
            del staged[target]
        # A renamed file survives a power cut only once its folder is on the disk.
        for folder in folders:
            flush_to_disk(folder)
    # A ValueError comes from a path with a null character.
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot be written: {reason(error)}", path=target) from error
    finally:
        for temporary in staged.values():
            with contextlib.suppress(OSError):
                os.unlink(temporary)


def check_writable(path: Path | str, *, folder: bool = False) -> None:
    """Check that a file can be written, before the work that makes its content.

    Args:
        path: The file; with ``folder``, a folder for files.
        folder: Whether ``path`` is a folder that will be made if it is missing.

    Raises:
        ConfigError: if the file cannot be written.
    """
    target = Path(path)
    there = target if folder else target.parent
    while folder and not there.exists() and there != there.parent:
        there = there.parent
    try:
        if not folder:
            there = _place_of(target).parent
        # A trial finds missing permissions as well as a full disk or a read-only file system.
        with tempfile.TemporaryFile(dir=there):
            pass
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot be written: {reason(error)}", path=target) from error


def make_folder(path: Path | str) -> Path:
    """Make a folder with its parents unless it exists.

    Raises:
        ConfigError: if the folder cannot be created, or the path is a file.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise ConfigError(f"folder cannot be created: {reason(error)}", path=folder) from error
    return folder


@contextlib.contextmanager
def new_folder(path: Path | str) -> Iterator[Path]:
    """Make a folder for files written inside the block; remove it if the block fails.

    Raises:
        ConfigError: if the folder cannot be created, or the path is a file.
    """
    with cleared_on_failure(Path(path)):
        yield make_folder(path)


@contextlib.contextmanager
def cleared_on_failure(folder: Path) -> Iterator[None]:
    """Remove a folder and its parents if the block has made them, fails, and leaves them empty."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        yield
    # Also when the block is cancelled or the user presses Ctrl-C.
    except BaseException:
        # The innermost first; rmdir fails for folders that are not empty, which stay.
        for each in made:
            with contextlib.suppress(OSError):
                each.rmdir()
        raise


@contextlib.contextmanager
def replaced(target: Path) -> Iterator[Path]:
    """Yield a path beside a file or folder, whose content replaces it at the end of the block.

    Nothing is left of it if the block fails. Errors of the operating system are not converted; see
    `failing`.
    """
    # Beside the target, since nothing can be renamed across file systems. In a folder of its own,
    # which gives a folder the usual permissions: those of a temporary one are its owner's only.
    with tempfile.TemporaryDirectory(prefix=f".{target.name[:40]}.", dir=target.parent) as scratch:
        temporary = Path(scratch, target.name)
        yield temporary
        # Before the rename, so that a power cut cannot leave an empty file at the path.
        flush_to_disk(temporary)
        os.replace(temporary, target)


@contextlib.contextmanager
def failing(text: str, path: Path, raised: type[UserError] = ConfigError) -> Iterator[None]:
    """Raise an error of the operating system in the block as one sentence about a file.

    Args:
        text: What fails, such as ``"cannot be read"``; the system's reason follows.
        path: The file.
        raised: The class of the error.
    """
    try:
        yield
    except OSError as error:
        raise raised(f"{text}: {reason(error)}", path=path) from error


@contextlib.contextmanager
def new_tree(target: Path) -> Iterator[Path]:
    """Make a folder completely or not at all: inside the block it has a temporary name.

    Args:
        target: The folder, which must not exist; its parent is made if needed.

    Raises:
        ConfigError: if the folder exists, or cannot be created.
    """
    if target.exists():
        raise ConfigError("already exists; remove the folder first", path=target)
    with (
        new_folder(target.parent) as place,
        failing("cannot be created", target),
        replaced(place / target.name) as filled,
    ):
        filled.mkdir()
        try:
            yield filled
        except UserError as error:
            # The temporary name is gone when the message is read.
            if error.path is not None and error.path.is_relative_to(filled):
                error.path = target / error.path.relative_to(filled)
            raise


def write_all(
    files: Mapping[Path, str | bytes], *, folders: Iterable[Path] = (), gone: Iterable[Path] = ()
) -> None:
    """Write several files as `write_together` does, make their folders, and delete others.

    Args:
        files: Content by path.
        folders: Folders to make even if they get no file.
        gone: Files to delete after the others were written.

    Raises:
        ConfigError: if a file cannot be written, and nothing has changed; or a file cannot be
            deleted.
    """
    with contextlib.ExitStack() as made:
        for folder in sorted({*folders, *(path.parent for path in files)}):
            made.enter_context(new_folder(folder))
        write_together(files)
    # Only now, so that a failed write leaves the old files.
    for path in gone:
        with failing("cannot be deleted", path):
            path.unlink(missing_ok=True)


def read_bytes(path: Path | str, what: str, error: type[UserError] | None = None) -> bytes:
    """Return a file's content.

    Args:
        path: The file.
        what: Kind of file for the message, such as ``"URDF"``.
        error: Class of the error to raise; by default `ConfigError`.

    Raises:
        UserError: if the file does not exist, cannot be read, or is larger than 64 MB.
    """
    raised: type[UserError] = error or ConfigError
    file = Path(path)
    try:
        with file.open("rb") as stream:
            # One byte more than allowed shows that the file is larger, without reading all of it.
            data = stream.read(MAX_SIZE + 1)
    except FileNotFoundError:
        raise raised(f"{what} does not exist", path=file) from None
    except (OSError, ValueError) as cause:
        raise raised(f"{what} cannot be read: {reason(cause)}", path=file) from cause
    if len(data) > MAX_SIZE:
        raise raised(f"{what} is larger than {MAX_SIZE // 1_000_000} MB", path=file)
    return data


def is_trusted(status: os.stat_result, *owners: int) -> bool:
    """Return whether one of the given users owns a file or folder, and nobody else can write to it.

    Otherwise another user of this computer may have made it.
    """
    others = stat.S_IWGRP | stat.S_IWOTH
    return status.st_uid in owners and not status.st_mode & others


def files_below(folder: Path) -> Iterator[tuple[Path, bytes]]:
    """Yield the regular files below a folder, with their paths in it and contents, in order.

    For a program with more rights than the folder's owner, who may change it meanwhile: links are
    not followed, whether to files or to folders, and what is read is what was checked. Hidden files
    and folders, and those that begin with two underscores, are left out.

    Raises:
        ConfigError: if a file cannot be read, is larger than 64 MB, or belongs to another
            user than the folder, as a hard link to somebody's file does.
    """
    for root, folders, names, descriptor in os.fwalk(folder):  # does not follow links
        folders[:] = sorted(each for each in folders if not each.startswith((".", "__")))
        owner = os.fstat(descriptor).st_uid
        for name in sorted(each for each in names if not each.startswith((".", "__"))):
            path = Path(root, name)
            content = _regular(path, descriptor, owner)
            if content is not None:
                yield path.relative_to(folder), content


def _regular(path: Path, folder: int, owner: int) -> bytes | None:
    """Return the content of a file in an open folder; ``None`` if it is not a regular file."""
    try:
        descriptor = os.open(path.name, os.O_RDONLY | NO_LINKS, dir_fd=folder)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO, errno.EMLINK):  # a link, or a socket
            return None
        raise ConfigError(f"cannot be read: {reason(error)}", path=path) from None
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            return None
        if status.st_uid != owner:
            raise ConfigError("must have the same owner as its folder", path=path)
        content = file.read(MAX_SIZE + 1)
    if len(content) > MAX_SIZE:
        raise ConfigError(f"is larger than {MAX_SIZE // 1_000_000} MB", path=path)
    return content


def reason(error: Exception) -> str:
    """Return the message of the operating system, in lower case, without error number and path."""
    if isinstance(error, shutil.Error):
        # `shutil.copytree` goes on after a failure, and raises one error with a list of them all.
        failed, (file, _, text) = error.args[0], error.args[0][0]
        text = re.sub(r"^\[Errno \d+\] |: '.*", "", text)
        more = f" and {len(failed) - 1} more" if len(failed) > 1 else ""
        text = f"{text}: '{file}'{more}"
    elif isinstance(error, OSError) and error.strerror:
        text = error.strerror
    else:
        text = str(error) or type(error).__name__
    return text[:1].lower() + text[1:]


def _place_of(target: Path) -> Path:
    """Return the path of a file with symbolic links resolved.

    Raises:
        OSError: if the path exists, but is not a regular file.
    """
    place = Path(os.path.realpath(target))
    if place.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if place.exists() and not place.is_file():
        raise OSError(errno.EINVAL, "not a regular file")
    return place


def _mode_of(target: Path) -> int:
    """Return the permissions of the new file: those of the old file, or the default ones."""
    try:
        return target.stat().st_mode & 0o777
    except OSError:
        # The mask can be read only by setting it, so it is restored at once.
        mask = os.umask(0)
        os.umask(mask)
        return 0o666 & ~mask


def flush_to_disk(path: Path) -> None:
    """Flush a folder, with the names in it, or a file to the disk; raises `OSError`."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def temporary_folder(origin: Path | None) -> Iterator[Path]:
    """Make a folder for files made from ``origin``; errors about them name that instead.

    Without an origin they name no file: the folder is gone when the message is read.
    """
    with tempfile.TemporaryDirectory(prefix="rtee-") as name:
        folder = Path(name)
        try:
            yield folder
        except UserError as error:
            if error.path is not None and error.path.is_relative_to(folder):
                # The lines differ from the origin's.
                error.path, error.line = origin, None
            error.message = error.message.replace(f"{folder}{os.sep}", "")
            raise
