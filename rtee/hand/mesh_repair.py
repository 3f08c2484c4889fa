"""Repair meshes of several parts, whose triangles Coal's loader mixes up.

A file may contain several surfaces, one per material. The loader concatenates the vertices of all
surfaces, but the vertex indices in the triangles of each surface start from 0. So triangles of the
later surfaces refer to vertices of the first one, and the later vertices are unused. This module
separates the parts again: each begins with a triangle of its vertices 0, 1 and 2.
"""

from __future__ import annotations

from itertools import combinations
from tempfile import NamedTemporaryFile
from typing import Final

import coal
import numpy as np
from numpy.typing import NDArray

from rtee.hand.tessellation import binary_stl

_FEWEST: Final = 3
"""Least number of vertices of a part: those of one triangle."""

_MOST: Final = 12
"""Largest number of possible beginnings of parts; with more, the search would take too long."""

_LOST: Final = 8
"""Largest number of unused vertices, since the loader drops degenerate triangles."""

Faces = NDArray[np.int64]


def repaired(mesh: coal.BVHModelBase, loader: coal.MeshLoader) -> coal.BVHModelBase:
    """Return a mesh with correct triangles in all parts; the same object if it is correct already.

    Args:
        mesh: A mesh from Coal's loader.
        loader: A loader, which determines the kind of bounding volumes of the result.
    """
    corners = np.array(mesh.vertices())
    triangles = (mesh.tri_indices(i) for i in range(mesh.num_tris))
    faces = np.array([(t[0], t[1], t[2]) for t in triangles], dtype=np.int64)
    if len(faces) == 0 or len(corners) - (int(faces.max()) + 1) < _FEWEST:
        return mesh
    apart = split_parts(faces, len(corners))
    if apart is None:
        return mesh
    with NamedTemporaryFile(suffix=".stl") as file:
        # Through a file, since Coal's Python bindings make these bounding volumes only when they
        # load a mesh.
        file.write(binary_stl(corners[apart]))
        file.flush()
        return loader.load(file.name, np.ones(3))


def split_parts(faces: Faces, corners: int) -> Faces | None:
    """Return triangles ``(f, 3)`` with indices into all vertices; ``None`` for a single part.

    Args:
        faces: The triangles ``(f, 3)`` with indices from 0 in every part.
        corners: Number of vertices of all parts.
    """
    first = np.flatnonzero((np.sort(faces, axis=1) == (0, 1, 2)).all(axis=1))
    places = [int(i) for i in first if i > 0]
    if not places or len(places) > _MOST:
        return None
    best: tuple[int, Faces] | None = None
    # Many parts first, since with fewer ones, vertices of different parts would be connected.
    for count in range(len(places), 0, -1):
        for cuts in combinations(places, count):
            parts = np.split(faces, cuts)
            sizes = [int(part.max()) + 1 for part in parts]
            lost = corners - sum(sizes)
            if 0 <= lost <= _LOST and (best is None or lost < best[0]):
                begins = np.concatenate([[0], np.cumsum(sizes)[:-1]])
                best = lost, np.concatenate([p + b for p, b in zip(parts, begins, strict=True)])
    return None if best is None else best[1]
