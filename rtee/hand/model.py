"""The model of a hand: its fingers, actuators and joints, and the transmission between them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

from rtee.errors import UnknownActuator, UnknownFinger, UnknownJoint
from rtee.hand.config_schema import ActuatorDynamics, FlangeSection, TouchSection
from rtee.hand.transmission import Transmission
from rtee.hand.urdf import Urdf
from rtee.sample import MEASURED, FloatArray
from rtee.types import ActuatorSpec, JointKind, readonly

CLEARANCE: Final = 0.001
"""Default distance that clear poses keep from other links [m]: the error of models of real hands is
about a millimetre."""


class JointRole(StrEnum):
    """The role of a moving joint in the hand."""

    ACTUATOR = "actuator"
    MIMIC = "mimic"
    PASSIVE = "passive"
    IGNORED = "ignored"


class DisabledPair(NamedTuple):
    """Two links that are never checked for collision, and the reason."""

    link1: str
    link2: str
    reason: str


@dataclass(frozen=True, slots=True)
class Joint:
    """A moving joint.

    Attributes:
        name: Its name in the URDF.
        kind: Revolute, continuous or prismatic.
        role: Actuator, mimic, passive or ignored. A joint that is both mimic and passive is a
            mimic; an ignored one has a motor but stays at its rest position like a fixed joint.
        parent: Parent link.
        child: Child link.
        lower: Lower limit [rad | m]; ``-inf`` if continuous.
        upper: Upper limit [rad | m]; ``inf`` if continuous.
        line: Line of its definition in the URDF.
    """

    name: str
    kind: JointKind
    role: JointRole
    parent: str
    child: str
    lower: float
    upper: float
    line: int = 0


@dataclass(frozen=True, slots=True)
class Finger:
    """A finger: a chain from base to tip.

    Attributes:
        name: Its name (the SRDF group, or derived from its links).
        base: First link of the chain.
        tip: The fingertip's frame: last link of the chain with collision geometry; ``None`` if it
            has none.
        tip_links: The links that form the fingertip: ``tip`` and the links with collision geometry
            that are welded to it; empty without a tip.
        links: Links of the chain from base to end.
        bars: Links beside the chain that belong to the finger: the bars of its linkage.
        actuators: Names of the actuators that move the fingertip, nearest the palm first.
        own: The actuators that move no other fingertip, nearest the palm first.
        reason: Why the chain is a finger.
    """

    name: str
    base: str
    tip: str | None
    tip_links: tuple[str, ...]
    links: tuple[str, ...]
    actuators: tuple[str, ...]
    own: tuple[str, ...]
    reason: str = ""
    bars: tuple[str, ...] = ()

    @property
    def body(self) -> tuple[str, ...]:
        """All links that belong to the finger: its chain from the base on, tip and bars."""
        return tuple(dict.fromkeys((*self.links, *self.tip_links, *self.bars)))


@dataclass(frozen=True, eq=False)
class Hand:
    """A robotic hand, gripper or any other end-effector; compared by identity.

    Attributes:
        name: Its name.
        base: Root link; the hand's base frame.
        joints: All moving joints in the order of the URDF's tree.
        actuators: The actuators in the order of the URDF's tree, the order of all actuator arrays.
        fingers: The fingers.
        transmission: Map from actuator positions to joint positions.
        rest: Rest posture ``(n,)`` [rad | m].
        urdf: The parsed URDF.
        disabled_collisions: Pairs of links that are never checked, with the SRDF's reason.
        notes: Findings about the model and assumptions, one sentence each.
        package_dirs: Folders in which to look up ``package://``.
        description: Its name for people.
        clearance: Distance that clear poses and the paths to them keep from all other links [m].
        dynamics: Dynamics of the actuators, by name; unknown for missing ones.
        payload: Largest mass that it may hold [kg]; infinite if unknown.
        openings: Pairs of intensity and opening [m] measured on the real hand, by action.
        tip_friction: Coefficient of friction of fingertips, by finger; unknown for missing ones.
        touch: Placement of touch sensors in hand.yaml, by name.
        flange: Where the hand sits on an arm; ``None`` if unknown.
        folder: The folder from which it was read, with its actions; ``None`` for a bare model.
    """

    name: str
    base: str
    joints: tuple[Joint, ...]
    actuators: tuple[ActuatorSpec, ...]
    fingers: tuple[Finger, ...]
    transmission: Transmission
    rest: FloatArray
    urdf: Urdf
    disabled_collisions: tuple[tuple[str, str, str], ...] = ()
    notes: tuple[str, ...] = ()
    package_dirs: tuple[Path, ...] = ()
    description: str = field(default="", kw_only=True)
    clearance: float = field(default=CLEARANCE, kw_only=True)
    dynamics: Mapping[str, ActuatorDynamics] = field(default_factory=dict, kw_only=True)
    payload: float = field(default=math.inf, kw_only=True)
    openings: Mapping[str, tuple[tuple[float, float], ...]] = field(
        default_factory=dict, kw_only=True
    )
    tip_friction: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    touch: Mapping[str, TouchSection] = field(default_factory=dict, kw_only=True)
    flange: FlangeSection | None = field(default=None, kw_only=True)
    folder: Path | None = field(default=None, kw_only=True)

    @property
    def observation_features(self) -> dict[str, type[float]]:
        """Keys and types of `State.observation`, known before connecting, in order."""
        return {f"{name}.{own}": float for name in MEASURED for own in self.actuator_names}

    @property
    def action_features(self) -> dict[str, type[float]]:
        """Keys and types of a stream's samples: positions by actuator [rad | m], in order."""
        return dict.fromkeys(self.actuator_names, float)

    @cached_property
    def lower(self) -> FloatArray:
        """Lower limits of the actuators ``(n,)`` [rad | m]."""
        return readonly([a.lower for a in self.actuators])

    @cached_property
    def upper(self) -> FloatArray:
        """Upper limits of the actuators ``(n,)`` [rad | m]."""
        return readonly([a.upper for a in self.actuators])

    @cached_property
    def actuator_names(self) -> tuple[str, ...]:
        """Names of the actuators, in order."""
        return tuple(a.name for a in self.actuators)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the moving joints, in the order of the transmission's joint positions."""
        return tuple(j.name for j in self.joints)

    @cached_property
    def finger_names(self) -> tuple[str, ...]:
        """Names of the fingers, in order."""
        return tuple(f.name for f in self.fingers)

    @cached_property
    def tip_links(self) -> Mapping[str, str]:
        """The finger of each fingertip link, by link."""
        return {link: finger.name for finger in self.fingers for link in finger.tip_links}

    def actuator(self, name: str) -> ActuatorSpec:
        """Return an actuator by name; raises `UnknownActuator`."""
        return self.actuators[self.actuator_index(name)]

    def actuator_index(self, name: str) -> int:
        """Return an actuator's index by name; raises `UnknownActuator`."""
        try:
            return self.actuator_names.index(name)
        except ValueError:
            raise UnknownActuator(name, self.actuator_names) from None

    def joint_index(self, name: str) -> int:
        """Return a joint's index by name; raises `UnknownJoint`."""
        try:
            return self.joint_names.index(name)
        except ValueError:
            raise UnknownJoint(name, self.joint_names) from None

    def finger(self, name: str) -> Finger:
        """Return a finger by name; raises `UnknownFinger`."""
        for finger in self.fingers:
            if finger.name == name:
                return finger
        raise UnknownFinger(name, self.finger_names)

    def clamp(self, position: Sequence[float] | FloatArray) -> FloatArray:
        """Return actuator positions ``(n,)`` clamped into the limits."""
        return readonly(
            [
                min(max(value, a.lower), a.upper)
                for value, a in zip(position, self.actuators, strict=True)
            ]
        )
