"""A hand as one mesh of triangles, with normals that are smooth except at edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from rtee.hand.geometry import HandGeometry
from rtee.hand.tessellation import Triangles
from rtee.sample import FloatArray

IntArray = NDArray[np.int64]

CREASE: Final = math.radians(35.0)
"""Largest angle between faces on a smooth surface; a larger one is an edge [rad]."""

_CROWDED: Final = 500
"""Largest number of faces around a vertex to compare with one another: their 250,000 pairs take
about 25 MB. Only the centres of discs have more."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with a normal at every corner.

    Attributes:
        corners: Corners ``(t, 3, 3)`` [m].
        normals: Unit normals at the corners ``(t, 3, 3)``.
        links: Index of the link of each triangle ``(t,)``.
    """

    corners: FloatArray
    normals: FloatArray
    links: IntArray

    @classmethod
    def of(cls, triangles: Triangles, link: int) -> Self:
        """Return the triangles of a link, with smooth normals, in its frame."""
        vertices, faces = triangles
        normals = smooth_normals(vertices, faces)
        return cls(vertices[faces], normals, np.full(len(faces), link))

    @classmethod
    def joined(cls, meshes: Sequence[Mesh]) -> Self:
        """Return the triangles of several meshes."""
        return cls(
            np.concatenate([mesh.corners for mesh in meshes]),
            np.concatenate([mesh.normals for mesh in meshes]),
            np.concatenate([mesh.links for mesh in meshes]),
        )

    def placed(self, pose: FloatArray) -> Mesh:
        """Return the mesh, transformed by the pose ``(4, 4)`` of its frame."""
        turn = pose[:3, :3].T
        return Mesh(self.corners @ turn + pose[:3, 3], self.normals @ turn, self.links)


class HandMesh:
    """The geometry of a hand, posed as one mesh.

    Attributes:
        geometry: The hand's visual or collision geometry.
        links: The links with geometry, in the order of the URDF's tree.
    """

    def __init__(self, geometry: HandGeometry) -> None:
        self.geometry = geometry
        self.links = tuple(dict.fromkeys(shape.link for shape in geometry.shapes))
        parts = map(geometry.triangles, self.links)
        self._parts = [Mesh.of(triangles, index) for index, triangles in enumerate(parts)]

    def at(self, u: FloatArray) -> Mesh:
        """Return the mesh in the hand's base frame at actuator positions ``(n,)`` [rad | m]."""
        poses = self.geometry.kinematics.placements(u)
        parts = zip(self.links, self._parts, strict=True)
        return Mesh.joined([part.placed(poses[link]) for link, part in parts])


def smooth_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return a unit normal for each corner of each face ``(f, 3, 3)``.

    The normal of a corner is the mean of the normals of the faces around the vertex that meet the
    corner's own face at less than `CREASE`, weighted by their angles at the vertex.

    Args:
        vertices: Vertices ``(v, 3)`` [m]; coincident vertices count as one.
        faces: Indices of vertices ``(f, 3)``.
    """
    if not len(faces):
        return np.zeros((0, 3, 3))
    corners = vertices[faces]
    flat, angles = _face_normals(corners)
    # Pair every corner with all corners at the same vertex, including itself. The pairs of a corner
    # are consecutive, so one reduceat sums the normals around it.
    place = _same_vertices(corners.reshape(-1, 3))
    # Corners at crowded vertices count as separate vertices, and keep the normals of their faces.
    crowded = np.bincount(place)[place] > _CROWDED
    if crowded.any():
        apart = np.where(crowded, len(place) + np.arange(len(place)), place)
        place = np.unique(apart, return_inverse=True)[1].ravel()
    order = np.argsort(place, kind="stable")
    counts = np.bincount(place[order])
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    mine = np.repeat(np.arange(len(order)), counts[place[order]])
    first_pair = np.concatenate([[0], np.cumsum(counts[place[order]])[:-1]])
    other = np.arange(len(mine)) - first_pair[mine] + starts[place[order]][mine]
    own_face, other_face = order[mine] // 3, order[other] // 3
    smooth = np.einsum("ij,ij->i", flat[own_face], flat[other_face]) > math.cos(CREASE)
    weight = np.where(smooth, angles.ravel()[order[other]], 0.0)
    total = np.add.reduceat(flat[other_face] * weight[:, None], first_pair)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    result = np.empty((len(order), 3))
    result[order] = np.where(length > 1e-12, total / np.maximum(length, 1e-12), flat[order // 3])
    return result.reshape(-1, 3, 3)


def _face_normals(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit normals ``(f, 3)`` and the angles at the corners ``(f, 3)`` [rad]."""
    edges = np.roll(corners, -1, axis=1) - corners
    normals = np.cross(edges[:, 0], -edges[:, 2])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    edges /= np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-30)
    cosines = -np.einsum("fij,fij->fi", edges, np.roll(edges, 1, axis=1))
    return normals, np.arccos(np.clip(cosines, -1.0, 1.0))


def _same_vertices(points: FloatArray) -> IntArray:
    """Return a number for each point, which coincident points share."""
    extent = float(np.ptp(points, axis=0).max()) or 1.0
    grid = np.round((points - points.min(axis=0)) * (2**20 / extent)).astype(np.int64)
    # Three coordinates of 21 bits make one number of 63 bits, which sorts fast.
    keys = (grid[:, 0] << 42) | (grid[:, 1] << 21) | grid[:, 2]
    _, inverse = np.unique(keys, return_inverse=True)
    return inverse.ravel()
