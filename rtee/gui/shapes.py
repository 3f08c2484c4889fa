"""The collision shapes of links as triangles, read without Coal where possible."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import trimesh

from rtee.errors import ModelError, needing_extra
from rtee.hand.frames import origin
from rtee.hand.meshes import check_mesh, unit_of
from rtee.hand.model import Hand
from rtee.hand.tessellation import Triangles, box, cylinder, sphere
from rtee.hand.urdf import UrdfGeometry

LinkTriangles = Callable[[str], Triangles]
"""Returns a link's vertices ``(v, 3)`` [m] in the link's frame and faces ``(f, 3)``."""

_COAL_ONLY: Final = (".3ds", ".fbx")
"""Mesh formats that trimesh does not read."""


def link_triangles(hand: Hand) -> LinkTriangles:
    """Return a function that gives the triangles of a link's collision shapes.

    Here or when it is called, raises `ModelError` if a mesh is missing or cannot be read, and
    `MissingExtra` if a mesh has a format that only Coal reads, which is not installed.
    """
    shapes = (shape for link in hand.urdf.links.values() for shape in link.collisions)
    formats = {Path(shape.mesh).suffix.lower() for shape in shapes if shape.kind == "mesh"}
    for unread in formats.intersection(_COAL_ONLY):
        with needing_extra(f"a mesh in the format {unread}", "extract"):
            from rtee.hand.geometry import HandGeometry
        return HandGeometry(hand).triangles

    @cache
    def triangles(link: str) -> Triangles:
        vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
        for shape in hand.urdf.links[link].collisions:
            points, corners = _of_shape(hand, shape)
            pose = origin(shape.xyz, shape.rpy)
            vertices.append(points @ pose[:3, :3].T + pose[:3, 3])
            faces.append(corners + count)
            count += len(points)
        return np.concatenate(vertices), np.concatenate(faces)

    return triangles


def _of_shape(hand: Hand, shape: UrdfGeometry) -> Triangles:
    if shape.kind == "box":
        return box(shape.size)
    if shape.kind == "sphere":
        return sphere(shape.radius)
    if shape.kind == "cylinder":
        return cylinder(shape.radius, shape.length)
    path = check_mesh(shape, hand.urdf, hand.package_dirs)
    try:
        # Unprocessed, since merging vertices takes seconds and does not show.
        mesh = trimesh.load_mesh(str(path), process=False)
        points, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # each reader of trimesh raises its own exceptions
        raise _refusal(hand, shape, f"cannot be read: {error}") from error
    if not len(faces):
        raise _refusal(hand, shape, "has no triangles")
    if not np.isfinite(points).all():
        raise _refusal(hand, shape, "has a vertex that is not finite")
    return points * (unit_of(path) * np.array(shape.scale)), faces


def _refusal(hand: Hand, shape: UrdfGeometry, why: str) -> ModelError:
    return ModelError(f"mesh '{shape.mesh}' {why}", path=hand.urdf.path, line=shape.line)
