"""Find the mesh file for an address in a URDF, and check its content."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Final
from urllib.parse import unquote

from rtee.errors import ModelError
from rtee.hand.files import read_bytes, reason
from rtee.hand.urdf import Urdf, UrdfGeometry

FORMATS: Final = (".stl", ".dae", ".obj", ".ply", ".glb", ".gltf", ".off", ".3ds", ".fbx")

_HEAD: Final = 100_000
"""Length of the beginning of a COLLADA file that contains its unit [byte]."""

_NAME = re.compile(rb"<name>\s*([^<\s]+)\s*</name>")

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://(.*)\Z", re.DOTALL)


def resolve_mesh(
    uri: str, urdf: Path | str, package_dirs: Sequence[Path | str] = (), *, line: int | None = None
) -> Path:
    """Return the file of a mesh.

    A plain path is relative to the URDF. ``file://`` is absolute. ``package://NAME/REST`` is
    looked up in the folder of the URDF and the folders above it, in ``package_dirs`` (folders of
    packages, or packages), in ``ROS_PACKAGE_PATH`` and in ``share`` of ``AMENT_PREFIX_PATH``. A
    folder of another name is found if its ``package.xml`` has the name of the package.

    Args:
        uri: The mesh's address as in the URDF.
        urdf: The URDF's path.
        package_dirs: Folders in which to look up packages, before those of the environment.
        line: Line of the address in the URDF, for messages.

    Raises:
        ModelError: if there is no such file.
    """
    folder = Path(urdf).absolute().parent
    match = _SCHEME.match(uri)
    try:
        if match is None:
            candidates = [folder / uri]
            candidates += _elsewhere(uri, package_dirs)
        elif match[1] == "file":
            # file://localhost/… names the same file as file:///… (RFC 8089).
            place = unquote(match[2].removeprefix("localhost"))
            candidates = [Path(place), *_elsewhere(place, package_dirs)]
        elif match[1] in ("package", "model"):
            candidates = list(_in_packages(match[2], folder, package_dirs))
        else:
            raise ModelError(
                f"mesh '{uri}' is neither a path nor package:// nor file://", path=urdf, line=line
            )
        # Inside the block, since a name may be too long or hold a null character.
        found = next((path for path in candidates if path.is_file()), None)
    except (OSError, ValueError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(f"mesh '{uri[:200]}': {reason(error)}", path=urdf, line=line) from None
    if found is None:
        if match and match[1] != "file":
            hint = "; give its package's folder by --package-dir"
        elif match or Path(uri).is_absolute():
            hint = "; it is an absolute path, perhaps of another computer: give the folder that "
            hint += "has it here by --package-dir"
        else:
            hint = _slip(uri, candidates[0])
        raise ModelError(f"mesh '{uri}' does not exist{hint}", path=urdf, line=line)
    return found


def _slip(uri: str, path: Path) -> str:
    """Return what is likely wrong with a relative path, as the end of a sentence."""
    if "$(" in uri or "${" in uri:
        return "; it is left over from a xacro file, which must be expanded"
    if "\\" in uri:
        return "; URDFs separate folders by '/'"
    try:
        names = [each.name for each in path.parent.iterdir()]
    except OSError:
        return ""
    found = next((name for name in names if name.lower() == path.name.lower()), None)
    return "" if found is None else f"; did you mean '{found}'?"


def _elsewhere(address: str, package_dirs: Sequence[Path | str]) -> Iterator[Path]:
    """Yield the possible paths of a file in given folders.

    An absolute path may come from another computer; only its end is then the same here.
    """
    parts = Path(address).parts
    begins = range(1, len(parts)) if Path(address).is_absolute() else (0,)
    for begin in begins:
        for folder in package_dirs:
            # Such parts would lead out of the folders.
            if ".." not in parts[begin:] or begin == 0:
                yield Path(folder, *parts[begin:])


def _in_packages(address: str, folder: Path, package_dirs: Sequence[Path | str]) -> Iterator[Path]:
    """Yield the possible paths of a file in a package, the most specific one first."""
    package, _, rest = address.partition("/")
    for place in _packages(package, folder, package_dirs):
        yield place / rest
    # Even without a package.xml.
    for root in (folder, *(Path(p).absolute() for p in package_dirs)):
        yield root / rest


def _packages(package: str, folder: Path, package_dirs: Sequence[Path | str]) -> Iterator[Path]:
    """Yield the possible folders of a package by its name, the most specific one first."""
    given = [Path(p).absolute() for p in package_dirs]
    # A model is usually in the package that it names, or next to it.
    roots = [folder, *folder.parents, *given]
    for root in (*roots, *map(Path, _variable("ROS_PACKAGE_PATH"))):
        yield root / package
        if root.name == package:
            yield root
    for prefix in _variable("AMENT_PREFIX_PATH"):
        yield Path(prefix) / "share" / package
    # A package's folder may have been copied or renamed.
    for root in (
        *roots,
        *(each for place in given if place.is_dir() for each in sorted(place.iterdir())),
    ):
        if _declared(root) == package:
            yield root


def find_package(
    package: str, folder: Path, package_dirs: Sequence[Path | str] = ()
) -> Path | None:
    """Return the folder of a package; ``None`` if it is not found.

    It is looked up as for ``package://`` (see `resolve_mesh`).

    Args:
        package: Its name.
        folder: Folder of the file that names it.
        package_dirs: Folders in which to look it up, before those of the environment.
    """
    # Such names would lead out of the folders of packages.
    if package in ("", ".", "..") or "/" in package:
        return None
    return next((p for p in _packages(package, folder, package_dirs) if p.is_dir()), None)


def _declared(folder: Path) -> str | None:
    """Return the name in a folder's ``package.xml``, if it has one."""
    file = folder / "package.xml"
    if not file.is_file():
        return None
    found = _NAME.search(read_bytes(file, "package.xml", ModelError))
    return found[1].decode("utf-8", "replace") if found else None


def _variable(name: str) -> list[str]:
    return [part for part in os.environ.get(name, "").split(os.pathsep) if part]


def check_mesh(shape: UrdfGeometry, urdf: Urdf, package_dirs: Sequence[Path | str] = ()) -> Path:
    """Return the file of a mesh after a check of its content.

    Raises:
        ModelError: if the file does not exist, cannot be read, is empty or truncated, or has an
            unknown format.
    """
    path = resolve_mesh(shape.mesh, urdf.path, package_dirs, line=shape.line)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        what = f"has the unknown format '{suffix}'; valid: {', '.join(FORMATS)}"
        raise urdf.error(f"mesh '{shape.mesh}' {what}", shape.line)
    data = read_bytes(path, "mesh", ModelError)
    wrong = why_no_mesh(data, suffix)
    if wrong:
        raise urdf.error(f"mesh '{shape.mesh}' cannot be read: {wrong}", shape.line)
    return path


_UNIT: Final = re.compile(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']+)[\"']")


def unit_of(path: Path) -> float:
    """Return the length of a mesh's unit [m]: the one that a COLLADA file states, otherwise 1.

    Raises:
        ModelError: if the file cannot be read.
    """
    if path.suffix.lower() != ".dae":
        return 1.0
    found = _UNIT.search(read_bytes(path, "mesh", ModelError)[:_HEAD])
    try:
        unit = float(found[1]) if found else 1.0
    except ValueError:
        return 1.0
    return unit if 0.0 < unit < math.inf else 1.0


def why_no_mesh(data: bytes, suffix: str) -> str | None:
    """Return why a file is not a mesh of its format, by its suffix; ``None`` if it may be one."""
    if not data.strip():
        return "the file is empty"
    if data.startswith(b"version https://git-lfs"):
        return "it is a Git LFS pointer, not the mesh; run 'git lfs pull'"
    if suffix == ".stl":
        return _why_no_stl(data)
    if suffix == ".dae":
        if b"<COLLADA" not in data:
            return "it is not a COLLADA file"
        # Entities may expand without bound when the loader parses the file.
        if b"<!ENTITY" in data:
            return "it declares XML entities, which are refused"
    if suffix in _COUNTS:
        # The loader makes room for as many as are announced.
        # Twenty digits are more than any file has bytes.
        announced = sum(int(count[:20]) for count in _COUNTS[suffix](data))
        if announced * _LEAST > len(data):
            return f"it is truncated: {announced} vertices and faces announced in {len(data)} bytes"
    return None


_LEAST: Final = 1
"""Bytes that a vertex, face or other element takes at least, in any format."""


def _counts_of_ply(data: bytes) -> list[bytes]:
    head = data.partition(b"end_header")[0]
    return re.findall(rb"(?:^|[\r\n])[ \t]*element[ \t]+\S+[ \t]+(\d+)", head)


def _counts_of_off(data: bytes) -> list[bytes]:
    words = (found[1] for found in re.finditer(rb"#.*|(\S+)", data) if found[1])
    # "OFF", perhaps with letters before it, and then the numbers of vertices and faces.
    return [word for word in islice(words, 1, 3) if word.isdigit()]


_COUNTS: Final = {".ply": _counts_of_ply, ".off": _counts_of_off}


def _why_no_stl(data: bytes) -> str | None:
    # Binary files may also begin with "solid", but a text file soon has its first "facet".
    if data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:2000]:
        return None
    if len(data) < 84:
        return "it is not an STL file"
    # A binary STL: 80 bytes of header, the number of triangles, and 50 bytes for each.
    count = int.from_bytes(data[80:84], "little")
    if count == 0:
        return "it has no triangles"
    if len(data) < 84 + 50 * count:
        return f"it is truncated: {count} triangles announced, {(len(data) - 84) // 50} there"
    return None
