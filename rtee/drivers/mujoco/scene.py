"""The hand and its surroundings: a carrier, a table, an object."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from rtee.actions.types import Action, Primitive
from rtee.drivers.mujoco.contacts import TABLE_FRICTION, make_hard
from rtee.drivers.mujoco.model import CARRIER, Built, build, compiled, copied, set_tiny
from rtee.drivers.mujoco.objects import MESHES, OBJECT, add_object, solid_parts
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK, rest_position
from rtee.drivers.mujoco.simulation import Simulation
from rtee.drivers.mujoco.surroundings import AXES, TABLE
from rtee.hand.geometry import HandGeometry, touch_at_rest
from rtee.hand.kinematics import Kinematics
from rtee.hand.model import Hand
from rtee.objects.shape import ObjectShape, hollow_mesh, open_mesh, parse_object
from rtee.sample import FloatArray
from rtee.types import from_rest

_INERTIA = (20.0, 20.0, 20.0, 1.0, 1.0, 1.0)  # carrier's axes [kg, kg·m²]: a small arm's
_STIFFNESS = (2e5, 2e5, 2e5, 1e4, 1e4, 1e4)  # carrier's servos [N/m, N·m/rad]: 0.5 mm at 100 N
_TABLE = (0.6, 0.6, 0.02)  # half sizes of the table's top [m]

_FARTHEST_OUT = 0.08
"""Farthest that an object is moved out of the hand [m]: fingertips reach no farther over it."""

_OUT_STEP = 0.002
"""Step of that search [m]."""

_CLOSURES = 26
"""Number of postures of a closing gripper in the search: its tips move about 2 mm between two."""


@dataclass(frozen=True, slots=True)
class TipsClosing:
    """Closing motion of a gripper on an object between its two tips.

    Attributes:
        end: Actuator positions with the tips on each other ``(n,)`` [rad | m].
        point: Point where the tips then meet ``(3,)`` [m], in the base frame; ``None``: not known.
    """

    end: FloatArray
    point: FloatArray | None = None

    @classmethod
    def of(cls, hand: Hand, actions: Iterable[Action]) -> TipsClosing | None:
        """Return the closing motion of a two-fingered hand's first pinch; ``None`` without one."""
        if len(hand.fingers) != 2:
            return None
        for action in actions:
            if isinstance(action, Primitive) and action.kind.pinch:
                end = np.array([action.postures[0].position[n] for n in hand.actuator_names])
                point = action.evidence[0].point if action.evidence else None
                return cls(end, None if point is None else np.array(point))
        return None


def build_hand(hand: Hand, options: SimOptions) -> Built:
    """Make the model of a hand; meshes are read only if it has any."""
    meshes = any(s.kind == "mesh" for link in hand.urdf.links.values() for s in link.collisions)
    geometry = HandGeometry(hand) if meshes else None

    def triangles(link: str) -> tuple[FloatArray, np.ndarray[tuple[int, int], np.dtype[np.int64]]]:
        if geometry is None:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
        return geometry.triangles(link)

    if not meshes:  # MuJoCo's contact of boxes, cylinders and spheres is exact already
        return build(hand, options, triangles)
    return build(hand, options, triangles, touch_at_rest(hand))


def closed(hand: Hand) -> FloatArray:
    """Return the actuator positions ``(n,)`` farthest from rest."""
    far = np.where(
        np.abs(hand.upper - hand.rest) >= np.abs(hand.lower - hand.rest), hand.upper, hand.lower
    )
    return np.where(np.isfinite(far), far, hand.rest)


def tips(hand: Hand, u: FloatArray) -> FloatArray:
    """Return the fingertips' origins ``(k, 3)`` [m] in the base frame."""
    kinematics = Kinematics(hand)
    origins = [kinematics.link_pose(f.tip, u)[:3, 3] for f in hand.fingers if f.tip is not None]
    return np.array(origins).reshape(-1, 3)


def grasp_centre(hand: Hand) -> FloatArray:
    """Return the middle of the half-closed hand's fingertips ``(3,)`` [m] in its base frame."""
    half = 0.5  # halfway from rest to the far limits, about where fingers meet an object
    origins = tips(hand, from_rest(hand.rest, closed(hand), half))
    return np.asarray(origins.mean(axis=0)) if len(origins) else np.zeros(3)


def approach(hand: Hand) -> FloatArray:
    """Return the axis ``(3,)`` of the base frame along which the hand reaches out."""
    centre = tips(hand, hand.rest).mean(axis=0) if hand.fingers else np.array([0.0, 0.0, 1.0])
    axis = np.zeros(3)
    widest = int(np.argmax(np.abs(centre)))
    axis[widest] = np.sign(centre[widest]) or 1.0
    return axis


def downward(hand: Hand) -> FloatArray:
    """Return the rotation ``(3, 3)`` that makes the hand reach down."""
    axis, down = approach(hand), np.array([0.0, 0.0, -1.0])
    if np.allclose(axis, down):
        return np.eye(3)
    if np.allclose(axis, -down):
        return np.diag([1.0, -1.0, -1.0])
    side = np.cross(axis, down)
    after = np.stack([down, np.cross(side, down), side], axis=1)
    before = np.stack([axis, np.cross(side, axis), side], axis=1)
    turn: FloatArray = after @ before.T
    return turn


def add_carrier(spec: mujoco.MjSpec, turn: FloatArray, options: SimOptions) -> None:
    """Turn the carrier and give it the motions of the options; leave a fixed one unchanged."""
    if options.carrier == "fixed":
        return
    mount = spec.body(CARRIER)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, turn.ravel())
    mount.quat = quat
    # The carrier is moved by its servos alone; its weight would only make them sag.
    mount.gravcomp = 1.0
    if _is_nothing(mount):
        # The base is a mere frame, and MuJoCo cannot move a body without mass.
        set_tiny(mount)
    for index, axis in enumerate(AXES):
        if options.carrier == "lift" and axis != "z":
            continue
        slide = index < 3
        joint = mount.add_joint(
            name=f"{CARRIER}/{axis}",
            type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
            axis=turn.T[:, index % 3],
            armature=_INERTIA[index],
        )
        motor = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        motor.set_to_position(kp=_STIFFNESS[index], dampratio=1.0)


def _is_nothing(body: mujoco.MjsBody) -> bool:
    """Return whether neither a body nor anything fixed to it has mass or shape."""
    if body.geoms or (body.explicitinertial and body.mass > 0.0):
        return False
    return all(_is_nothing(each) for each in body.bodies if not each.joints)


def add_table(spec: mujoco.MjSpec, top: FloatArray, *, edge: bool = False) -> None:
    """Add a table.

    Args:
        spec: The model.
        top: Pose ``(4, 4)`` of its top in the world, z up.
        edge: Whether the top ends at its origin, on the side of its x axis.
    """
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(top[:3, :3]).ravel())
    middle = top @ [-_TABLE[0] if edge else 0.0, 0.0, -_TABLE[2], 1.0]
    geom = spec.worldbody.add_geom(
        name=TABLE, type=mujoco.mjtGeom.mjGEOM_BOX, size=_TABLE, pos=middle[:3], quat=quat
    )
    make_hard(geom, TABLE_FRICTION)


def tip_geoms(model: mujoco.MjModel, hand: Hand, fingers: Iterable[str]) -> list[NDArray[np.intp]]:
    """Return the indices of the geoms of each of the fingertips that have a link."""
    links = [hand.finger(name).tip_links for name in fingers]
    bodies = [[model.body(LINK + link).id for link in tip] for tip in links if tip]
    return [np.flatnonzero(np.isin(model.geom_bodyid, tip)) for tip in bodies]


def tip_middles(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[NDArray[np.intp]]
) -> FloatArray:
    """Return the middles ``(k, 3)`` [m] of the fingertips' geometry in the world."""
    middles = []
    for each in geoms:
        weight = model.geom_rbound[each] ** 3  # roughly proportional to the volume
        middles.append(weight @ data.geom_xpos[each] / weight.sum())
    return np.array(middles).reshape(-1, 3)


def _place_in_hand(
    hand: Hand,
    spec: mujoco.MjSpec,
    shape: ObjectShape,
    place: FloatArray,
    mount: FloatArray,
    closing: TipsClosing | None,
) -> FloatArray | None:
    """Return the pose at which a hand closes on an object.

    A gripper closes with its two tips, so the object is put between them if it fits. More
    fingers may wrap around the object: it is moved out of the hand until it is clear of the hand
    at rest.

    Args:
        hand: The hand.
        spec: Its model, to which nothing is added.
        shape: The object.
        place: The pose ``(4, 4)`` of the object in the hand's base frame, where the search starts.
        mount: The pose ``(4, 4)`` of that frame in the world.
        closing: The closing motion of a gripper; ``None``: not a gripper, or not known.

    Returns:
        The pose found; ``None`` if the open hand overlaps the object in all that are nearby.

    Raises:
        ConfigError: if the object's mesh cannot be used.
    """
    probe = spec.copy()
    add_object(probe, shape, mass=1.0, pose=mount @ place)
    model = compiled(probe, hand, _file_of(shape))
    data = mujoco.MjData(model)
    start = model.joint(OBJECT).qposadr[0]
    origin, way = model.qpos0[start : start + 3].copy(), approach(hand)
    open_hand = rest_position(model, hand)
    moved = place.copy()

    def is_clear(posture: FloatArray, position: FloatArray) -> bool:
        data.qpos[:] = posture
        data.qpos[start : start + 3] = position
        return not _links_inside(model, data)

    if closing is not None:
        geoms = tip_geoms(model, hand, [finger.name for finger in hand.fingers])
        middles = []
        shares = np.linspace(1.0, 0.0, _CLOSURES).tolist()
        postures = [
            rest_position(model, hand, from_rest(hand.rest, closing.end, share)) for share in shares
        ]
        for posture in postures:
            data.qpos[:] = posture
            mujoco.mj_kinematics(model, data)
            middles.append(tip_middles(model, data, geoms).mean(axis=0))
        if closing.point is not None:
            meeting = mount[:3, :3] @ closing.point + mount[:3, 3]
            middles = [middle + meeting - middles[0] for middle in middles]
        # From closed to open: the first place that is clear is the tightest.
        for posture, middle in zip(postures, middles, strict=True):
            if is_clear(posture, middle) and is_clear(open_hand, middle):
                moved[:3, 3] = mount[:3, :3].T @ (middle - mount[:3, 3])
                return moved
    for out in np.arange(0.0, _FARTHEST_OUT, _OUT_STEP).tolist():
        if is_clear(open_hand, origin + out * (mount[:3, :3] @ way)):
            moved[:3, 3] += out * way
            return moved
    return None


def _file_of(shape: ObjectShape | None) -> tuple[str, Path] | None:
    """Return the name in a model and the file of an object's mesh, if it has one."""
    return None if shape is None or shape.path is None else (OBJECT, shape.path)


def _notes_on(shape: ObjectShape | None) -> list[str]:
    """Return the notes on the mesh of an object, if it has one."""
    if shape is None or shape.path is None:
        return []
    parts = solid_parts(str(shape.path), shape.scale)
    found = [note(*part) for note in (open_mesh, hollow_mesh) for part in parts]
    return [f"{shape.path.name}: {note}" for note in dict.fromkeys(found) if note]


def _links_inside(model: mujoco.MjModel, data: mujoco.MjData) -> set[str]:
    """Return the bodies of links that the object overlaps at the present positions."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)  # MuJoCo's search for near pairs needs it
    mujoco.mj_collision(model, data)
    links = set()
    for contact in data.contact:
        bodies = [int(model.geom_bodyid[geom]) for geom in contact.geom]
        of_object = [model.body(model.body_rootid[body]).name == OBJECT for body in bodies]
        # Within the margin, a link is inside the object's surface.
        if any(of_object):
            links |= {
                model.body(b).name for b, own in zip(bodies, of_object, strict=True) if not own
            }
    return links


def make_simulation(
    hand: Hand,
    options: SimOptions,
    actuators: Sequence[str],
    period: float,
    *,
    place: FloatArray | None = None,
    mount: FloatArray | None = None,
    furnish: Callable[[mujoco.MjSpec, float], object] = lambda spec, height: None,
    built: Built | None = None,
    closing: TipsClosing | None = None,
) -> Simulation:
    """Build, compile and start the simulation that the options describe.

    Args:
        hand: The hand.
        options: The options of the simulation.
        actuators: The actuators that are read and commanded, in order.
        period: Time between exchanges [s].
        place: Pose ``(4, 4)`` of the object in the hand's base frame; by default its middle is
            where the fingertips meet.
        mount: Rotation ``(3, 3)`` of a carried hand in the world; by default it reaches down.
        furnish: Adds to a model what else is on the table, whose top is at a height in the world
            [m]; the names of its shapes begin with `TABLE`.
        built: The hand's model from `build_hand`, whose options may differ from these only in
            object and friction; by default it is built here.
        closing: The closing motion of a gripper; its object is put between the tips by default.

    Raises:
        ModelError: if the hand cannot be simulated.
        ConfigError: if there is no such object, or its mesh cannot be used.
    """
    shape: ObjectShape | None = None
    doubts: list[str] = []
    built = copied(built, hand, options.friction) if built else build_hand(hand, options)
    pose = np.eye(4)
    if options.carrier != "fixed":
        pose[:3, :3] = downward(hand) if mount is None else mount
    add_carrier(built.spec, pose[:3, :3], options)
    if options.object:
        shape = parse_object(options.object, MESHES).scaled(options.object_scale)
        if place is None:
            inside = np.eye(4)
            inside[:3, 3] = grasp_centre(hand)
            inside[:3, :3] = pose[:3, :3].T  # upright in the world
            place = _place_in_hand(hand, built.spec, shape, inside, pose, closing)
            if place is None:
                place = inside
                doubts.append(
                    f"'{options.object}' overlaps the open hand wherever it is put; it may be too "
                    "large, and forces push it out"
                )
        pose = pose @ place
        add_object(built.spec, shape, mass=options.object_mass, pose=pose)
        if options.support == "table":
            top = np.eye(4)
            top[2, 3] = shape.lowest(pose)
            add_table(built.spec, top)
            furnish(built.spec, top[2, 3])
    model = compiled(built.spec, hand, _file_of(shape))
    notes = (*built.notes, *built.following, *_notes_on(shape))
    simulation = Simulation(model, hand, options, actuators, period, built.servos, notes)
    simulation.doubts += tuple(doubts)
    return simulation
