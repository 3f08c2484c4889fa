"""Objects to grasp as bodies of a MuJoCo model; a drill has a trigger that can be pressed."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from rtee.drivers.mujoco.contacts import make_object
from rtee.hand.coarse import welded
from rtee.hand.tessellation import stl_corners
from rtee.objects.shape import (
    HANDLE,
    MOTOR,
    PLATE,
    TRIGGER_TRAVEL,
    ObjectShape,
    motor_place,
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
"""Triangles of an STL file that MuJoCo reads."""

_SPRING = 350.0
"""Stiffness of the trigger's spring [N/m]."""

_PRELOAD = 0.008
"""How far the trigger's spring is pressed when nothing presses the trigger [m]."""


def add_object(
    spec: mujoco.MjSpec, shape: ObjectShape, *, mass: float, pose: FloatArray
) -> mujoco.MjsBody:
    """Add a free object to a model and return its body.

    A pair has the friction of the shape that touches the object.

    Args:
        spec: The model.
        shape: What it looks like.
        mass: Its mass [kg].
        pose: Where it is ``(4, 4)``, in the world's frame.
    """
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(pose[:3, :3]).ravel())
    body = spec.worldbody.add_body(name=OBJECT, pos=pose[:3, 3], quat=quat)
    body.add_freejoint(name=OBJECT)
    body.gravcomp = 1.0  # what is 0 at compilation cannot be changed later
    if shape.kind == "drill":
        _add_drill(body, mass, shape.scale)
        return body
    geom = _geom(body, OBJECT, mass)
    match shape.kind:
        case "box":
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
            _set_size(geom, *(0.5 * value for value in shape.size))
        case "cylinder":
            geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
            _set_size(geom, shape.size[0], 0.5 * shape.size[1])
        case "sphere":
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
            _set_size(geom, shape.size[0])
        case "capsule":
            radius, length = shape.size
            geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE
            _set_size(geom, radius)
            # MuJoCo counts without the caps, which alone get smaller.
            geom.size[1] = 0.5 * length - radius
        case _:
            _add_mesh(spec, geom, shape)
    return body


def _geom(body: mujoco.MjsBody, name: str, mass: float) -> mujoco.MjsGeom:
    return body.add_geom(name=name, mass=mass, rgba=[0.74, 0.60, 0.44, 1.0])


def _set_size(geom: mujoco.MjsGeom, *half_extents: float) -> None:
    """Set the size of a shape [m], made smaller by its skin, and its contact."""
    skin = make_object(geom, half_extents)
    geom.size = [half - skin for half in half_extents] + [0.0] * (3 - len(half_extents))


def _add_mesh(spec: mujoco.MjSpec, geom: mujoco.MjsGeom, shape: ObjectShape) -> None:
    """Give a geom the mesh of a shape, made smaller by its skin about its middle."""
    mesh = _read_mesh(spec, str(shape.path))
    geom.type = mujoco.mjtGeom.mjGEOM_MESH
    geom.meshname = OBJECT
    mesh.scale = [shape.scale] * 3
    bounds = _bounds(str(shape.path))
    if bounds is None:  # the compilation of the whole says what is wrong with it
        return
    least, most = (shape.scale * corner for corner in bounds)
    half = 0.5 * (most - least)
    skin = make_object(geom, half.tolist())
    smaller = 1.0 - skin / half
    mesh.scale = shape.scale * smaller
    geom.pos = 0.5 * (least + most) * (1.0 - smaller)


def _read_mesh(spec: mujoco.MjSpec, path: str) -> mujoco.MjsMesh:
    corners = _corners(path)
    mesh = spec.add_mesh(name=OBJECT, file="" if corners is not None else path)
    if corners is not None:
        mesh.uservert = corners.ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    return mesh


@lru_cache(maxsize=4)
def _corners(path: str) -> FloatArray | None:
    """Return the corners of an STL file that MuJoCo refuses, of which it takes the hull anyway."""
    file = Path(path)
    corners = stl_corners(file.read_bytes()) if file.suffix.lower() == ".stl" else None
    return None if corners is None or len(corners) <= 3 * _MOST else welded(corners)[0]


@lru_cache(maxsize=4)
def _bounds(path: str) -> tuple[FloatArray, FloatArray] | None:
    """Return the least and the largest coordinates ``(3,)`` of a mesh; ``None``: it is no solid."""
    probe = mujoco.MjSpec()
    _read_mesh(probe, path)
    probe.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=OBJECT)
    try:
        model = probe.compile()
    except ValueError:
        return None
    # MuJoCo keeps the corners in the frame of the mesh's inertia.
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])
    corners = model.mesh_vert @ turn.reshape(3, 3).T + model.mesh_pos[0]
    return corners.min(axis=0), corners.max(axis=0)


def _add_drill(body: mujoco.MjsBody, mass: float, scale: float) -> None:
    """Add a pistol-like body: a handle along z, a motor above it, a sprung trigger before it.

    The trigger slides along y towards the handle, against a preloaded spring; its joint counts from
    0, not pressed, to `TRIGGER_TRAVEL`.
    """
    grip, top, button = (tuple(scale * value for value in part) for part in (HANDLE, MOTOR, PLATE))
    radius = 0.5 * grip[0]
    flat = 0.5 * grip[1] - radius
    # The shares of the mass add up to 1 and put the centre near the top of the handle, below the
    # motor.
    core = _geom(body, OBJECT, 0.2 * mass)
    core.type = mujoco.mjtGeom.mjGEOM_BOX
    _set_size(core, radius, flat, 0.5 * grip[2])
    for name, side in (("back", -1.0), ("front", 1.0)):
        edge = _geom(body, f"{OBJECT}/{name}", 0.15 * mass)
        edge.type = mujoco.mjtGeom.mjGEOM_CYLINDER
        _set_size(edge, radius, 0.5 * grip[2])
        edge.pos = [0.0, side * flat, 0.0]
    motor = _geom(body, f"{OBJECT}/motor", 0.45 * mass)
    motor.type = mujoco.mjtGeom.mjGEOM_BOX
    _set_size(motor, *(0.5 * value for value in top))
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
    plate = _geom(trigger, TRIGGER, 0.05 * mass)
    plate.type = mujoco.mjtGeom.mjGEOM_BOX
    _set_size(plate, *(0.5 * value for value in button))
    plate.rgba = [0.75, 0.15, 0.12, 1.0]
