"""Rays against the surface of a hand, on the processor: by Embree, or without it in numpy."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rtee.errors import MissingExtra
from rtee.extract.report_mesh import Surface
from rtee.extract.report_rays import FirstHits, NumpyScene
from rtee.extract.report_sampling import normalised
from rtee.types import FloatArray

log = logging.getLogger(__name__)

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


class Scene(Protocol):
    """Triangles that rays may hit."""

    def first(self, origins: FloatArray, directions: FloatArray) -> FirstHits:
        """Return what rays ``(k, 3)`` hit first."""

    def blocked(self, origins: FloatArray, directions: FloatArray, reach: float) -> Mask:
        """Return which rays hit something within a distance [m]."""


class EmbreeScene:
    """Triangles in Embree."""

    def __init__(self, corners: FloatArray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene: Any = EmbreeScene()
        # The mesh must live as long as the scene.
        self._mesh: Any = TriangleMesh(self._scene, corners.astype(np.float32))

    def first(self, origins: FloatArray, directions: FloatArray) -> FirstHits:
        """See `Scene.first`."""
        found = self._scene.run(_f32(origins), _f32(directions), output=1)
        return FirstHits(found["primID"], found["u"], found["v"], found["tfar"])

    def blocked(self, origins: FloatArray, directions: FloatArray, reach: float) -> Mask:
        """See `Scene.blocked`."""
        far = np.full(len(origins), reach, dtype=np.float32)
        found = self._scene.run(_f32(origins), _f32(directions), far, query="OCCLUDED")
        hit: Mask = np.asarray(found) >= 0
        return hit


def check_pictures() -> None:
    """Check, before any work, that pictures can be made; say once if it takes long.

    Raises:
        MissingExtra: The extra ``plot`` is not installed.
    """
    try:
        import PIL.Image  # noqa: F401
    except ImportError:
        raise MissingExtra("a picture", "plot") from None
    if not embree():
        tell_once()


@cache
def embree() -> bool:
    """Return whether Embree is there; on ARM it has no package."""
    try:
        import embreex.rtcore_scene  # noqa: F401
    except ImportError:
        return False
    return True


@cache
def tell_once() -> None:
    """Say that pictures take long."""
    log.warning(
        "embreex is not installed: pictures are traced in numpy, which takes some seconds each"
    )


class Tracer:
    """Rays against one surface."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        kind = EmbreeScene if embree() else NumpyScene
        self._scene: Scene = kind(surface.corners)

    def cast(self, origin: FloatArray, directions: FloatArray) -> Hits:
        """Return what rays from one point hit first."""
        origins = np.broadcast_to(origin, directions.shape)
        found = self._scene.first(origins, directions)
        which = np.flatnonzero(found.face >= 0)
        face = found.face[which]
        u, v = found.u[which, None], found.v[which, None]
        depth = found.depth[which].astype(np.float64)
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
        return self._scene.blocked(points, directions, reach)


def _f32(values: FloatArray) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)
