"""A model in any of the forms that rtee reads, as a URDF while it is needed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from rtee.errors import ConfigError, UserError, needing_extra
from rtee.exchange.xacro_expand import arguments_of, expand

XACRO: Final = ".xacro"
"""Ending of the names of files that are expanded. Another file is never run."""


@dataclass(frozen=True, slots=True)
class ReadableModel:
    """A model as a URDF, and what its own form says besides.

    Attributes:
        urdf: The URDF.
        passive: Joints without a motor; ``None`` where that is not known.
        excluded: Pairs of links that are never checked for collision, and why.
        notes: What was chosen and left out, one sentence each.
        package_dirs: Folders to look mesh packages up in.
    """

    urdf: Path
    passive: tuple[str, ...] | None = None
    excluded: tuple[tuple[str, str, str], ...] = ()
    notes: tuple[str, ...] = ()
    package_dirs: tuple[Path, ...] = ()


def as_urdf(
    urdf: Path | None, mjcf: Path | None, arguments: Sequence[str], package_dirs: Sequence[Path]
) -> AbstractContextManager[ReadableModel]:
    """Return a context in which a model is there as a URDF.

    Args:
        urdf: Its URDF, or its xacro file if the name ends with ``.xacro``.
        mjcf: Its MJCF, instead of a URDF.
        arguments: Arguments of the xacro file, as ``NAME:=VALUE``.
        package_dirs: Folders to look packages up in.

    Raises:
        ConfigError: There are arguments without a xacro file.
    """
    if urdf is not None and urdf.suffix == XACRO:
        return xacro_as_urdf(urdf, arguments_of(arguments), package_dirs)
    if arguments:
        raise ConfigError(
            f"'{arguments[0]}' should be an argument of a xacro file, whose name ends with {XACRO}"
        )
    if mjcf is not None:
        return mjcf_as_urdf(mjcf, package_dirs)
    assert urdf is not None  # noqa: S101 - one of both is given
    return nullcontext(ReadableModel(urdf, package_dirs=tuple(package_dirs)))


@contextmanager
def xacro_as_urdf(
    path: Path, arguments: Mapping[str, str], package_dirs: Sequence[Path] = ()
) -> Iterator[ReadableModel]:
    """Expand a xacro file; the URDF is there inside the block.

    Args:
        path: The file; what it contains is run.
        arguments: Its arguments, by name.
        package_dirs: Folders to look packages up in.

    Raises:
        MissingExtra: The extra ``xacro`` is not installed.
        ModelError: The file cannot be expanded.
    """
    with _made(path) as folder:
        urdf = folder / f"{path.name.partition('.')[0] or 'hand'}.urdf"
        expand(path, urdf, arguments, package_dirs)
        # Meshes are looked up from where the xacro file is; the URDF is elsewhere.
        home = path.absolute().parent
        yield ReadableModel(urdf, package_dirs=(*package_dirs, home, *home.parents))


@contextmanager
def mjcf_as_urdf(path: Path, folders: Sequence[Path] = ()) -> Iterator[ReadableModel]:
    """Make a URDF of an MJCF file; it is there inside the block.

    Args:
        path: The MJCF file.
        folders: Where its includes and meshes may be besides its own folder.

    Raises:
        MissingExtra: The extra ``sim`` is not installed.
        ModelError: The file cannot be read, or describes what rtee has no form for.
    """
    with needing_extra("reading MJCF", "sim"):
        from rtee.exchange.mjcf_import import import_mjcf
    with _made(path) as folder:
        found = import_mjcf(path, folder, folders)
        yield ReadableModel(found.urdf, found.passive, found.excluded, found.notes)


@contextmanager
def _made(path: Path) -> Iterator[Path]:
    """Make a folder for what is made of a file; errors inside the block name the file instead."""
    with TemporaryDirectory(prefix="rtee-") as name:
        folder = Path(name)
        try:
            yield folder
        except UserError as error:
            # The folder is gone when the message is read, and its lines are not those of the file.
            if error.path is not None and error.path.is_relative_to(folder):
                error.path, error.line = path, None
            raise
