"""Objects to grasp as bodies of a MuJoCo model; a drill has a trigger that can be pressed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from rtee.drivers.mujoco.contacts import make_object
from rtee.drivers.mujoco.solids import half_extents, set_solid, turn_of
from rtee.hand.coarse import welded
from rtee.hand.convex import Solid, convex_solids
from rtee.hand.tessellation import stl_corners
from rtee.objects.shape import (
    HANDLE,
    MOST_PARTS,
    MOTOR,
    PLATE,
    TRIGGER_TRAVEL,
    ObjectShape,
    check_thick,
    mesh_parts,
    motor_place,
    signed_volume,
    trigger_place,
)
from rtee.sample import FloatArray

OBJECT = "object"
"""Name of the object's body, joint and (first) geom."""

TRIGGER = "object/trigger"
"""Name of the body and joint of a trigger."""

MESHES = (".stl", ".obj")
"""Suffixes of the mesh files that MuJoCo reads."""

_MOST = 200_000
"""Largest number of triangles in an STL file that MuJoCo reads."""

_SPRING = 350.0
"""Stiffness of the trigger's spring [N/m]."""

_PRELOAD = 0.008
"""How far the trigger's spring is pressed when nothing presses the trigger [m]."""


def add_object(
    spec: mujoco.MjSpec, shape: ObjectShape, *, mass: float, pose: FloatArray
) -> mujoco.MjsBody:
    """Add a free object to a model and return its body.

    Each contact has the friction of the shape that touches the object.

    Args:
        spec: The model.
        shape: The object's shape.
        mass: Its mass [kg].
        pose: Its pose ``(4, 4)`` in the world's frame.
    """
    body = add_body(spec, pose)
    if shape.kind == "drill":
        _add_drill(body, mass, shape.scale)
        return body
    if shape.path is not None:
        _add_mesh(spec, body, shape, mass)
        return body
    _add_solid(body, OBJECT, mass, shape.kind, shape.size)
    return body


def add_body(spec: mujoco.MjSpec, pose: FloatArray) -> mujoco.MjsBody:
    """Add a free object without any shape at a pose ``(4, 4)`` in the world; return its body."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(pose[:3, :3]).ravel())
    body = spec.worldbody.add_body(name=OBJECT, pos=pose[:3, 3], quat=quat)
    body.add_freejoint(name=OBJECT)
    body.gravcomp = 1.0  # a value that is 0 at compilation cannot be changed later
    return body


def _geom(body: mujoco.MjsBody, name: str, mass: float) -> mujoco.MjsGeom:
    return body.add_geom(name=name, mass=mass, rgba=[0.74, 0.60, 0.44, 1.0])


def _add_solid(
    body: mujoco.MjsBody, name: str, mass: float, kind: str, size: Sequence[float]
) -> mujoco.MjsGeom:
    """Add a solid of a size [m], reduced by its skin, with its contact parameters."""
    geom, halves = _geom(body, name, mass), half_extents(kind, size)
    skin = make_object(geom, halves[:1] if kind == "capsule" else halves)
    set_solid(geom, kind, halves, skin)
    return geom


def _add_mesh(spec: mujoco.MjSpec, body: mujoco.MjsBody, shape: ObjectShape, mass: float) -> None:
    """Add a mesh: the convex hull of each of its parts."""
    parts = solid_parts(str(shape.path), shape.scale)
    if len(parts) < 2:
        geom = _geom(body, OBJECT, mass)
        mesh = _read_mesh(spec, str(shape.path))
        geom.type = mujoco.mjtGeom.mjGEOM_MESH
        geom.meshname = OBJECT
        mesh.scale = [shape.scale] * 3
        if parts:  # without parts, compiling the whole model reports the error
            smaller, geom.pos = _shrunk(geom, shape.scale * parts[0][0])
            mesh.scale = shape.scale * smaller
        return
    volumes = np.array([abs(signed_volume(corners[faces])) for corners, faces in parts])
    # An open part may enclose nothing, but MuJoCo requires each part to have a mass.
    volumes += 1e-3 * volumes.max() + 1e-12
    add_hulls(spec, body, [shape.scale * c for c, _ in parts], mass * volumes / volumes.sum())


def add_hulls(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, hulls: Sequence[FloatArray], masses: FloatArray
) -> None:
    """Add the convex hulls of points ``(k, 3)`` to an object, with their masses ``(n,)`` [kg]."""
    for number, (points, mass) in enumerate(zip(hulls, masses.tolist(), strict=True)):
        geom = _geom(body, f"{OBJECT}/{number}" if number else OBJECT, mass)
        mesh = spec.add_mesh(name=geom.name)
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        geom.type = mujoco.mjtGeom.mjGEOM_MESH
        geom.meshname = mesh.name
        smaller, geom.pos = _shrunk(geom, points)
        mesh.uservert = (points * smaller).ravel()


def _shrunk(geom: mujoco.MjsGeom, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Give a mesh of points ``(k, 3)`` its contact parameters, and return how it shrinks.

    Returns:
        The factor along each axis ``(3,)``, and the new position of the geom ``(3,)`` [m].
    """
    least, most = points.min(axis=0), points.max(axis=0)
    half = 0.5 * (most - least)
    smaller = 1.0 - make_object(geom, half.tolist()) / half
    return smaller, 0.5 * (least + most) * (1.0 - smaller)


def _read_mesh(spec: mujoco.MjSpec, path: str) -> mujoco.MjsMesh:
    corners = _corners(path)
    mesh = spec.add_mesh(name=OBJECT, file="" if corners is not None else path)
    if corners is not None:
        mesh.uservert = corners.ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    return mesh


@lru_cache(maxsize=4)
def _corners(path: str) -> FloatArray | None:
    """Return the vertices of an STL file that MuJoCo refuses; only their hull is needed."""
    file = Path(path)
    corners = stl_corners(file.read_bytes()) if file.suffix.lower() == ".stl" else None
    return None if corners is None or len(corners) <= 3 * _MOST else welded(corners)[0]


@lru_cache(maxsize=4)
def solid_parts(path: str, scale: float = 1.0) -> tuple[Solid, ...]:
    """Return the solids of a mesh file, unscaled; see `convex_solids`.

    A mesh of more than `MOST_PARTS` parts counts as one solid; the result is empty if the mesh is
    not solid, as in a plane.

    Raises:
        ModelError: if a part of it is thinner than any object may be, at the scale.
    """
    probe = mujoco.MjSpec()
    _read_mesh(probe, path)
    probe.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=OBJECT)
    try:
        model = probe.compile()
    except ValueError:
        return ()
    # MuJoCo keeps the corners in the frame of the mesh's inertia.
    corners = model.mesh_vert @ turn_of(model.mesh_quat[0]).T + model.mesh_pos[0]
    faces = model.mesh_face.astype(np.int64)
    _, place = np.unique(model.mesh_vert, axis=0, return_inverse=True)
    parts = mesh_parts(place.reshape(-1)[faces], len(corners))
    first = np.unique(place, return_index=True)[1]
    whole = [place.reshape(-1)[faces]]
    used = parts if len(parts) <= MOST_PARTS else whole
    check_thick(scale * corners[first], used, Path(path))
    return tuple(convex_solids(corners[first], used))


def _add_drill(body: mujoco.MjsBody, mass: float, scale: float) -> None:
    """Add a pistol-like body: a handle along z, a motor above and a sprung trigger in front of it.

    The trigger slides along y towards the handle, against a preloaded spring; its joint counts from
    0, not pressed, to `TRIGGER_TRAVEL`.
    """
    grip, top, button = (tuple(scale * value for value in part) for part in (HANDLE, MOTOR, PLATE))
    radius = 0.5 * grip[0]
    flat = 0.5 * grip[1] - radius
    # The shares of the mass add up to 1 and put the centre near the top of the handle, below the
    # motor.
    _add_solid(body, OBJECT, 0.2 * mass, "box", (grip[0], 2.0 * flat, grip[2]))
    for name, side in (("back", -1.0), ("front", 1.0)):
        size = radius, grip[2]
        edge = _add_solid(body, f"{OBJECT}/{name}", 0.15 * mass, "cylinder", size)
        edge.pos = [0.0, side * flat, 0.0]
    motor = _add_solid(body, f"{OBJECT}/motor", 0.45 * mass, "box", top)
    motor.pos = motor_place(scale)
    trigger = body.add_body(name=TRIGGER, pos=trigger_place(scale))
    joint = trigger.add_joint(
        name=TRIGGER, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0.0, -1.0, 0.0], armature=0.01
    )
    joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    joint.range = [0.0, TRIGGER_TRAVEL]
    # The stops are as hard as contacts: a finger's force must not push the trigger beyond its
    # travel.
    joint.solref_limit = [0.004, 1.0]
    joint.solimp_limit = [0.99, 0.999, 0.0005, 0.5, 2.0]
    joint.stiffness = [_SPRING, 0.0, 0.0]
    joint.springref = -_PRELOAD
    # In N·s/m: a released trigger returns without swinging.
    joint.damping = [2.0, 0.0, 0.0]
    plate = _add_solid(trigger, TRIGGER, 0.05 * mass, "box", button)
    plate.rgba = [0.75, 0.15, 0.12, 1.0]
