"""The convex solids that stand for a mesh in planning and simulation."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rtee.hand.files import write_atomically
from rtee.objects.shape import MOST_PARTS, hollow_mesh
from rtee.sample import FloatArray

Faces: TypeAlias = NDArray[np.int64]
Solid: TypeAlias = tuple[FloatArray, Faces]
"""Corners ``(v, 3)`` [m] and triangles, as indices of corners ``(t, 3)``."""

_METHOD: Final = {
    "threshold": 0.05,
    "mcts_nodes": 10,
    "mcts_iterations": 60,
    "mcts_max_depth": 2,
    "resolution": 1000,
    "seed": 0,
}
"""A piece's hull may lie beyond the surface by 5 % of the mesh's size (CoACD's own measure); a ring
of 70 mm becomes 12 pieces, 1.4 mm inside its hole, in a second instead of five."""

_FINE: Final = 10_000
"""Number of triangles above which the surface is resampled first: otherwise, cuts take minutes."""

_PLACES: Final = 6
"""Decimal places of corners [m]: readers of files differ by less."""


def convex_solids(corners: FloatArray, parts: Sequence[Faces]) -> list[Solid]:
    """Return the solids whose convex hulls stand for a mesh.

    A part with hollows, handles or holes is divided by CoACD (X. Wei et al., *ACM Trans. Graphics*
    41(4), 2022), once: its pieces are kept in ``$XDG_CACHE_HOME/rtee/convex`` (else ``~/.cache``).
    Without the extra ``planning`` it is one solid.

    Args:
        corners: Corners of the mesh ``(v, 3)`` [m].
        parts: The triangles of each of its parts, as indices of corners ``(t, 3)``.
    """
    most = max(2, MOST_PARTS // max(1, len(parts)))
    divides = importlib.util.find_spec("coacd") is not None
    found: list[Solid] = []
    for part in parts:
        used, local = np.unique(part, return_inverse=True)
        solid = corners[used], local.reshape(-1, 3)
        found += (divides and hollow_mesh(*solid) and _pieces(*solid, most)) or [solid]
    return found


def _pieces(corners: FloatArray, faces: Faces, most: int) -> list[Solid]:
    """Return the pieces of a part, at most ``most``; none if it cannot be divided."""
    # Sorted, so that every reader of the file gets the same pieces.
    corners, place = np.unique(np.round(corners, _PLACES) + 0.0, axis=0, return_inverse=True)
    faces = place.reshape(-1)[faces]
    turn = faces.argmin(axis=1)[:, None] + np.arange(3)
    faces = np.unique(np.take_along_axis(faces, turn % 3, axis=1), axis=0)
    asked = corners.tobytes() + faces.tobytes() + json.dumps([_METHOD, most]).encode()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    file = cache / "rtee" / "convex" / f"{hashlib.sha256(asked).hexdigest()[:32]}.json"
    with suppress(OSError, ValueError, TypeError):
        return [
            (np.array(points, np.float64).reshape(-1, 3), np.array(sides, np.int64).reshape(-1, 3))
            for points, sides in json.loads(file.read_text())
        ]
    found = list(_divided(corners, faces, most))
    with suppress(OSError):  # without a home directory, it is computed again
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, json.dumps([(p.tolist(), f.tolist()) for p, f in found]))
    return found


def _divided(corners: FloatArray, faces: Faces, most: int) -> Iterator[Solid]:
    import coacd

    coacd.set_log_level("error")
    sampled = "on" if len(faces) > _FINE else "auto"
    mesh = coacd.Mesh(corners, faces)
    try:
        cut = coacd.run_coacd(mesh, max_convex_hull=most, preprocess_mode=sampled, **_METHOD)
    except RuntimeError:
        return
    for points, sides in cut:
        if len(points) > 3:
            yield np.asarray(points, np.float64), np.asarray(sides, np.int64)
