"""Read and write files: completely or not at all, with every failure as one sentence."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

from rtee.errors import ConfigError, UserError

MAX_SIZE: Final = 64_000_000
"""Largest file that is read [bytes]: more than any mesh or model of a hand takes."""


def write_atomically(path: Path | str, data: str | bytes) -> None:
    """Write a file so that a reader sees the old content or the new one, never a part.

    The data goes to a temporary file in the same folder, is flushed to the disk and renamed.

    Raises:
        ConfigError: The folder or disk does not allow it; nothing has changed.
    """
    write_together({Path(path): data})


def write_together(files: Mapping[Path, str | bytes]) -> None:
    """Write several files, each as `write_atomically` does; none unless there is room for all.

    Links stay; the files they lead to are written. Devices and pipes are not files.

    Raises:
        ConfigError: The folder or disk does not allow one of them; nothing has changed.
    """
    staged: dict[Path, str] = {}
    target = Path()
    try:
        for target, data in files.items():
            content = data.encode() if isinstance(data, str) else data
            place = _place_of(target)
            # In the same folder: renaming is atomic only within one file system.
            descriptor, staged[place] = tempfile.mkstemp(
                dir=place.parent, prefix=f".{place.name[:40]}.", suffix=".tmp"
            )
            with os.fdopen(descriptor, "wb") as file:
                # mkstemp makes files that only their owner can read.
                os.fchmod(file.fileno(), _mode_of(place))
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        # Renaming is atomic; what could fail for lack of space or rights has happened before.
        folders = {place.parent for place in staged}
        for target in list(staged):
            os.replace(staged[target], target)
            del staged[target]
        # A renamed file survives a power cut only once its folder is on the disk.
        for folder in folders:
            sync_folder(folder)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot be written: {reason(error)}", path=target) from error
    finally:
        for temporary in staged.values():
            with contextlib.suppress(OSError):
                os.unlink(temporary)


def check_writable(path: Path | str, *, folder: bool = False) -> None:
    """Find out whether a file could be written, before the work that makes its content.

    Args:
        path: The file, or with ``folder`` a folder that would be made to hold some.
        folder: Whether missing folders would be made.

    Raises:
        ConfigError: It could not.
    """
    target = Path(path)
    there = target if folder else target.parent
    while folder and not there.exists() and there != there.parent:
        there = there.parent
    try:
        if not folder:
            there = _place_of(target).parent
        # Trying says more than asking: rights, a full disk and a read-only mount.
        with tempfile.TemporaryFile(dir=there):
            pass
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot be written: {reason(error)}", path=target) from error


def make_folder(path: Path | str) -> Path:
    """Make a folder with its parents, or accept the one there is.

    Raises:
        ConfigError: It cannot be made, or is a file.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise ConfigError(f"folder cannot be made: {reason(error)}", path=folder) from error
    return folder


@contextlib.contextmanager
def new_folder(path: Path | str) -> Iterator[Path]:
    """Make a folder for what is written inside the block; if that fails, it does not stay.

    Raises:
        ConfigError: It cannot be made, or is a file.
    """
    folder = Path(path)
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        yield make_folder(folder)
    except BaseException:
        # The innermost first; rmdir leaves folders alone in which there is something by now.
        for each in made:
            with contextlib.suppress(OSError):
                each.rmdir()
        raise


@contextlib.contextmanager
def new_tree(target: Path) -> Iterator[Path]:
    """Make a folder whole or not at all: it is filled under another name inside the block.

    Args:
        target: The folder, which does not exist; the one that is to hold it is made if needed.

    Raises:
        ConfigError: The folder exists, or cannot be made.
    """
    if target.exists():
        raise ConfigError("is already there; remove the folder first", path=target)
    with new_folder(target.parent) as place:
        try:
            # Beside the target: a folder can be renamed only within its file system.
            with tempfile.TemporaryDirectory(prefix=f".{target.name[:40]}.", dir=place) as scratch:
                filled = Path(scratch) / target.name
                filled.mkdir()
                yield filled
                filled.rename(target)
        except (OSError, shutil.Error) as error:
            several = error.args[0] if isinstance(error, shutil.Error) else ()
            text = "; ".join(each[2] for each in several) or reason(error)
            raise ConfigError(f"cannot be made: {text}", path=target) from error


def write_all(
    files: Mapping[Path, str | bytes],
    *,
    folders: Iterable[Path] = (),
    gone: Iterable[Path] = (),
) -> None:
    """Write several files as `write_together` does, make their folders, and delete others.

    Args:
        files: What to write where.
        folders: Folders to make even if no file goes there.
        gone: Files to delete once the others are written.

    Raises:
        ConfigError: Something cannot be written, and nothing has changed; or not be deleted.
    """
    with contextlib.ExitStack() as made:
        for folder in sorted({*folders, *(path.parent for path in files)}):
            made.enter_context(new_folder(folder))
        write_together(files)
    for path in gone:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise ConfigError(f"cannot be deleted: {reason(error)}", path=path) from None


def read_bytes(path: Path | str, what: str, error: type[UserError] | None = None) -> bytes:
    """Return a file's content.

    Args:
        path: The file.
        what: What it should be, for the message, such as ``"URDF"``.
        error: The error to raise; `ConfigError` unless given.

    Raises:
        UserError: It does not exist, cannot be read, or is larger than 64 MB.
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


def reason(error: Exception) -> str:
    """Return what the operating system says, in lower case and without numbers and paths."""
    if isinstance(error, OSError) and error.strerror:
        text = error.strerror
    else:
        text = str(error) or type(error).__name__
    return text[:1].lower() + text[1:]


def _place_of(target: Path) -> Path:
    """Return where a file is written: where links lead to.

    Raises:
        OSError: Something other than a file is there.
    """
    place = Path(os.path.realpath(target))
    if place.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if place.exists() and not place.is_file():
        raise OSError(errno.EINVAL, "not a regular file")
    return place


def _mode_of(target: Path) -> int:
    """Return the permissions the new file gets: those of the old one, or the usual ones."""
    try:
        return target.stat().st_mode & 0o777
    except OSError:
        # The mask can only be read by setting it; it is set back at once.
        mask = os.umask(0)
        os.umask(mask)
        return 0o666 & ~mask


def sync_folder(folder: Path) -> None:
    """Have a folder's renamed files survive a power cut; raises `OSError`."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
