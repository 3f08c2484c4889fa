"""What a grasp planner wants to know of a hand: limits, tip poses, Jacobians, transmission.

Computed with NumPy alone, so that the robot's computer needs no kinematics library. A fingertip's
Jacobian gives, for actuator velocities, the velocity of the origin of the tip's link and, below
it, the link's angular velocity, both in the hand's base frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtee.errors import GoalRejected, MessageError
from rtee.hand.frames import joint_motion, origin
from rtee.hand.model import Finger, Hand
from rtee.types import FloatArray


def tip_pose_and_jacobian(hand: Hand, link: str, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where a link is and how the actuators move it.

    Args:
        hand: The hand.
        link: The link.
        u: Actuator positions ``(n,)`` [rad | m].

    Returns:
        Its pose in the hand's base frame ``(4, 4)``, and its Jacobian ``(6, n)``.
    """
    q = hand.transmission.joints(u)
    slope = hand.transmission.jacobian(u)
    rows = {joint.name: row for row, joint in enumerate(hand.joints)}
    pose = np.eye(4)
    axes: list[tuple[int, FloatArray, FloatArray, bool]] = []
    for joint in hand.urdf.path_to(link):
        pose = pose @ origin(joint.xyz, joint.rpy)
        if not joint.moving:
            continue
        row, turning = rows[joint.name], joint.kind != "prismatic"
        axis = np.array(joint.axis, dtype=np.float64)
        axes.append((row, pose[:3, :3] @ axis, pose[:3, 3].copy(), turning))
        pose = pose @ joint_motion(joint.kind, joint.axis, float(q[row]))
    jacobian = np.zeros((6, len(hand.actuators)))
    for row, axis, where, turning in axes:
        column = np.zeros(6)
        if turning:
            column[:3], column[3:] = np.cross(axis, pose[:3, 3] - where), axis
        else:
            column[:3] = axis
        jacobian += np.outer(column, slope[row])
    return pose, jacobian


def posture_of(hand: Hand, positions: Mapping[str, float]) -> FloatArray:
    """Return actuator positions ``(n,)``: the given ones, the others at rest.

    Raises:
        GoalRejected: if a value is not finite or outside the limits.
        UnknownActuator: if there is no such actuator.
    """
    u = np.array(hand.rest)
    for name, value in positions.items():
        spec = hand.actuator(name)
        if not spec.lower - 1e-6 <= value <= spec.upper + 1e-6:
            raise GoalRejected(
                f"the position {value:g} of '{name}' is outside its limits "
                f"{spec.lower:g} to {spec.upper:g}"
            )
        u[hand.actuator_index(name)] = value
    return u


@dataclass(frozen=True, slots=True)
class ActuatorInfo:
    """An actuator; positions in rad or m.

    Attributes:
        name: Its name.
        kind: Revolute, continuous or prismatic.
        lower: Lower limit.
        upper: Upper limit.
        velocity: Velocity limit [rad/s | m/s].
        acceleration: Acceleration limit [rad/s² | m/s²].
        jerk: Jerk limit [rad/s³ | m/s³].
        effort: Effort limit [N·m | N].
        rest: Position in the rest posture.
        fingers: Fingers whose tips it moves.
    """

    name: str
    kind: str
    lower: float
    upper: float
    velocity: float
    acceleration: float
    jerk: float
    effort: float
    rest: float
    fingers: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class FingerInfo:
    """A finger at a posture.

    Attributes:
        name: Its name.
        base: First link of the chain.
        tip: The fingertip's link; empty if it has none.
        links: Links from base to end.
        actuators: Actuators that move the tip, nearest the palm first.
        tip_pose: Pose of the tip's link in the hand's base frame ``(4, 4)``; ``None`` without one.
        jacobian: Jacobian of the tip, linear part first, by the actuators ``(6, n)``.
    """

    name: str
    base: str
    tip: str
    links: tuple[str, ...]
    actuators: tuple[str, ...]
    tip_pose: FloatArray | None
    jacobian: FloatArray | None


@dataclass(frozen=True, slots=True)
class HandInfo:
    """A hand as a grasp planner needs it, at a posture.

    Attributes:
        name: Its name.
        base: Root link: the frame of all poses.
        actuators: The actuators, in order.
        joints: Names of all moving joints.
        fingers: The fingers.
        posture: Actuator positions at which the rest holds ``(n,)`` [rad | m].
        joint_positions: Joint positions there ``(m,)`` [rad | m].
        transmission: Derivative of joint by actuator positions there ``(m, n)``.
        urdf: The model's text.
    """

    name: str
    base: str
    actuators: tuple[ActuatorInfo, ...]
    joints: tuple[str, ...]
    fingers: tuple[FingerInfo, ...]
    posture: FloatArray
    joint_positions: FloatArray
    transmission: FloatArray
    urdf: str

    @property
    def actuator_names(self) -> tuple[str, ...]:
        """Names of the actuators, in order."""
        return tuple(actuator.name for actuator in self.actuators)


_ACTUATOR = tuple(ActuatorInfo.__slots__)


def info_fields(hand: Hand, positions: Mapping[str, float]) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/HandInfo`` at a posture.

    Raises:
        UserError: if the posture is none of the hand.
    """
    u = posture_of(hand, positions)
    return {
        "name": hand.name,
        "base": hand.base,
        "actuators": [
            {name: getattr(actuator, name) for name in _ACTUATOR} for actuator in hand.actuators
        ],
        "joints": hand.joint_names,
        "fingers": [_finger_fields(hand, finger, u) for finger in hand.fingers],
        "posture_name": hand.actuator_names,
        "posture": u,
        "transmission": hand.transmission.jacobian(u).ravel(),
        "offset": hand.transmission.joints(u),
        "missing": [f"finger '{f.name}' has no fingertip" for f in hand.fingers if f.tip is None],
        "urdf": hand.urdf.text,
    }


def _finger_fields(hand: Hand, finger: Finger, u: FloatArray) -> dict[str, Any]:
    pose = jacobian = np.empty(0)
    if finger.tip is not None:
        pose, jacobian = tip_pose_and_jacobian(hand, finger.tip, u)
    return {
        "name": finger.name,
        "base": finger.base,
        "tip": finger.tip or "",
        "links": finger.links,
        "actuators": finger.actuators,
        "tip_pose": pose.ravel(),
        "jacobian": jacobian.ravel(),
    }


def info_of(fields: Mapping[str, Any]) -> HandInfo:
    """Return the information in the fields of a ``rtee_msgs/HandInfo``.

    Raises:
        MessageError: if an array has another size than the names say.
    """
    n, m = len(fields["actuators"]), len(fields["joints"])
    try:
        return HandInfo(
            name=fields["name"],
            base=fields["base"],
            actuators=tuple(
                ActuatorInfo(**(entry | {"fingers": tuple(entry["fingers"])}))
                for entry in fields["actuators"]
            ),
            joints=tuple(fields["joints"]),
            fingers=tuple(_finger_of(entry, n) for entry in fields["fingers"]),
            posture=fields["posture"].reshape(n),
            joint_positions=fields["offset"].reshape(m),
            transmission=fields["transmission"].reshape(m, n),
            urdf=fields["urdf"],
        )
    except ValueError as error:
        raise MessageError(f"a hand's information does not fit together: {error}") from None


def _finger_of(fields: Mapping[str, Any], n: int) -> FingerInfo:
    pose, jacobian = fields["tip_pose"], fields["jacobian"]
    return FingerInfo(
        name=fields["name"],
        base=fields["base"],
        tip=fields["tip"],
        links=tuple(fields["links"]),
        actuators=tuple(fields["actuators"]),
        tip_pose=pose.reshape(4, 4) if pose.size else None,
        jacobian=jacobian.reshape(6, n) if jacobian.size else None,
    )
