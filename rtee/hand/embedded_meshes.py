"""Read the meshes of a hand as data, to embed them for programs without access to the files."""

from __future__ import annotations

import base64
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from rtee.errors import ModelError
from rtee.hand.files import read_bytes
from rtee.hand.meshes import resolve_mesh
from rtee.hand.model import Hand
from rtee.hand.names import MAX_LENGTH, free_name, safe_name
from rtee.hand.urdf import Urdf, UrdfGeometry

FOLDER: Final = "meshes"
"""Folder in the names of embedded meshes."""

LARGEST: Final = 48_000_000
"""Largest total size of all meshes as text in a description, where each may occur several times
[byte]; no message may be longer than 64 MB."""

_AS_TEXT: Final = 4 / 3
"""Characters of base64 per byte."""

MEDIA_TYPES: Final[Mapping[str, str]] = {
    ".stl": "model/stl",
    ".dae": "model/vnd.collada+xml",
    ".obj": "model/obj",
    ".glb": "model/gltf-binary",
    ".gltf": "model/gltf+json",
}
"""Media types by file name suffix, by which viewers recognize the format of a data URL."""

_MESH = re.compile(r"""(<(?:\w+:)?mesh\b[^<>]*?\bfilename\s*=\s*)(["'])(.*?)\2""", re.DOTALL)


@dataclass(frozen=True, slots=True)
class EmbeddedMesh:
    """A mesh as data.

    Attributes:
        name: A unique name, such as ``meshes/palm.stl``.
        path: The file it was read from, absolute.
        data: Its content.
    """

    name: str
    path: Path
    data: bytes

    @property
    def media_type(self) -> str:
        """Its media type; ``application/octet-stream`` if viewers do not know its format."""
        return MEDIA_TYPES.get(PurePosixPath(self.name).suffix, "application/octet-stream")

    @property
    def data_url(self) -> str | None:
        """Its content as a data URL; ``None`` if viewers do not know its format."""
        if PurePosixPath(self.name).suffix not in MEDIA_TYPES:
            return None
        return f"data:{self.media_type};base64,{base64.b64encode(self.data).decode()}"


@dataclass(frozen=True, slots=True)
class EmbeddedMeshes:
    """The meshes of a hand.

    Attributes:
        meshes: Meshes by their addresses in the URDF; two addresses may have the same mesh.
        left_out: Why a mesh is not embedded, by its address in the URDF.
    """

    meshes: Mapping[str, EmbeddedMesh]
    left_out: Mapping[str, str]

    @property
    def files(self) -> dict[str, EmbeddedMesh]:
        """The meshes by name."""
        return {mesh.name: mesh for mesh in self.meshes.values()}


def embed_meshes(hand: Hand, largest: int = LARGEST) -> EmbeddedMeshes:
    """Read the meshes of a hand, the visible ones first.

    Args:
        hand: The hand.
        largest: Largest total size of the meshes as text in a description [byte]; meshes beyond it
            are left out.
    """
    times = Counter(shape.mesh for shape in _shapes(hand.urdf))
    meshes: dict[str, EmbeddedMesh] = {}
    left_out: dict[str, str] = {}
    by_path: dict[Path, EmbeddedMesh] = {}
    names: set[str] = set()
    room = float(largest)
    for address in times:
        try:
            path = resolve_mesh(address, hand.urdf.path, hand.package_dirs).resolve()
            mesh = by_path.get(path)
            if mesh is None:
                data = read_bytes(path, "mesh", ModelError)
                stem = f"{FOLDER}/{safe_name(path.stem, 'mesh')}"
                name = free_name(stem, names, path.suffix.lower())
                names.add(name)
                mesh = EmbeddedMesh(name, path, data)
            # A description contains a mesh as often as its address occurs.
            size = _AS_TEXT * times[address] * len(mesh.data)
            if size > room:
                left_out[address] = f"the meshes take more than {largest / 1e6:g} MB"
                continue
            room -= size
            by_path[path] = mesh
        except ModelError as error:
            left_out[address] = str(error)
            continue
        meshes[address] = mesh
    return EmbeddedMeshes(meshes, left_out)


def _shapes(urdf: Urdf) -> Iterator[UrdfGeometry]:
    links = urdf.links.values()
    # Visual meshes first, since they matter more to viewers if there is not room for all.
    for shapes in (*(link.visuals for link in links), *(link.collisions for link in links)):
        yield from (shape for shape in shapes if shape.kind == "mesh")


def with_mesh_addresses(text: str, addresses: Mapping[str, str]) -> str:
    """Return the text of a URDF with new addresses of meshes by the old ones; others are kept."""
    if not addresses:
        return text
    import html  # only here: it holds a large table, and not every hand has meshes

    def replaced(match: re.Match[str]) -> str:
        new = addresses.get(html.unescape(match[3]).strip())
        return match[0] if new is None else f'{match[1]}"{html.escape(new)}"'

    # As text, to keep everything else, including comments.
    return _MESH.sub(replaced, text)


_DECLARATION: Final = re.compile(r"\A\s*<\?xml[^>]*\?>\s*")

_ENDING: Final = 10
"""Longest suffix of a mesh's name that is kept [characters]; those of mesh formats have up to five.
"""


@dataclass(frozen=True, slots=True)
class LocalMeshes:
    """A URDF with relative addresses of meshes, and the meshes to copy.

    Attributes:
        text: The URDF, with relative addresses.
        meshes: Present file of each mesh, by its path relative to the URDF.
        notes: A sentence for each mesh whose address was not changed.
    """

    text: str
    meshes: Mapping[str, Path]
    notes: tuple[str, ...]


def with_local_meshes(hand: Hand) -> LocalMeshes:
    """Return a hand's URDF with relative addresses of its meshes, and the files of the meshes.

    Raises:
        ModelError: if a collision mesh is missing; a missing visual mesh is only noted.
    """
    addresses: dict[str, str] = {}
    sources: dict[str, Path] = {}
    notes = []
    for uri, line, needed in _meshes(hand.urdf):
        try:
            source = resolve_mesh(uri, hand.urdf.path, hand.package_dirs, line=line)
        except ModelError as error:
            if needed:
                raise
            notes.append(f"a visual mesh was left where it is: {error}")
            continue
        place = PurePosixPath(_place(uri, source))
        # Two packages may have meshes of the same name.
        addresses[uri] = free_name(str(place.with_suffix("")), sources, place.suffix)
        sources[addresses[uri]] = source
    text = with_mesh_addresses(as_utf8(hand.urdf.text), addresses)
    return LocalMeshes(text, sources, tuple(notes))


def as_utf8(text: str) -> str:
    """Return the text of an XML file with a declaration for UTF-8."""
    return '<?xml version="1.0"?>\n' + _DECLARATION.sub("", text)


def _meshes(urdf: Urdf) -> list[tuple[str, int, bool]]:
    """Return each mesh: its address, its line, and whether it is collision geometry."""
    found: dict[str, tuple[str, int, bool]] = {}
    # Collision meshes first, since a mesh used for both must exist.
    for needed in (True, False):
        for link in urdf.links.values():
            for shape in link.collisions if needed else link.visuals:
                if shape.kind == "mesh":
                    found.setdefault(shape.mesh, (shape.mesh, shape.line, needed))
    return list(found.values())


def _place(uri: str, source: Path) -> str:
    """Return the new path of a mesh: inside its package, otherwise in the folder ``meshes``."""
    scheme, separator, rest = uri.partition("://")
    if separator:
        parts = [] if scheme == "file" else rest.split("/")[1:-1]
    else:
        parts = uri.split("/")[:-1]
    parts = [part for part in parts if part not in ("", ".")]
    # An address from an untrusted file must not lead out of the hand's folder.
    if ".." in parts or not parts:
        parts = ["meshes"]
    # The suffix separately, since it gives the format and must be kept.
    ending = re.sub(r"[^A-Za-z0-9.]", "", source.suffix)[:_ENDING]
    name = safe_name(source.stem, "mesh")[: MAX_LENGTH - _ENDING] + ending
    return "/".join([*(safe_name(part, "x") for part in parts), name])
