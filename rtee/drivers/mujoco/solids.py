"""Solids as shapes of MuJoCo, which have half their sizes, and the rotations of shapes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import mujoco
import numpy as np

from rtee.sample import FloatArray

_TYPES: Final = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
_KINDS: Final = {int(number): kind for kind, number in _TYPES.items()}


def turn_of(quaternion: FloatArray) -> FloatArray:
    """Return the rotation ``(3, 3)`` of a unit quaternion (w, x, y, z), as MuJoCo rounds it."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, quaternion)
    return turn.reshape(3, 3)


def half_extents(kind: str, size: Sequence[float]) -> list[float]:
    """Return half the edges of a box, or radius and half length of another solid [m].

    The size is that of `UrdfGeometry` and of objects. The half length of a capsule does not include
    its round ends.
    """
    if kind == "box":
        return [0.5 * edge for edge in size]
    radius, *lengths = size
    return [radius, *(0.5 * length - radius * (kind == "capsule") for length in lengths)]


def set_solid(geom: mujoco.MjsGeom, kind: str, halves: Sequence[float], skin: float = 0.0) -> None:
    """Make a geom a solid of half extents, smaller by a skin [m] on each side."""
    geom.type = _TYPES[kind]
    geom.size = [half - skin for half in halves] + [0.0] * (3 - len(halves))
    if kind == "capsule":  # the skin shrinks only its ends
        geom.size[1] = halves[1]


def solid_of(model: mujoco.MjModel, geom: int, skin: float = 0.0) -> tuple[str, tuple[float, ...]]:
    """Return kind and size [m] of a geom with a skin; the kind is empty if it is no solid.

    The length of a capsule does not include its round ends.
    """
    kind = _KINDS.get(int(model.geom_type[geom]), "")
    halves = [half + skin for half in model.geom_size[geom].tolist()]
    if kind == "box":
        return kind, tuple(2.0 * half for half in halves)
    if kind == "capsule":
        halves[1] -= skin
    return kind, (halves[0], 2.0 * halves[1])[: 1 if kind == "sphere" else 2]
