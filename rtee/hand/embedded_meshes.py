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
from rtee.hand.names import free_name, safe_name
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
