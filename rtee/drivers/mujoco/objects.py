"""Objects to grasp: a box, a cylinder, a sphere, a mesh, or a drill with a trigger."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from rtee.drivers.mujoco.contacts import make_object
from rtee.errors import ConfigError
from rtee.sample import FloatArray

OBJECT = "object"
"""Name of the object's body, joint and (first) geom."""

TRIGGER = "object/trigger"
"""Name of the body and joint of a trigger."""

TRIGGER_TRAVEL = 0.010
"""How far a drill's trigger can be pressed [m]."""

_FORMS = (
    "box:WxDxH, cylinder:RADIUSxHEIGHT, sphere:RADIUS (in metres), drill, or the path of a mesh"
)
_NUMBERS = {"box": 3, "cylinder": 2, "sphere": 1}
_LARGEST = 2.0  # of an object's lengths [m]: larger numbers are millimetres by mistake
_MESHES = (".stl", ".obj")
_HANDLE = (0.044, 0.048, 0.130)
"""Width, depth and length of a drill's handle [m]; its back and its front are round."""

_MOTOR = (0.050, 0.140, 0.050)
"""Width, length and height of the housing above the handle, flush with its back [m]."""

_PLATE = (0.022, 0.008, 0.034)
"""Width, thickness and height of the trigger [m]."""

_AROUND = 24
"""Corners of a round side in the points of a drill."""

_SPRING = 350.0
"""Stiffness of the trigger's spring [N/m]."""

_PRELOAD = 0.008
"""How far the trigger's spring is pressed when nothing presses the trigger [m]."""


@dataclass(frozen=True, slots=True)
class ObjectShape:
    """The shape of an object.

    Attributes:
        kind: ``box``, ``cylinder``, ``sphere``, ``drill`` or ``mesh``.
        size: Edge lengths, radius and height, or radius [m]; empty for a drill and a mesh.
        path: The mesh file.
        scale: Factor of all lengths of a drill or a mesh.
    """

    kind: str
    size: tuple[float, ...] = ()
    path: Path | None = None
    scale: float = 1.0

    def scaled(self, factor: float) -> ObjectShape:
        """Return the same shape with all lengths times a factor."""
        if self.size:
            return replace(self, size=tuple(factor * value for value in self.size))
        return replace(self, scale=factor * self.scale)

    @property
    def name(self) -> str:
        """How it is written on the command line, such as ``sphere:0.03``."""
        if self.path is not None:
            return str(self.path)
        if not self.size:
            return self.kind
        return f"{self.kind}:{'x'.join(f'{value:g}' for value in self.size)}"

    def lowest(self, pose: FloatArray) -> float:
        """Return the height of its lowest point [m] at a pose ``(4, 4)`` in the world.

        The origin of a mesh is taken for its lowest point.
        """
        down = pose[:3, :3].T @ np.array([0.0, 0.0, -1.0])
        match self.kind:
            case "box":
                reach = float(np.abs(down) @ np.array(self.size)) / 2.0
            case "cylinder":
                radius, height = self.size
                reach = radius * math.hypot(down[0], down[1]) + 0.5 * height * abs(down[2])
            case "sphere":
                reach = self.size[0]
            case "drill":
                reach = 0.5 * _HANDLE[2] * self.scale
            case _:
                reach = 0.0
        return float(pose[2, 3]) - reach


def parse_object(text: str) -> ObjectShape:
    """Read an object as it is written on the command line.

    Raises:
        ConfigError: if it is none of the forms there are.
    """
    kind, _, numbers = text.partition(":")
    if text == "drill":
        return ObjectShape("drill")
    if kind in _NUMBERS and numbers:
        try:
            size = tuple(float(part) for part in numbers.split("x"))
        except ValueError:
            size = ()
        if len(size) != _NUMBERS[kind] or not all(
            math.isfinite(value) and 0.0 < value <= _LARGEST for value in size
        ):
            raise ConfigError(f"'{text}' is not an object; write {_FORMS}, each number up to 2")
        return ObjectShape(kind, size)
    path = Path(text)
    if path.suffix.lower() not in _MESHES:
        raise ConfigError(f"'{text}' is not an object; write {_FORMS} (.stl, .obj)")
    if not path.is_file():
        raise ConfigError("no such mesh", path=path)
    return ObjectShape("mesh", path=path)


def drill_parts(scale: float = 1.0) -> tuple[FloatArray, ...]:
    """Return points ``(k, 3)`` [m] whose hulls are a drill's handle, motor and trigger.

    The handle's middle is the origin; the trigger is not pressed.
    """
    radius, flat = 0.5 * _HANDLE[0], 0.5 * (_HANDLE[1] - _HANDLE[0])
    turn = np.arange(_AROUND) * (2.0 * np.pi / _AROUND)
    ring = radius * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    ends = np.array([[0.0, y, 0.5 * z * _HANDLE[2]] for y in (-flat, flat) for z in (-1, 1)])
    front = 0.5 * _HANDLE[1] + TRIGGER_TRAVEL + 0.5 * _PLATE[1]
    # The same gaps as in `_add_drill`, which makes the simulated shapes.
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    motor = [0.0, 0.5 * (_MOTOR[1] - _HANDLE[1]), 0.5 * (_HANDLE[2] + _MOTOR[2])]
    trigger = [0.0, front, 0.5 * _HANDLE[2] - 0.5 * _PLATE[2] - 0.002]
    return (
        scale * (ends[:, None] + ring).reshape(-1, 3),
        scale * (corners * _MOTOR + motor),
        scale * (corners * _PLATE + trigger),
    )


def add_object(
    spec: mujoco.MjSpec,
    shape: ObjectShape,
    *,
    mass: float,
    pose: FloatArray,
) -> mujoco.MjsBody:
    """Add a free object to a model; the friction of a pair is that of what touches the object.

    Args:
        spec: The model.
        shape: What it looks like.
        mass: Its mass [kg].
        pose: Where it is ``(4, 4)``, in the world's frame.

    Returns:
        Its body.
    """
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(pose[:3, :3]).ravel())
    body = spec.worldbody.add_body(name=OBJECT, pos=pose[:3, 3], quat=quat)
    body.add_freejoint(name=OBJECT)
    body.gravcomp = 1.0  # MuJoCo can change this while it runs only if it is not 0 at first
    if shape.kind == "drill":
        _add_drill(body, mass, shape.scale)
        return body
    geom = _geom(body, OBJECT, mass)
    match shape.kind:
        case "box":
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
            geom.size = [0.5 * value for value in shape.size]
        case "cylinder":
            geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
            geom.size = [shape.size[0], 0.5 * shape.size[1], 0.0]
        case "sphere":
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
            geom.size = [shape.size[0], 0.0, 0.0]
        case _:
            mesh = spec.add_mesh(name=OBJECT, file=str(shape.path))
            mesh.scale = [shape.scale] * 3
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            geom.type = mujoco.mjtGeom.mjGEOM_MESH
            geom.meshname = OBJECT
    return body


def _geom(body: mujoco.MjsBody, name: str, mass: float) -> mujoco.MjsGeom:
    geom = body.add_geom(name=name, mass=mass, rgba=[0.74, 0.60, 0.44, 1.0])
    make_object(geom)
    return geom


def _add_drill(body: mujoco.MjsBody, mass: float, scale: float) -> None:
    """Add a pistol-like body: a handle along z, a motor above it, a sprung trigger before it.

    The trigger slides along y towards the handle, against a preloaded spring; its joint counts from
    0, not pressed, to `TRIGGER_TRAVEL`.
    """
    grip, top, button = (
        tuple(scale * value for value in part) for part in (_HANDLE, _MOTOR, _PLATE)
    )
    radius = 0.5 * grip[0]
    flat = 0.5 * grip[1] - radius
    # The shares of the mass add up to 1 and put the centre near the top of the handle, below the
    # motor.
    core = _geom(body, OBJECT, 0.2 * mass)
    core.type = mujoco.mjtGeom.mjGEOM_BOX
    core.size = [radius, flat, 0.5 * grip[2]]
    for name, side in (("back", -1.0), ("front", 1.0)):
        edge = _geom(body, f"{OBJECT}/{name}", 0.15 * mass)
        edge.type = mujoco.mjtGeom.mjGEOM_CYLINDER
        edge.size = [radius, 0.5 * grip[2], 0.0]
        edge.pos = [0.0, side * flat, 0.0]
    motor = _geom(body, f"{OBJECT}/motor", 0.45 * mass)
    motor.type = mujoco.mjtGeom.mjGEOM_BOX
    motor.size = [0.5 * value for value in top]
    motor.pos = [0.0, 0.5 * (top[1] - grip[1]), 0.5 * (grip[2] + top[2])]
    front = 0.5 * grip[1] + TRIGGER_TRAVEL + 0.5 * button[1]
    trigger = body.add_body(name=TRIGGER, pos=[0.0, front, 0.5 * grip[2] - 0.5 * button[2] - 0.002])
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
    plate.size = [0.5 * value for value in button]
    plate.rgba = [0.75, 0.15, 0.12, 1.0]
