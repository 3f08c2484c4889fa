"""Conversion of an MJCF model to a URDF, the format that rtee reads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np
from numpy.typing import NDArray

from rtee.drivers.mujoco.model import CARRIER
from rtee.drivers.mujoco.solids import turn_of
from rtee.errors import ConfigError, ModelError, UnknownLink
from rtee.exchange.mjcf_coupling import motion_of
from rtee.exchange.mjcf_files import ParsedModel, listening, mujoco_says, read_mjcf
from rtee.exchange.mjcf_motion import Follow, ModelMotion, joint_name, joint_range
from rtee.exchange.readable import ReadableModel
from rtee.hand.files import make_folder, write_atomically
from rtee.hand.frames import angles
from rtee.hand.model import DisabledPair
from rtee.hand.names import safe_name, unique_names
from rtee.hand.tessellation import binary_stl, sphere
from rtee.sample import FloatArray

Faces = NDArray[np.signedinteger[Any]]
"""Triangles as indices of their corners ``(f, 3)``."""

EXCLUDED: Final = "excluded in the MJCF"
"""Reason for which a pair of links is never checked for collision."""

_SEEN = 2
"""Highest group of shapes that MuJoCo's viewers show by default."""

_ANY: Final = 1e3
"""Limits of a follower without limits of its own [rad | m]; those of its actuator decide."""


@dataclass(frozen=True, slots=True)
class _Link:
    """A link of the URDF.

    Attributes:
        name: Name of the link.
        body: The body with its shapes; ``None`` for a link between two joints of a body.
        origin: Origin of its frame, that of its joint, in the body's frame ``(3,)`` [m].
    """

    name: str
    body: int | None
    origin: FloatArray


def import_mjcf(
    path: Path | str,
    folder: Path,
    folders: Sequence[Path | str] = (),
    *,
    root: str | None = None,
    radians: bool | None = None,
) -> ReadableModel:
    """Write the URDF of an MJCF model into a folder, with its meshes beside it.

    Args:
        path: The model's file.
        folder: Where to write.
        folders: Further folders of its includes and meshes.
        root: Base body of the hand in a model of a whole robot or scene. The robot's floating base
            then stands still, and free objects are left out.
        radians: Whether the angles of a file that states no unit are radians; ``None``: degrees.

    Raises:
        UnknownLink: if the model has no body ``root``.
        ConfigError: if a unit is given, although the file states its own.
        ModelError: if the file cannot be read, or has elements that a URDF cannot represent; the
            message names file and line if they are known.
    """
    source = read_mjcf(path, folders)
    if radians is not None:
        if source.says_angle:
            raise ConfigError(
                "--angle is for files without <compiler angle>; this file has one",
                path=source.path,
            )
        source.spec.compiler.degree = not radians
    loose = [] if root is None else _still(source, root)
    for joint in source.spec.joints:
        _check_joint(joint, source)
    with mujoco_says(source.path, lines=source.alone) as notes:
        model = source.spec.compile()
    try:
        with listening(notes):
            motion = motion_of(model)
    except ModelError as error:
        # The solver knows the model, but not its file.
        error.path = source.path
        raise
    except np.linalg.LinAlgError:
        raise ModelError(
            "the numbers of its couplings are too far apart to solve them", path=source.path
        ) from None
    motion.notes += [*loose, *notes, *(_degrees(model, source) if radians is None else [])]
    writer = _Writer(model, source, motion, folder)
    urdf = folder / f"{safe_name(source.spec.modelname or source.path.stem, 'hand')}.urdf"
    write_atomically(urdf, writer.text())
    return ReadableModel(urdf, writer.passive(), writer.excluded(), tuple(writer.notes))


def _still(source: ParsedModel, root: str) -> list[str]:
    """Remove the joints outside the hand that no URDF has, or their bodies; return notes."""
    kinds, spec = mujoco.mjtJoint, source.spec
    odd = [each for each in spec.joints if each.type in (kinds.mjJNT_FREE, kinds.mjJNT_BALL)]
    if not odd:
        return []
    hand = spec.body(root)
    if hand is None:
        raise UnknownLink(root, tuple(body.name for body in spec.bodies), path=source.path)
    inside = {body.name for body in hand.find_all("body")}
    notes = []
    for joint in odd:
        body = joint.parent
        named = f"body '{body.name}'" if body.name else "a body without a name"
        above = body.name == root or root in {each.name for each in body.find_all("body")}
        if joint.type == kinds.mjJNT_FREE and not above:
            notes.append(f"{named} is free and not part of the hand, so it is left out")
            spec.delete(body)
        elif above or body.name not in inside:
            where = "the hand's base" if body.name == root else "outside the hand"
            notes.append(f"{named}, {where}, stands still as drawn")
            spec.delete(joint)
    return notes


def _check_joint(joint: mujoco.MjsJoint, source: ParsedModel) -> None:
    kind, body = joint.type, joint.parent.name
    named = f"'{joint.name}' " if joint.name else ""
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        raise ModelError(
            f"joint {named}of body '{body}' is free; a hand's base is fixed, so give the "
            "hand's base with --root, or remove the joint (and bodies that are not parts of the "
            "hand)",
            path=source.path,
        )
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        raise ModelError(
            f"joint {named}of body '{body}' is a ball joint, which has three degrees of freedom in "
            "one; rtee needs three hinges",
            path=source.path,
        )


def _degrees(model: mujoco.MjModel, source: ParsedModel) -> list[str]:
    """Return a note if angles count as degrees only by default.

    Models made for inclusion leave the unit to the including file; read alone, in degrees, their
    hinges hardly turn.
    """
    hinges = (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & (model.jnt_limited != 0)
    if source.says_angle or not hinges.any():
        return []
    most = float(np.abs(model.jnt_range[hinges]).max())
    # No hinge turns by more than a full turn, so that larger numbers are degrees.
    if most > math.radians(2.0 * math.pi):
        return []
    return [
        "the file does not state the unit of its angles, so they count as degrees, and no "
        f"hinge turns beyond {math.degrees(most):.2g}°; if they are radians, give "
        '--angle radian, or add <compiler angle="radian"/>'
    ]


class _Writer:
    """Writes a model as a URDF."""

    def __init__(
        self, model: mujoco.MjModel, source: ParsedModel, motion: ModelMotion, folder: Path
    ) -> None:
        self._model, self._source, self._motion, self._folder = model, source, motion, folder
        self.notes = [*source.notes, *motion.notes]
        self._lines: list[str] = []
        self._meshes: dict[int, str] = {}
        # Names that are generated may be equal.
        self._joint_names = unique_names([joint_name(model, j) for j in range(model.njnt)])
        names = [str(model.body(b).name) or f"body_{b}" for b in range(model.nbody)]
        self._names = unique_names(names)
        children: dict[int, list[int]] = {b: [] for b in range(model.nbody)}
        dropped = {int(model.jnt_bodyid[joint]) for joint in motion.dropped}
        for body in range(1, model.nbody):
            if body not in dropped:
                children[int(model.body_parentid[body])].append(body)
        self._children = children
        self.root = self._root()

    def _root(self) -> int:
        """Return the body of the hand's base, which is fixed to the world or to a carrier."""
        model, body = self._model, 0
        while body == 0 or self._names[body] == CARRIER:
            below = self._children[body]
            # A carrier may have the floor of a scene, but no other shape.
            shapes = [
                g for g in self._geoms(body) if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE
            ]
            if len(below) != 1 or shapes or model.body_jntnum[below[0]]:
                break
            body = below[0]
        return body

    def _geoms(self, body: int) -> list[int]:
        first = int(self._model.body_geomadr[body])
        return list(range(first, first + int(self._model.body_geomnum[body])))

    def text(self) -> str:
        """Write the meshes and return the URDF."""
        name = self._source.spec.modelname or self._source.path.stem
        self._lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr(name)}>"]
        root = _Link(self._names[self.root], self.root, np.zeros(3))
        pending = [root]
        self._link(root)
        while pending:
            parent = pending.pop(0)
            assert parent.body is not None  # noqa: S101 - only bodies have bodies below
            pending += [self._body(parent, child) for child in self._children[parent.body]]
        return "\n".join([*self._lines, "</robot>"]) + "\n"

    def _body(self, parent: _Link, body: int) -> _Link:
        """Write a body with its joints, and empty links between several joints."""
        model = self._model
        place, turn = model.body_pos[body] - parent.origin, model.body_quat[body]
        first, number = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        joints = list(range(first, first + number)) if number else []
        if not joints:
            link = _Link(self._names[body], body, np.zeros(3))
            self._link(link)
            self._fixed(f"{link.name}_fixed", parent.name, link.name, place, turn)
            return link
        # A joint of a URDF turns about the origin of its child link, but one of MuJoCo about an
        # anchor in the body. So each link's frame is placed at the anchor of its joint.
        above, before = parent.name, np.zeros(3)
        link = parent
        for joint in joints:
            anchor, last = model.jnt_pos[joint].copy(), joint == joints[-1]
            name = self._names[body] if last else f"{self._names[body]}/{self._joint_names[joint]}"
            link = _Link(name, body if last else None, anchor)
            self._link(link)
            if joint == joints[0]:
                at = place + turn_of(turn) @ anchor
            else:
                at, turn = anchor - before, np.array([1.0, 0.0, 0.0, 0.0])
            self._joint(joint, above, name, at, turn)
            above, before = name, anchor
        return link

    def _joint(
        self, joint: int, parent: str, child: str, place: FloatArray, turn: FloatArray
    ) -> None:
        motion, name = self._motion, self._joint_names[joint]
        if joint in motion.fixed:
            self.notes.append(f"joint '{name}' is held, so it is fixed")
            self._fixed(name, parent, child, *self._moved(joint, place, turn))
            return
        driven = motion.driven.get(joint)
        lower, upper = self._limits(joint)
        limited = math.isfinite(lower) and math.isfinite(upper)
        kind = "prismatic" if self._slides(joint) else "revolute" if limited else "continuous"
        effort = driven.effort if driven is not None else 0.0
        limit = f' lower="{_number(lower)}" upper="{_number(upper)}"' if limited else ""
        self._lines += [
            f'  <joint name={quoteattr(name)} type="{kind}">',
            f"    <parent link={quoteattr(parent)}/>",
            f"    <child link={quoteattr(child)}/>",
            f"    {_origin(place, turn)}",
            f'    <axis xyz="{_numbers(self._model.jnt_axis[joint])}"/>',
            # MuJoCo has no velocity limits; 0 means that none is given.
            f'    <limit{limit} effort="{_number(effort)}" velocity="0"/>',
            *self._mimic(motion.follows.get(joint)),
            "  </joint>",
        ]

    def _slides(self, joint: int) -> bool:
        return bool(self._model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)

    def _moved(
        self, joint: int, place: FloatArray, turn: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the pose after a held joint, given the pose before the joint."""
        axis, position = self._model.jnt_axis[joint], self._motion.fixed[joint]
        if self._slides(joint):
            return place + turn_of(turn) @ (axis * position), turn
        by, total = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(by, axis, position)
        mujoco.mju_mulQuat(total, turn, by)
        return place, total

    def _limits(self, joint: int) -> tuple[float, float]:
        """Return the limits of a joint [rad | m]; infinite for none."""
        driven, name = self._motion.driven.get(joint), self._joint_names[joint]
        lower, upper = (
            joint_range(self._model, joint) if driven is None else (driven.lower, driven.upper)
        )
        limited = math.isfinite(lower) and math.isfinite(upper)
        # A URDF needs limits for a follower, although the limits of its actuator decide.
        if not limited and joint in self._motion.follows:
            return -_ANY, _ANY
        if self._slides(joint) and not limited:
            raise ModelError(
                f"slide joint '{name}' has no range; give it one, or its actuator a ctrlrange",
                path=self._source.path,
            )
        if limited and lower > upper:
            raise ModelError(
                f"the range of joint '{name}' and the ctrlrange of its actuator do not overlap",
                path=self._source.path,
            )
        return lower, upper

    def _mimic(self, follow: Follow | None) -> list[str]:
        if follow is None:
            return []
        master = quoteattr(self._joint_names[follow.of])
        if follow.expression is not None:
            return [f"    <mimic joint={master} nlFunPos={quoteattr(follow.expression)}/>"]
        how = f'multiplier="{_number(follow.factor)}" offset="{_number(follow.offset)}"'
        return [f"    <mimic joint={master} {how}/>"]

    def _fixed(
        self, name: str, parent: str, child: str, place: FloatArray, turn: FloatArray
    ) -> None:
        self._lines += [
            f'  <joint name={quoteattr(name)} type="fixed">',
            f"    <parent link={quoteattr(parent)}/>",
            f"    <child link={quoteattr(child)}/>",
            f"    {_origin(place, turn)}",
            "  </joint>",
        ]

    def _link(self, link: _Link) -> None:
        self._lines.append(f"  <link name={quoteattr(link.name)}>")
        if link.body is not None:
            self._lines += self._inertial(link.body, link.origin)
            for geom in self._geoms(link.body):
                self._lines += self._shapes(geom, link)
        self._lines.append("  </link>")

    def _inertial(self, body: int, origin: FloatArray) -> list[str]:
        model = self._model
        mass = float(model.body_mass[body])
        # A massless body is only visual, and body 0 is the world.
        if mass <= 0.0 or body == 0:
            return []
        # Principal moments, since MuJoCo rotates the inertia's frame to remove the products.
        xx, yy, zz = (_number(moment) for moment in model.body_inertia[body])
        return [
            "    <inertial>",
            f"      {_origin(model.body_ipos[body] - origin, model.body_iquat[body])}",
            f'      <mass value="{_number(mass)}"/>',
            f'      <inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/>',
            "    </inertial>",
        ]

    def _shapes(self, geom: int, link: _Link) -> list[str]:
        """Return the elements of a shape: collision geometry, visual geometry, both or none."""
        model = self._model
        paired = np.isin(geom, [model.pair_geom1, model.pair_geom2])
        touches = bool(model.geom_contype[geom] or model.geom_conaffinity[geom] or paired)
        seen = int(model.geom_group[geom]) <= _SEEN
        roles = [role for role, has in (("collision", touches), ("visual", seen)) if has]
        if not roles:
            return []
        pieces = self._pieces(geom, link)
        return [
            line
            for role in roles
            for origin, shape in pieces
            for line in (
                f"    <{role}>",
                f"      {origin}",
                f"      <geometry>{shape}</geometry>",
                f"    </{role}>",
            )
        ]

    def _pieces(self, geom: int, link: _Link) -> list[tuple[str, str]]:
        """Return the shapes of a URDF for a shape of MuJoCo, each with its origin."""
        model, kinds = self._model, mujoco.mjtGeom
        place, turn = model.geom_pos[geom] - link.origin, model.geom_quat[geom]
        size, origin = model.geom_size[geom], _origin(place, turn)
        match kinds(int(model.geom_type[geom])):
            case kinds.mjGEOM_BOX:
                return [(origin, f'<box size="{_numbers(2.0 * size)}"/>')]
            case kinds.mjGEOM_SPHERE:
                return [(origin, f'<sphere radius="{_number(size[0])}"/>')]
            case kinds.mjGEOM_CYLINDER:
                return [(origin, _cylinder(size))]
            case kinds.mjGEOM_CAPSULE:
                # A URDF has no capsules; a cylinder with a sphere at each end has the same shape.
                along = turn_of(turn)[:, 2] * size[1]
                ball = f'<sphere radius="{_number(size[0])}"/>'
                ends = [(_origin(place + end, turn), ball) for end in (along, -along)]
                return [(origin, _cylinder(size)), *ends]
            case kinds.mjGEOM_ELLIPSOID:
                vertices, faces = sphere(1.0)
                return [(origin, self._mesh_file(f"ellipsoid_{geom}", vertices * size, faces))]
            case kinds.mjGEOM_MESH:
                return [(origin, self._mesh(int(model.geom_dataid[geom])))]
        self.notes.append(f"a plane of body '{link.name}' is not a part of a hand and is left out")
        return []

    def _mesh(self, mesh: int) -> str:
        model = self._model
        if mesh not in self._meshes:
            first, faces = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
            # MuJoCo's vertices instead of the file's, since it moves the mesh, and the shape's
            # pose, into the inertial frame.
            vertices = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
            corners = model.mesh_face[faces : faces + int(model.mesh_facenum[mesh])]
            name = str(model.mesh(mesh).name) or "mesh"
            # With its number, since two names may become equal when made safe.
            self._meshes[mesh] = self._mesh_file(
                f"{safe_name(name, 'mesh')[:60]}_{mesh}", vertices, corners
            )
        return self._meshes[mesh]

    def _mesh_file(self, name: str, vertices: FloatArray, faces: Faces) -> str:
        place = f"meshes/{name}.stl"
        make_folder(self._folder / "meshes")
        write_atomically(self._folder / place, binary_stl(vertices[faces]))
        return f"<mesh filename={quoteattr(place)}/>"

    def passive(self) -> tuple[str, ...] | None:
        """Return the joints without a motor."""
        if self._model.nu == 0:
            return None
        return tuple(self._joint_names[joint] for joint in self._motion.passive)

    def excluded(self) -> tuple[DisabledPair, ...]:
        """Return the pairs of links that the model excludes."""
        # MuJoCo packs both bodies into one number.
        return tuple(
            DisabledPair(self._names[signature >> 16], self._names[signature & 0xFFFF], EXCLUDED)
            for signature in self._model.exclude_signature.tolist()
        )


def _cylinder(size: FloatArray) -> str:
    return f'<cylinder radius="{_number(size[0])}" length="{_number(2.0 * size[1])}"/>'


def _origin(place: FloatArray, turn: FloatArray) -> str:
    """Return the element ``origin`` of a position [m] and a unit quaternion (w, x, y, z)."""
    return f'<origin xyz="{_numbers(place)}" rpy="{_numbers(angles(turn_of(turn)))}"/>'


def _number(value: float) -> str:
    return repr(float(value))


def _numbers(values: Sequence[float] | FloatArray) -> str:
    return " ".join(_number(value) for value in values)
