"""Ray casting against a mesh on the processor, by Embree or, without it, in NumPy."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rtee.errors import needing_extra
from rtee.render.bvh import ClosestHits, NumpyScene
from rtee.render.mesh import Mesh
from rtee.render.sampling import normalised
from rtee.sample import FloatArray

log = logging.getLogger(__name__)

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Hits:
    """First hits of rays, without rays that hit nothing.

    Attributes:
        rays: Indices of the rays ``(k,)``.
        points: Hit points ``(k, 3)`` [m].
        normals: Unit normals there, interpolated over the triangle ``(k, 3)``.
        face_normals: Unit normals of the triangles ``(k, 3)``; both kinds face the ray's origin.
        links: Indices of the links hit ``(k,)``.
        depth: Distances along the rays ``(k,)`` [m].
    """

    rays: NDArray[np.int64]
    points: FloatArray
    normals: FloatArray
    face_normals: FloatArray
    links: NDArray[np.int64]
    depth: FloatArray


class Scene(Protocol):
    """Triangles for ray casting."""

    def closest(self, origins: FloatArray, directions: FloatArray) -> ClosestHits:
        """Return the closest hit of each ray ``(k, 3)``."""

    def occluded(self, origins: FloatArray, directions: FloatArray, reach: float) -> Mask:
        """Return which rays hit something within a distance [m]."""


class EmbreeScene:
    """Triangles in Embree."""

    def __init__(self, corners: FloatArray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene: Any = EmbreeScene()
        # Kept, since the mesh must live as long as the scene.
        self._mesh: Any = TriangleMesh(self._scene, corners.astype(np.float32))

    def closest(self, origins: FloatArray, directions: FloatArray) -> ClosestHits:
        """See `Scene.closest`."""
        hits = self._scene.run(_f32(origins), _f32(directions), output=1)
        return ClosestHits(hits["primID"], hits["u"], hits["v"], hits["tfar"])

    def occluded(self, origins: FloatArray, directions: FloatArray, reach: float) -> Mask:
        """See `Scene.occluded`."""
        far = np.full(len(origins), reach, dtype=np.float32)
        faces = self._scene.run(_f32(origins), _f32(directions), far, query="OCCLUDED")
        hit: Mask = np.asarray(faces) >= 0
        return hit


def check_pictures() -> None:
    """Check, before any work, that pictures can be made; warn once if they take long.

    Raises:
        MissingExtra: The extra ``plot`` is not installed.
    """
    with needing_extra("a picture", "plot"):
        import PIL.Image  # noqa: F401
    if not has_embree():
        warn_once()


@cache
def has_embree() -> bool:
    """Return whether Embree is installed; on ARM it has no package."""
    try:
        import embreex.rtcore_scene  # noqa: F401
    except ImportError:
        return False
    return True


@cache
def warn_once() -> None:
    """Warn once that pictures take long."""
    log.warning(
        "embreex is not installed: pictures are traced in numpy, which takes some seconds each"
    )


class RayCaster:
    """Casts rays against one mesh."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        kind = EmbreeScene if has_embree() else NumpyScene
        self._scene: Scene = kind(mesh.corners)

    def cast(self, origin: FloatArray, directions: FloatArray) -> Hits:
        """Return the closest hits of rays from one point."""
        origins = np.broadcast_to(origin, directions.shape)
        closest = self._scene.closest(origins, directions)
        rays = np.flatnonzero(closest.face >= 0)
        face = closest.face[rays]
        u, v = closest.u[rays, None], closest.v[rays, None]
        depth = closest.depth[rays].astype(np.float64)
        corners = self.mesh.normals[face]
        normals = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        triangle = self.mesh.corners[face]
        flat = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
        seen = directions[rays]
        # Meshes are not always wound outwards, so that normals of back faces are flipped.
        backwards = np.einsum("ij,ij->i", flat, seen) > 0
        flat[backwards] *= -1
        normals[backwards] *= -1
        return Hits(
            rays,
            origin + seen * depth[:, None],
            normalised(normals),
            normalised(flat),
            self.mesh.links[face],
            depth,
        )

    def occluded(self, points: FloatArray, directions: FloatArray, reach: float) -> Mask:
        """Return which rays hit something within a distance."""
        return self._scene.occluded(points, directions, reach)


def _f32(values: FloatArray) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)
