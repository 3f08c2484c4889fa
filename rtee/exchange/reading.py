"""Models in any format that rtee reads, as temporary URDF files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Final

from rtee.errors import ConfigError, needing_extra
from rtee.exchange.readable import ReadableModel
from rtee.exchange.xacro_expand import arguments_of, expand
from rtee.hand.files import temporary_folder
from rtee.units import AngleUnit

XACRO: Final = ".xacro"
"""Suffix of files that are expanded; other files are never run."""


def as_urdf(
    urdf: Path | None,
    mjcf: Path | None,
    arguments: Sequence[str],
    package_dirs: Sequence[Path],
    root: str | None = None,
    angle: AngleUnit | None = None,
) -> AbstractContextManager[ReadableModel]:
    """Return a context in which a model exists as a URDF.

    Args:
        urdf: Its URDF, or its xacro file if the name ends with ``.xacro``.
        mjcf: Its MJCF, instead of a URDF.
        arguments: Arguments of the xacro file, as ``NAME:=VALUE``.
        package_dirs: Folders to look packages up in.
        root: Base link of the hand in a model of a whole robot.
        angle: Unit of the angles of an MJCF that states none; ``None``: degrees.

    Raises:
        ConfigError: if there are arguments without a xacro file, or a unit without an MJCF.
    """
    if angle is not None and mjcf is None:
        raise ConfigError("--angle needs --mjcf; the angles of a URDF are radians")
    if urdf is not None and urdf.suffix == XACRO:
        return xacro_as_urdf(urdf, arguments_of(arguments), package_dirs)
    if arguments:
        raise ConfigError(
            f"'{arguments[0]}' should be an argument of a xacro file, but the name of the model's "
            f"file does not end with {XACRO}"
        )
    if mjcf is not None:
        return mjcf_as_urdf(mjcf, package_dirs, root, angle)
    assert urdf is not None  # noqa: S101 - one of both is given
    return nullcontext(ReadableModel(urdf, package_dirs=tuple(package_dirs)))


@contextmanager
def xacro_as_urdf(
    path: Path, arguments: Mapping[str, str], package_dirs: Sequence[Path] = ()
) -> Iterator[ReadableModel]:
    """Expand a xacro file to a URDF, which exists inside the context.

    Args:
        path: The file, whose expressions are run.
        arguments: Its arguments, by name.
        package_dirs: Folders to look packages up in.

    Raises:
        MissingExtra: if the extra ``xacro`` is not installed.
        ModelError: if the file cannot be expanded.
    """
    with temporary_folder(path) as folder:
        urdf = folder / f"{path.name.partition('.')[0] or 'hand'}.urdf"
        expand(path, urdf, arguments, package_dirs)
        # Mesh paths are relative to the xacro file, but the URDF is in another folder.
        home = path.absolute().parent
        yield ReadableModel(urdf, package_dirs=(*package_dirs, home, *home.parents))


@contextmanager
def as_urdf_and_srdf(
    urdf: Path | None,
    mjcf: Path | None,
    srdf: Path | None,
    arguments: Sequence[str],
    package_dirs: Sequence[Path],
    root: str | None = None,
    angle: AngleUnit | None = None,
) -> Iterator[tuple[ReadableModel, Path | None]]:
    """Return a context in which a model exists as a URDF, and its SRDF, if any, as a plain file.

    ``arguments`` are those of the URDF's and the SRDF's xacro file; the other arguments and the
    errors are those of `as_urdf` and of the SRDF's expansion.
    """
    expanded = srdf is not None and srdf.suffix == XACRO
    # Only xacro files have arguments; with any other model, those given are the SRDF's.
    own = () if expanded and not (urdf and urdf.suffix == XACRO) else arguments
    with (
        as_urdf(urdf, mjcf, own, package_dirs, root, angle) as model,
        _as_srdf(srdf, arguments, package_dirs) as groups,
    ):
        yield model, groups


@contextmanager
def _as_srdf(
    path: Path | None, arguments: Sequence[str], package_dirs: Sequence[Path]
) -> Iterator[Path | None]:
    """Return a context in which an SRDF exists, expanded if its name ends with ``.xacro``.

    Raises:
        MissingExtra: if the extra ``xacro`` is not installed.
        ModelError: if the file cannot be expanded.
    """
    if path is None or path.suffix != XACRO:
        yield path
        return
    with temporary_folder(path) as folder:
        srdf = folder / f"{path.name.partition('.')[0] or 'hand'}.srdf"
        expand(path, srdf, arguments_of(arguments), package_dirs)
        yield srdf


@contextmanager
def mjcf_as_urdf(
    path: Path,
    folders: Sequence[Path] = (),
    root: str | None = None,
    angle: AngleUnit | None = None,
) -> Iterator[ReadableModel]:
    """Convert an MJCF file to a URDF, which exists inside the context.

    Its includes and meshes may be in further ``folders``. With a ``root``, the model may have free
    joints outside the hand below it. ``angle`` is the unit of a file that states none; ``None``:
    degrees.

    Raises:
        MissingExtra: if the extra ``sim`` is not installed.
        ModelError: if the file cannot be read, or has elements that a URDF cannot represent.
    """
    with needing_extra("reading MJCF", "sim"):
        from rtee.exchange.mjcf_import import import_mjcf
    with temporary_folder(path) as folder:
        radians = None if angle is None else angle is AngleUnit.RADIAN
        yield import_mjcf(path, folder, folders, root=root, radians=radians)
