"""Make a MuJoCo model from a hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from rtee.drivers.mujoco.contacts import (
    configure,
    hand_friction,
    make_hard,
    make_pair_hard,
    time_step,
)
from rtee.drivers.mujoco.couplings import add_couplings, add_locks, motor_joint, on_spring, reach
from rtee.drivers.mujoco.options import DENSITY, JOINT_DAMPING, PASSIVE_STIFFNESS, SimOptions
from rtee.drivers.mujoco.pairs import LINK, leave_pairs_out, pair_friction, rest_position
from rtee.drivers.mujoco.servos import Servo, add_motor, servo_of
from rtee.drivers.mujoco.solids import half_extents, set_solid, turn_of
from rtee.errors import ConfigError, ModelError
from rtee.hand.frames import quaternion
from rtee.hand.inertia import PRISMATIC
from rtee.hand.model import Hand, JointRole
from rtee.hand.urdf import UrdfGeometry, UrdfJoint, UrdfLink
from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, JointKind

CARRIER = "carrier"
"""The body that carries the hand."""

_TINY_MASS = 1e-3
"""Mass of a link that has neither mass nor shape, but moves [kg]."""

_TINY_INERTIA = 1e-6
"""Moments of inertia of such a link [kg·m²]."""

_LEAST_INERTIA = 1e-9
"""Least moment of inertia taken from a URDF [kg·m²]; smaller ones have been rounded to 0."""

_POINT = 1e-4
"""Moments of inertia of a link without shape, per mass [m²]: a ball with a radius of 16 mm."""

_TRIANGLE = 1e-3
"""Relative tolerance of the rule that a body's largest moment of inertia is at most the sum of the
others: the numbers in URDFs are rounded."""

_SAG = 0.02
"""How far the weight of its links may pull a passive joint against its spring [rad | m]: little
enough that the hand keeps its shape at rest."""

_PASSIVE_DAMPING = 0.5
"""Damping ratio of a passive joint with its spring: it overshoots by a sixth and comes to rest."""

Triangles = Callable[[str], tuple[FloatArray, "np.ndarray[tuple[int, int], np.dtype[np.int64]]"]]
"""A function that returns the vertices and faces of a link's collision meshes in its frame."""


@dataclass(frozen=True, slots=True)
class Built:
    """A MuJoCo model under construction, and the assumptions about the hand.

    Attributes:
        spec: The model; objects may still be added before it is compiled.
        servos: The motors, by actuator.
        notes: Assumed values, one sentence each.
        following: How joints follow their actuators where that is not a gear, one sentence each.
    """

    spec: mujoco.MjSpec
    servos: Mapping[str, Servo]
    notes: tuple[str, ...]
    following: tuple[str, ...]


def _check(hand: Hand) -> None:
    for actuator in hand.actuators:
        if actuator.kind is JointKind.CONTINUOUS:
            continue
        if not (math.isfinite(actuator.lower) and math.isfinite(actuator.upper)):
            raise ModelError(
                f"actuator '{actuator.name}' has no limits, so it cannot be simulated; give it a "
                "<limit> in the URDF",
                path=hand.urdf.path,
            )
    for joint in hand.joints:
        if joint.role is JointRole.PASSIVE and not _has_substance(hand, joint.child):
            links = ", ".join(f"'{link}'" for link in hand.urdf.links_below(joint.child))
            raise ModelError(
                f"passive joint '{joint.name}' carries neither mass nor collision geometry (links "
                f"{links}), so its motion is undetermined; give a link mass, or fix the joint",
                path=hand.urdf.path,
                line=joint.line or None,
            )


def _has_substance(hand: Hand, link: str) -> bool:
    links = [hand.urdf.links[name] for name in hand.urdf.links_below(link)]
    return any(body.collisions or body.mass > 0.0 for body in links)


def add_shape(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    shape: UrdfGeometry,
    name: str,
    triangles: Callable[[], tuple[FloatArray, np.ndarray[tuple[int, int], np.dtype[np.int64]]]],
) -> mujoco.MjsGeom:
    """Add a shape of a link to its body, under a name.

    ``triangles`` returns the vertices and faces of a mesh in the link's frame.
    """
    geom = body.add_geom(name=name, pos=shape.xyz, quat=quaternion(shape.rpy))
    if shape.kind != "mesh":
        set_solid(geom, shape.kind, half_extents(shape.kind, shape.dimensions))
        return geom
    vertices, _ = triangles()
    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.ascontiguousarray(vertices, dtype=np.float64).ravel()
    geom.type = mujoco.mjtGeom.mjGEOM_MESH
    geom.meshname = name
    geom.pos = [0.0, 0.0, 0.0]  # the triangles are already in the link's frame
    geom.quat = [1.0, 0.0, 0.0, 0.0]
    return geom


def _add_joint(
    body: mujoco.MjsBody,
    joint: UrdfJoint,
    hand: Hand,
    servos: Mapping[str, Servo],
    options: SimOptions,
) -> None:
    slide = joint.kind == "prismatic"
    unit = PRISMATIC if slide else 1.0
    added = body.add_joint(
        name=joint.name,
        type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
        axis=joint.axis,
        armature=options.armature * unit,
        damping=JOINT_DAMPING * unit,
    )
    role = hand.joints[hand.joint_index(joint.name)].role
    if role is JointRole.ACTUATOR:
        _limit(added, hand.actuator(joint.name))
        if motor_joint(hand, joint.name) == joint.name:
            _drive(added, servos[joint.name])
        return
    if role is JointRole.PASSIVE:
        resting = float(hand.transmission.joints(hand.rest)[hand.joint_index(joint.name)])
        added.stiffness = [PASSIVE_STIFFNESS * unit, 0.0, 0.0]
        added.springref = resting
    elif not on_spring(hand, joint.name):
        return
    lower, upper = reach(hand, joint)
    if math.isfinite(lower) and upper > lower:
        added.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        added.range = [lower, upper]


def _limit(joint: mujoco.MjsJoint, actuator: ActuatorSpec) -> None:
    if actuator.kind is not JointKind.CONTINUOUS:
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.range = [actuator.lower, actuator.upper]


def _drive(joint: mujoco.MjsJoint, servo: Servo) -> None:
    joint.armature = servo.armature
    joint.damping = [servo.damping, 0.0, 0.0]
    joint.frictionloss = servo.friction


def _add_motor_bodies(mount: mujoco.MjsBody, hand: Hand, servos: Mapping[str, Servo]) -> None:
    """Add the motors that are apart from their actuators' joints, which follow them by springs."""
    for actuator in hand.actuators:
        name = motor_joint(hand, actuator.name)
        if name == actuator.name:
            continue
        slide = actuator.kind is JointKind.PRISMATIC
        body = mount.add_body(name=name, gravcomp=1.0)  # gravity does not turn a rotor
        set_tiny(body)
        kind = mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE
        joint = body.add_joint(name=name, type=kind, axis=[0.0, 0.0, 1.0])
        _limit(joint, actuator)
        _drive(joint, servos[actuator.name])


def _set_inertia(body: mujoco.MjsBody, link: UrdfLink, geoms: list[mujoco.MjsGeom]) -> bool:
    """Give a body its link's mass, distributed as in the URDF; return whether that is possible.

    If the URDF has no inertia, or one that no rigid body can have, it follows from the shapes.
    """
    given = link.inertia
    if given is not None:
        # MuJoCo refuses moments that are too small, or that break the rule of `_TRIANGLE`.
        xx, xy, xz, yy, yz, zz = given.moments
        least, middle, most = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if least >= _LEAST_INERTIA and most <= (least + middle) * (1.0 + _TRIANGLE):
            turn = turn_of(quaternion(given.rpy))
            tensor = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
            body.mass, body.ipos = link.mass, given.xyz
            body.fullinertia = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            body.explicitinertial = True
            return True
    for geom in geoms:
        geom.mass = link.mass / len(geoms)
    if not geoms:
        body.mass, body.ipos = link.mass, [0.0, 0.0, 0.0]
        body.inertia = [max(_TINY_INERTIA, _POINT * link.mass)] * 3
        body.explicitinertial = True
    return False


def set_tiny(body: mujoco.MjsBody) -> None:
    """Give a massless body a mass and an inertia that are too small to have an effect."""
    # The centre of mass, too: without it, MuJoCo does not write the inertia of a body.
    body.mass, body.ipos, body.inertia = _TINY_MASS, [0.0, 0.0, 0.0], [_TINY_INERTIA] * 3
    body.explicitinertial = True


def _add_links(
    spec: mujoco.MjSpec,
    mount: mujoco.MjsBody,
    hand: Hand,
    triangles: Triangles,
    servos: Mapping[str, Servo],
    options: SimOptions,
) -> list[str]:
    """Add every link below ``mount``; returns the assumptions made."""
    urdf = hand.urdf
    bodies: dict[str, mujoco.MjsBody] = {}
    without_mass: list[str] = []
    without_inertia: list[str] = []
    # Breadth first: a body is added to its parent, which must exist already.
    pending = [urdf.root]
    while pending:
        name = pending.pop(0)
        link, joint = urdf.links[name], urdf.joint_to.get(name)
        if joint is None:
            body = mount.add_body(name=LINK + name)
        else:
            body = bodies[joint.parent].add_body(
                name=LINK + name, pos=joint.xyz, quat=quaternion(joint.rpy)
            )
            if joint.moving:
                _add_joint(body, joint, hand, servos, options)
        bodies[name] = body
        geoms: list[mujoco.MjsGeom] = []
        meshes_done = False
        for index, shape in enumerate(link.collisions):
            if shape.kind == "mesh":
                # `triangles` returns all meshes of the link as one.
                if meshes_done:
                    continue
                meshes_done = True
            geom = add_shape(spec, body, shape, f"{name}/{index}", lambda n=name: triangles(n))  # type: ignore[misc]
            geom.density = DENSITY
            make_hard(geom, hand_friction(options.friction, tip=name in hand.tip_links))
            # The group that MuJoCo's viewers hide by default: collision shapes.
            geom.group = 3
            geoms.append(geom)
        if link.has_inertial and link.mass > 0.0:
            if not _set_inertia(body, link, geoms):
                without_inertia.append(name)
        elif not link.collisions and joint is not None and joint.moving:
            set_tiny(body)
            without_mass.append(name)
        elif link.collisions:
            without_mass.append(name)
        pending += [j.child for j in urdf.joints_below.get(name, ())]
    notes = []
    if without_mass:
        notes.append(f"mass assumed for {len(without_mass)} link(s): {', '.join(without_mass)}")
    if without_inertia:
        links = ", ".join(without_inertia)
        notes.append(f"inertia assumed for {len(without_inertia)} link(s): {links}")
    return notes


def _hold_passive_joints_up(spec: mujoco.MjSpec, hand: Hand, data: mujoco.MjData) -> None:
    """Make the springs of passive joints strong enough for the weight of their links at rest."""
    model = data.model
    gravity = float(np.linalg.norm(model.opt.gravity))
    for joint in hand.joints:
        if joint.role is not JointRole.PASSIVE:
            continue
        found = model.joint(joint.name)
        body = int(found.bodyid[0])
        lever = float(np.linalg.norm(data.subtree_com[body] - data.xanchor[found.id]))
        weight = float(model.body_subtreemass[body]) * gravity
        load = weight if joint.kind is JointKind.PRISMATIC else weight * lever
        added = spec.joint(joint.name)
        stiffness = max(float(model.jnt_stiffness[found.id]), load / _SAG)
        inertia = float(model.dof_M0[found.dofadr[0]])
        damping = max(
            float(model.dof_damping[found.dofadr[0]]),
            2.0 * _PASSIVE_DAMPING * math.sqrt(stiffness * inertia),
        )
        added.stiffness, added.damping = [stiffness, 0.0, 0.0], [damping, 0.0, 0.0]


def compiled(
    spec: mujoco.MjSpec, hand: Hand, object_file: tuple[str, Path] | None = None
) -> mujoco.MjModel:
    """Compile a hand's model; ``object_file`` is the name and the file of the object's mesh.

    Raises:
        ModelError: if MuJoCo refuses it, with MuJoCo's reason, such as a mesh without volume.
        ConfigError: if the reason is the object's mesh.
    """
    try:
        return spec.compile()
    except ValueError as error:
        # MuJoCo names the element on a second line.
        said, _, element = str(error).removeprefix("Error: ").partition("\nElement name ")
        name = element.partition(",")[0].strip("'")
        if object_file is not None and name == object_file[0]:
            raise ConfigError(f"cannot be simulated: {said}", path=object_file[1]) from error
        of = f" of '{name}'" if name and f"'{name}'" not in said else ""
        raise ModelError(f"cannot be simulated: {said}{of}", path=hand.urdf.path) from error


def copied(built: Built, hand: Hand, friction: float | None) -> Built:
    """Return a copy of a hand's model with a friction from the options."""
    spec = built.spec.copy()
    for link in hand.urdf.links:
        for geom in spec.body(LINK + link).geoms:
            make_hard(geom, hand_friction(friction, tip=link in hand.tip_links))
    for pair in spec.pairs:
        make_pair_hard(pair, pair_friction(spec, pair.geomname1, pair.geomname2))
    return replace(built, spec=spec)


def build(
    hand: Hand,
    options: SimOptions,
    triangles: Triangles,
    touch: Callable[[str, str], bool] = lambda first, second: True,
) -> Built:
    """Make a MuJoCo model from a hand.

    Args:
        hand: The hand.
        options: How to simulate it.
        triangles: Returns the collision meshes of a link; called only for links that have meshes.
        touch: Returns whether the exact geometries of two links touch at rest.

    Raises:
        ModelError: if the hand cannot be simulated, with the links or joints that are the reason.
    """
    _check(hand)
    spec = mujoco.MjSpec()
    spec.modelname = hand.name
    spec.compiler.degree = False
    # Limits are set explicitly for every joint; a range of zeros must not become a limit.
    spec.compiler.autolimits = False
    spec.option.timestep = options.timestep or time_step(hand)
    spec.option.gravity = [0.0, 0.0, options.gravity]
    # Implicit in the damping: stiff servos on light fingers are unstable with Euler's method.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    configure(spec.option)
    # The pairs left out are named below; MuJoCo's own rule depends on whether the base can move.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    mount = spec.worldbody.add_body(name=CARRIER)
    servos = {a.name: servo_of(hand, a, options) for a in hand.actuators}
    notes = [*hand.notes, *_add_links(spec, mount, hand, triangles, servos, options)]
    _add_motor_bodies(mount, hand, servos)
    for servo in servos.values():
        add_motor(spec, servo, motor_joint(hand, servo.actuator))
        notes += [servo.note] if servo.note else []
    add_locks(spec, hand)
    following = add_couplings(spec, hand, servos, options)
    # A first compilation gives the masses, and the contacts at rest, that the next steps need.
    resting = mujoco.MjData(compiled(spec, hand))
    resting.qpos[:] = rest_position(resting.model, hand)
    mujoco.mj_forward(resting.model, resting)
    _hold_passive_joints_up(spec, hand, resting)
    notes += leave_pairs_out(spec, hand, resting, touch)
    return Built(spec, servos, tuple(notes), tuple(following))
