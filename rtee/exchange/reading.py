"""A model in any of the forms that rtee reads, as a URDF while it is needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from rtee.errors import UserError, needing_extra


@dataclass(frozen=True, slots=True)
class ReadableModel:
    """A model as a URDF, and what its own form says besides.

    Attributes:
        urdf: The URDF.
        passive: Joints without a motor; ``None`` where that is not known.
        excluded: Pairs of links that are never checked for collision, and why.
        notes: What was chosen and left out, one sentence each.
    """

    urdf: Path
    passive: tuple[str, ...] | None = None
    excluded: tuple[tuple[str, str, str], ...] = ()
    notes: tuple[str, ...] = ()


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
            if error.path is not None and error.path.is_relative_to(folder):
                error.path, error.line = path, None
            raise
