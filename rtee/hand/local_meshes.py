"""Make a URDF that can be moved together with its meshes, by relative addresses."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from rtee.errors import ModelError
from rtee.hand.embedded_meshes import with_mesh_addresses
from rtee.hand.meshes import resolve_mesh
from rtee.hand.model import Hand
from rtee.hand.names import MAX_LENGTH, free_name, safe_name
from rtee.hand.urdf import Urdf

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
        ModelError: A collision mesh is missing; a missing visual mesh is only noted.
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
    """Return the new path of a mesh: that inside its package, or else in the folder ``meshes``."""
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
