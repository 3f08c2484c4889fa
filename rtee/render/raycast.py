"""Ray casting against a mesh on the CPU, with Embree."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtee.errors import ConfigError, needing_extra
from rtee.render.mesh import Mesh
from rtee.sample import FloatArray

_LIGHT_ANGLE: Final = math.radians(9.0)
"""Angular radius of the light [rad], which gives shadows soft edges."""

_GOLDEN_SECTION: Final = (math.sqrt(5.0) - 1.0) / 2.0
"""The golden ratio, whose multiples modulo 1 are spread most evenly."""


def normalised(vectors: FloatArray) -> FloatArray:
    """Return vectors ``(k, 3)`` scaled to length 1."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    result: FloatArray = vectors / np.maximum(length, 1e-12)
    return result


def fibonacci_lattice(index: NDArray[np.int64], count: int) -> tuple[FloatArray, FloatArray]:
    """Return the coordinates of the given points of a Fibonacci lattice in the unit square."""
    return (index + 0.5) / count, np.mod(index * _GOLDEN_SECTION, 1.0)


def orthonormal_basis(normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two unit vectors perpendicular to each normal.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited", 2017.
    """
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    # No branches, and none of the singularities of a cross product with a fixed axis.
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return first, np.stack([b, sign + y * y * a, -y], axis=1)


def cosine_hemisphere(normals: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return directions around normals, with density proportional to the cosine of the angle."""
    first, second = orthonormal_basis(normals)
    radius, turn = np.sqrt(a)[:, None], 2 * math.pi * b[:, None]
    height = np.sqrt(1 - a)[:, None]
    return radius * (np.cos(turn) * first + np.sin(turn) * second) + height * normals


def cone(axis: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return directions in the narrow cone of the light around an axis."""
    first, second = orthonormal_basis(axis[None])
    radius = math.tan(_LIGHT_ANGLE) * np.sqrt(a)[:, None]
    turn = 2 * math.pi * b[:, None]
    return normalised(axis + radius * (np.cos(turn) * first + np.sin(turn) * second))


Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Hits:
    """First hits of rays; rays that hit nothing are left out.

    Attributes:
        rays: Indices of the rays ``(k,)``.
        points: Hit points ``(k, 3)`` [m].
        normals: Unit normals there, interpolated over the triangle ``(k, 3)``.
        face_normals: Unit normals of the triangles ``(k, 3)``; both kinds face the ray's origin.
        links: Indices of the links that were hit ``(k,)``.
        depth: Distances along the rays ``(k,)`` [m].
    """

    rays: NDArray[np.int64]
    points: FloatArray
    normals: FloatArray
    face_normals: FloatArray
    links: NDArray[np.int64]
    depth: FloatArray


def check_pictures() -> None:
    """Check, before any work, that pictures can be rendered.

    Raises:
        MissingExtra: if the extra ``plot`` is not installed.
        ConfigError: if embreex is missing, which has packages for x86-64 only.
    """
    with needing_extra("a picture", "plot"):
        import PIL.Image  # noqa: F401
    try:
        import embreex.rtcore_scene  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            "a picture needs embreex, which has packages for x86-64 only;"
            " elsewhere `pip install embreex` builds it with a C++ compiler"
        ) from error


class RayCaster:
    """Casts rays against one mesh."""

    def __init__(self, mesh: Mesh) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.mesh = mesh
        self._scene: Any = EmbreeScene()
        # Keep a reference: the mesh must live as long as the scene.
        self._triangles: Any = TriangleMesh(self._scene, _f32(mesh.corners))

    def cast(self, origin: FloatArray, directions: FloatArray) -> Hits:
        """Return the closest hits of rays from one point."""
        origins = np.broadcast_to(origin, directions.shape)
        closest = self._scene.run(_f32(origins), _f32(directions), output=1)
        rays = np.flatnonzero(closest["primID"] >= 0)
        face = closest["primID"][rays]
        u, v = closest["u"][rays, None], closest["v"][rays, None]
        depth = closest["tfar"][rays].astype(np.float64)
        corners = self.mesh.normals[face]
        normals = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        triangle = self.mesh.corners[face]
        flat = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
        seen = directions[rays]
        # Meshes are not always wound outwards: flip the normals of back faces.
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
        far = np.full(len(points), reach, dtype=np.float32)
        faces = self._scene.run(_f32(points), _f32(directions), far, query="OCCLUDED")
        return np.asarray(faces) >= 0


def _f32(values: FloatArray) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)
