"""Rays against the surface of a hand, on the processor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtee.extract.report_mesh import Surface
from rtee.extract.report_sampling import normalised
from rtee.types import FloatArray

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Hits:
    """What rays hit: points, normals and links of those that hit something."""

    which: NDArray[np.int64]
    points: FloatArray
    normals: FloatArray
    flat: FloatArray
    links: NDArray[np.int64]
    depth: FloatArray


class Tracer:
    """Rays against one surface."""

    def __init__(self, surface: Surface) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.surface = surface
        self._scene: Any = EmbreeScene()
        # The mesh must live as long as the scene.
        self._mesh: Any = TriangleMesh(self._scene, surface.corners.astype(np.float32))

    def cast(self, origin: FloatArray, directions: FloatArray) -> Hits:
        """Return what rays from one point hit first."""
        origins = np.broadcast_to(origin, directions.shape)
        found = self._scene.run(_f32(origins), _f32(directions), output=1)
        which = np.flatnonzero(found["primID"] >= 0)
        face = found["primID"][which]
        u, v = found["u"][which, None], found["v"][which, None]
        depth = found["tfar"][which].astype(np.float64)
        corners = self.surface.normals[face]
        normals = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        triangle = self.surface.corners[face]
        flat = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
        seen = directions[which]
        # Meshes are not always wound outwards: turn what shows its back.
        backwards = np.einsum("ij,ij->i", flat, seen) > 0
        flat[backwards] *= -1
        normals[backwards] *= -1
        return Hits(
            which,
            origin + seen * depth[:, None],
            normalised(normals),
            normalised(flat),
            self.surface.links[face],
            depth,
        )

    def blocked(self, points: FloatArray, directions: FloatArray, reach: float) -> Mask:
        """Return which rays hit something within a distance."""
        far = np.full(len(points), reach, dtype=np.float32)
        found = self._scene.run(_f32(points), _f32(directions), far, query="OCCLUDED")
        hit: Mask = np.asarray(found) >= 0
        return hit


def _f32(values: FloatArray) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)
