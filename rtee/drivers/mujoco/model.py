"""Make a MuJoCo model from a hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from rtee.drivers.mujoco.couplings import Polynomial, couplings
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK, leave_pairs_out
from rtee.errors import ModelError
from rtee.hand.model import Hand, JointRole
from rtee.hand.urdf import UrdfGeometry, UrdfJoint
from rtee.types import ActuatorSpec, FloatArray, JointKind

CARRIER = "carrier"
"""The body that carries the hand."""

_TINY_MASS = 1e-3
_TINY_INERTIA = 1e-7
_PRISMATIC = 1000.0

Triangles = Callable[[str], tuple[FloatArray, "np.ndarray[tuple[int, int], np.dtype[np.int64]]"]]
"""Vertices and faces of a link's collision meshes, in the link's frame."""


@dataclass(frozen=True, slots=True)
class Built:
    """A MuJoCo model under construction, and what was assumed about the hand.

    Attributes:
        spec: The model; objects may still be added before it is compiled.
        polynomials: How coupled joints follow their actuators.
        notes: What was made up, one sentence each.
    """

    spec: mujoco.MjSpec
    polynomials: tuple[Polynomial, ...]
    notes: tuple[str, ...]


def quaternion(rpy: tuple[float, float, float]) -> FloatArray:
    """Return the unit quaternion (w, x, y, z) of roll, pitch, yaw about fixed axes [rad]."""
    result = np.zeros(4)
    mujoco.mju_euler2Quat(result, np.array(rpy, dtype=np.float64), "XYZ")
    return result


def effort_limit(actuator: ActuatorSpec, options: SimOptions) -> float:
    """Return the effort limit to simulate [N·m | N]; the model's, or a made-up one."""
    most = options.max_effort * (100.0 if actuator.kind is JointKind.PRISMATIC else 1.0)
    return actuator.effort if 0.0 < actuator.effort <= most else most


def coupling_name(joint: str) -> str:
    """Return the name of the equality that couples a joint to its actuator."""
    return f"coupling/{joint}"


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
            links = ", ".join(f"'{link}'" for link in _below(hand, joint.child))
            raise ModelError(
                f"passive joint '{joint.name}' carries no mass and no collision geometry (links "
                f"{links}), so its motion is undetermined; give a link mass, or fix the joint",
                path=hand.urdf.path,
                line=joint.line or None,
            )


def _below(hand: Hand, link: str) -> list[str]:
    """Return a link and all links below it."""
    found = [link]
    for name in found:
        found += [j.child for j in hand.urdf.joints.values() if j.parent == name]
    return found


def _has_substance(hand: Hand, link: str) -> bool:
    links = [hand.urdf.links[name] for name in _below(hand, link)]
    return any(found.collisions or found.mass > 0.0 for found in links)


def _add_shape(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    shape: UrdfGeometry,
    name: str,
    triangles: Callable[[], tuple[FloatArray, np.ndarray[tuple[int, int], np.dtype[np.int64]]]],
) -> mujoco.MjsGeom:
    geom = body.add_geom(name=name, pos=shape.xyz, quat=quaternion(shape.rpy))
    match shape.kind:
        case "box":
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
            geom.size = [0.5 * s for s in shape.size]
        case "sphere":
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
            geom.size = [shape.radius, 0.0, 0.0]
        case "cylinder":
            geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
            geom.size = [shape.radius, 0.5 * shape.length, 0.0]
        case "mesh":
            vertices, _ = triangles()
            mesh = spec.add_mesh(name=name)
            mesh.uservert = np.ascontiguousarray(vertices, dtype=np.float64).ravel()
            geom.type = mujoco.mjtGeom.mjGEOM_MESH
            geom.meshname = name
            geom.pos = [0.0, 0.0, 0.0]  # the triangles are already in the link's frame
            geom.quat = [1.0, 0.0, 0.0, 0.0]
    return geom


def _add_joint(
    body: mujoco.MjsBody, joint: UrdfJoint, role: JointRole, hand: Hand, options: SimOptions
) -> None:
    slide = joint.kind == "prismatic"
    unit = _PRISMATIC if slide else 1.0
    added = body.add_joint(
        name=joint.name,
        type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
        axis=joint.axis,
        armature=options.armature * unit,
        damping=options.joint_damping * unit,
    )
    if role is JointRole.ACTUATOR:
        actuator = hand.actuator(joint.name)
        added.frictionloss = options.joint_friction * effort_limit(actuator, options)
        if actuator.kind is not JointKind.CONTINUOUS:
            added.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            added.range = [actuator.lower, actuator.upper]
    elif role is JointRole.PASSIVE:
        resting = float(hand.transmission.joints(hand.rest)[hand.joint_index(joint.name)])
        added.stiffness = [options.passive_stiffness * unit, 0.0, 0.0]
        added.springref = resting
        if math.isfinite(joint.lower) and joint.upper > joint.lower:
            added.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            added.range = [joint.lower, joint.upper]


def _add_links(
    spec: mujoco.MjSpec,
    mount: mujoco.MjsBody,
    hand: Hand,
    triangles: Triangles,
    options: SimOptions,
) -> list[str]:
    """Add every link below ``mount``; returns the links whose mass was made up."""
    urdf = hand.urdf
    roles = {joint.name: joint.role for joint in hand.joints}
    tips = {finger.tip for finger in hand.fingers}
    arriving = {joint.child: joint for joint in urdf.joints.values()}
    bodies: dict[str, mujoco.MjsBody] = {}
    made_up: list[str] = []
    pending = [urdf.root]
    while pending:
        name = pending.pop(0)
        link, joint = urdf.links[name], arriving.get(name)
        if joint is None:
            body = mount.add_body(name=LINK + name)
        else:
            body = bodies[joint.parent].add_body(
                name=LINK + name, pos=joint.xyz, quat=quaternion(joint.rpy)
            )
            if joint.moving:
                _add_joint(body, joint, roles[joint.name], hand, options)
        body.gravcomp = 1.0  # the arm carries the hand; its own weight is not under test
        bodies[name] = body
        meshes_done = False
        for index, shape in enumerate(link.collisions):
            if shape.kind == "mesh":
                if meshes_done:
                    continue
                meshes_done = True
            geom = _add_shape(spec, body, shape, f"{name}/{index}", lambda n=name: triangles(n))  # type: ignore[misc]
            geom.density = options.density
            geom.friction = [options.friction if name in tips else 0.6, 0.01, 1e-3]
            geom.condim = 4
            geom.group = 3
        if link.has_inertial and link.mass > 0.0 and not link.collisions:
            body.mass = link.mass
            body.inertia = [max(_TINY_INERTIA, 1e-4 * link.mass)] * 3
            body.explicitinertial = True
        elif link.has_inertial and link.mass > 0.0:
            share = link.mass / len(body.geoms)
            for geom in body.geoms:
                geom.mass = share
        elif not link.collisions and joint is not None and joint.moving:
            body.mass = _TINY_MASS
            body.inertia = [_TINY_INERTIA * 10] * 3
            body.ipos = [0.0, 0.0, 0.0]
            body.explicitinertial = True
            made_up.append(name)
        elif link.collisions:
            made_up.append(name)
        pending += [j.child for j in urdf.joints.values() if j.parent == name]
    return made_up


def _add_actuators(spec: mujoco.MjSpec, hand: Hand, options: SimOptions) -> list[str]:
    notes: list[str] = []
    for actuator in hand.actuators:
        limit = effort_limit(actuator, options)
        if limit != actuator.effort:
            notes.append(f"actuator '{actuator.name}': effort limit taken as {limit:g}")
        span = options.stiffness * (0.01 if actuator.kind is JointKind.PRISMATIC else 1.0)
        motor = spec.add_actuator(
            name=actuator.name, target=actuator.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        motor.set_to_position(kp=limit / span, dampratio=1.0)
        motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.forcerange = [-limit, limit]
    return notes


def _add_locks(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Hold the ignored joints where they stand."""
    for joint, coupling in zip(hand.joints, hand.transmission.couplings, strict=True):
        if joint.role is JointRole.IGNORED:
            equality = spec.add_equality(
                name=coupling_name(joint.name),
                name1=joint.name,
                type=mujoco.mjtEq.mjEQ_JOINT,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
            )
            equality.data[:5] = (coupling.value(0.0), 0.0, 0.0, 0.0, 0.0)
            equality.solref = [0.005, 1.0]
            equality.solimp = [0.95, 0.99, 0.001, 0.5, 2.0]


def _add_couplings(spec: mujoco.MjSpec, hand: Hand) -> tuple[tuple[Polynomial, ...], list[str]]:
    polynomials = couplings(hand)
    notes = []
    for polynomial in polynomials:
        equality = spec.add_equality(
            name=coupling_name(polynomial.joint),
            name1=polynomial.joint,
            name2=polynomial.actuator,
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
        )
        equality.data[:5] = polynomial.coefficients
        equality.solref = [0.005, 1.0]
        equality.solimp = [0.95, 0.99, 0.001, 0.5, 2.0]
        if polynomial.error > 1e-6:
            notes.append(
                f"joint '{polynomial.joint}' follows '{polynomial.actuator}' by a curve; its "
                f"tangent is renewed at every exchange (a single polynomial would be up to "
                f"{polynomial.error:.2g} off)"
            )
    return polynomials, notes


def build(
    hand: Hand,
    options: SimOptions,
    triangles: Triangles,
    touch: Callable[[str, str], bool] = lambda first, second: True,
) -> Built:
    """Make a MuJoCo model from a hand.

    The transmission becomes joint equalities (polynomials of degree 4 at most), actuators get
    position gains and effort limits, passive joints a spring and a damper, ignored ones a lock,
    fingertips pads with friction. What the URDF lacks is made up and noted.

    Args:
        hand: The hand.
        options: How to simulate it.
        triangles: Gives the collision meshes of a link; asked only for links that have meshes.
        touch: Says whether two links touch at rest on their exact geometry.

    Raises:
        ModelError: if the hand cannot be simulated, with the links or joints that are the reason.
    """
    _check(hand)
    spec = mujoco.MjSpec()
    spec.modelname = hand.name
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    spec.option.timestep = options.timestep
    spec.option.gravity = [0.0, 0.0, options.gravity]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    # The pairs left out are named below; MuJoCo's own rule depends on whether the base can move.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    mount = spec.worldbody.add_body(name=CARRIER)
    notes = list(hand.notes)
    made_up = _add_links(spec, mount, hand, triangles, options)
    if made_up:
        notes.append(f"mass made up for {len(made_up)} links: {', '.join(made_up)}")
    notes += _add_actuators(spec, hand, options)
    _add_locks(spec, hand)
    polynomials, coupling_notes = _add_couplings(spec, hand)
    notes += coupling_notes
    notes += leave_pairs_out(spec, hand, touch)
    return Built(spec, polynomials, tuple(notes))
