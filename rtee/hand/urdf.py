"""The data of a URDF: links, joints, geometry and limits, each with its line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from rtee.errors import ModelError, UnknownLink

GeometryKind = Literal["mesh", "box", "sphere", "cylinder"]
UrdfJointKind = Literal["revolute", "continuous", "prismatic", "fixed"]
Triple = tuple[float, float, float]

ZERO: Final[Triple] = (0.0, 0.0, 0.0)

LARGE: Final = 5.0
"""Length above which a model must be in millimetres [m]: no part of a hand is so large."""


@dataclass(frozen=True, slots=True)
class UrdfGeometry:
    """A collision or visual shape of a link.

    Attributes:
        kind: Mesh, box, sphere or cylinder.
        size: Edge lengths of a box [m].
        radius: Radius of a sphere or cylinder [m].
        length: Length of a cylinder along its z axis [m].
        mesh: Address of the mesh file as in the URDF; empty for the other kinds.
        scale: Scale factors of the mesh along x, y and z; negative ones mirror it.
        xyz: Position of its frame in the link's frame [m].
        rpy: Orientation of its frame in the link's frame: roll, pitch, yaw [rad].
        line: Line in the URDF.
    """

    kind: GeometryKind
    size: Triple = ZERO
    radius: float = 0.0
    length: float = 0.0
    mesh: str = ""
    scale: Triple = (1.0, 1.0, 1.0)
    xyz: Triple = ZERO
    rpy: Triple = ZERO
    line: int = 0

    @property
    def dimensions(self) -> tuple[float, ...]:
        """Edge lengths of a box, radius of a sphere, radius and length of a cylinder [m]."""
        of_kind = {"box": self.size, "sphere": (self.radius,)}
        return of_kind.get(self.kind, (self.radius, self.length))


@dataclass(frozen=True, slots=True)
class UrdfInertia:
    """The mass distribution of a link.

    Attributes:
        xyz: Centre of mass in the link's frame [m].
        rpy: Orientation of the inertial frame in the link's frame: roll, pitch, yaw [rad].
        moments: Moments and products of inertia about the centre of mass, in the inertial frame:
            xx, xy, xz, yy, yz, zz [kg·m²].
    """

    xyz: Triple = ZERO
    rpy: Triple = ZERO
    moments: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class UrdfLink:
    """A rigid body.

    Attributes:
        name: Its name.
        line: Line in the URDF.
        collisions: Its collision shapes.
        visuals: Its visual shapes.
        has_inertial: Whether it has an ``<inertial>`` element.
        mass: Its mass [kg]; 0 when not given.
        inertia: Distribution of the mass; ``None`` without ``<inertia>``.
        friction: Coefficient of friction of its surface, from Gazebo's ``mu1`` or Bullet's
            ``lateral_friction``; ``None`` when not given.
    """

    name: str
    line: int
    collisions: tuple[UrdfGeometry, ...] = ()
    visuals: tuple[UrdfGeometry, ...] = ()
    has_inertial: bool = False
    mass: float = 0.0
    inertia: UrdfInertia | None = None
    friction: float | None = None


@dataclass(frozen=True, slots=True)
class UrdfMimic:
    """The coupling of a joint to another one.

    Attributes:
        of: Name of the joint that it follows.
        multiplier: Factor of a linear coupling.
        offset: Offset of a linear coupling [rad | m].
        expression: Expression in ``x`` of a non-linear coupling (``nlFunPos``), which replaces the
            factor and the offset.
        line: Line in the URDF.
    """

    of: str
    multiplier: float = 1.0
    offset: float = 0.0
    expression: str | None = None
    line: int = 0


@dataclass(frozen=True, slots=True)
class UrdfJoint:
    """A joint.

    Attributes:
        name: Its name.
        kind: Revolute, continuous, prismatic or fixed.
        parent: Parent link.
        child: Child link.
        xyz: Position of the joint's frame in the parent link's frame [m].
        rpy: Orientation of the joint's frame in the parent link's frame: roll, pitch, yaw [rad].
        axis: Unit axis in the joint's frame.
        lower: Lower limit [rad | m]; ``-inf`` if continuous, 0 if fixed.
        upper: Upper limit [rad | m]; ``inf`` if continuous, 0 if fixed.
        soft: Limits of ``<safety_controller>`` within these [rad | m]; ``None`` when not given.
        velocity: Velocity limit [rad/s | m/s]; 0 when not given.
        acceleration: Acceleration limit [rad/s² | m/s²] of URDF 1.2; 0 when not given.
        jerk: Jerk limit [rad/s³ | m/s³] of URDF 1.2; 0 when not given.
        effort: Effort limit [N·m | N]; 0 when not given.
        mimic: Its coupling, if it has one.
        line: Line in the URDF.
    """

    name: str
    kind: UrdfJointKind
    parent: str
    child: str
    xyz: Triple = ZERO
    rpy: Triple = ZERO
    axis: Triple = (1.0, 0.0, 0.0)
    lower: float = 0.0
    upper: float = 0.0
    soft: tuple[float, float] | None = None
    velocity: float = 0.0
    acceleration: float = 0.0
    jerk: float = 0.0
    effort: float = 0.0
    mimic: UrdfMimic | None = None
    line: int = 0

    @property
    def moving(self) -> bool:
        """Whether the joint is not fixed."""
        return self.kind != "fixed"


@dataclass(frozen=True)
class Urdf:
    """A robot description: a tree of links joined by joints.

    Attributes:
        name: The robot's name.
        path: The file it was read from.
        text: The file's text.
        links: Links by name, in the file's order.
        joints: Joints by name, in the order of the tree: depth first from the root, children in
            the file's order.
        root: The root link.
        joint_to: The joint above a link, by the link's name; the root has none.
        joints_below: The joints whose parent is a link, by the link's name.
        unread: Ignored content of the file, one sentence each.
    """

    name: str
    path: Path
    text: str
    links: Mapping[str, UrdfLink]
    joints: Mapping[str, UrdfJoint]
    root: str
    joint_to: Mapping[str, UrdfJoint]
    joints_below: Mapping[str, tuple[UrdfJoint, ...]]
    unread: tuple[str, ...] = ()

    def error(self, message: str, line: int | None = None) -> ModelError:
        """Return an error that points at a line of the file."""
        return ModelError(message, path=self.path, line=line)

    def path_to(self, link: str) -> tuple[UrdfJoint, ...]:
        """Return the joints from the root to a link, nearest the root first.

        Raises:
            UnknownLink: if there is no such link.
        """
        if link not in self.links:
            raise UnknownLink(link, tuple(self.links), path=self.path)
        joints = []
        joint = self.joint_to.get(link)
        # Upwards, since a link has one joint above it and any number below.
        while joint is not None:
            joints.append(joint)
            joint = self.joint_to.get(joint.parent)
        return tuple(reversed(joints))

    def links_to(self, link: str) -> tuple[str, ...]:
        """Return the links from the root to a link, both included; see `path_to`."""
        return self.root, *(joint.child for joint in self.path_to(link))

    def chain(self, base: str, tip: str) -> tuple[str, ...] | None:
        """Return the links from ``base`` down to ``tip``, or ``None`` if tip is not below base.

        Raises:
            UnknownLink: if there is no such link.
        """
        if base not in self.links:
            raise UnknownLink(base, tuple(self.links), path=self.path)
        links = self.links_to(tip)
        return links[links.index(base) :] if base in links else None

    def links_below(self, link: str) -> list[str]:
        """Return a link and all links below it, level by level."""
        links = [link]
        for name in links:
            links += [joint.child for joint in self.joints_below[name]]
        return links

    def master(self, joint: str) -> str:
        """Return the joint that a joint follows in the end; itself if it follows none."""
        seen = [joint]
        while (at := self.joints.get(seen[-1])) is not None and at.mimic is not None:
            # Loops of mimics are refused elsewhere, with their line.
            if at.mimic.of in seen:
                break
            seen.append(at.mimic.of)
        return seen[-1]
