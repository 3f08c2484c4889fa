"""The description of a hand for grasp planners: limits, tip poses, Jacobians, transmission.

It is computed with NumPy alone, so that a robot PC needs no kinematics library. The Jacobian of a
fingertip maps actuator velocities to the linear velocity of the tip link's origin (first three
rows) and the link's angular velocity (last three rows), both in the hand's base frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rtee.errors import GoalRejected, MessageError
from rtee.hand.frames import tip_pose_and_jacobian
from rtee.hand.model import Finger, Hand
from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, JointKind
from rtee.values import Value


def _full_posture(hand: Hand, positions: Mapping[str, float]) -> FloatArray:
    """Return actuator positions ``(n,)``: the given ones, and rest positions for the others.

    Raises `GoalRejected` if a value is not finite or outside the limits, `UnknownActuator` if there
    is no such actuator.
    """
    u = np.array(hand.rest)
    for name, value in positions.items():
        spec = hand.actuator(name)
        # Clients may round the limits to a few digits.
        if not spec.lower - 1e-6 <= value <= spec.upper + 1e-6:
            raise GoalRejected(
                f"the position {value:g} of '{name}' is outside its limits "
                f"{spec.lower:g} to {spec.upper:g}"
            )
        u[hand.actuator_index(name)] = value
    return u


@dataclass(frozen=True, slots=True)
class ActuatorInfo(ActuatorSpec):
    """An actuator, with what the hand's dynamics say of its servo.

    Attributes:
        stiffness: Position gain of its servo [N·m/rad | N/m], as hand.yaml gives it under
            ``dynamics``; NaN: not known.
    """

    stiffness: float = math.nan


@dataclass(frozen=True, slots=True)
class FingerInfo(Value):
    """A finger at a posture.

    Attributes:
        name: Its name.
        base: First link of the chain.
        tip: The fingertip's link; empty if it has none.
        links: Links from base to end.
        actuators: Actuators that move the tip, nearest the palm first.
        tip_pose: Pose of the tip's link in the hand's base frame ``(4, 4)``; ``None``: no tip.
        jacobian: Jacobian of the tip by the actuators, linear part first ``(6, n)``; ``None``: no
            tip.
        friction: Coefficient of friction of the tip's surface, as hand.yaml or the URDF gives it;
            NaN: not known.
    """

    name: str
    base: str
    tip: str
    links: tuple[str, ...]
    actuators: tuple[str, ...]
    tip_pose: FloatArray | None
    jacobian: FloatArray | None
    friction: float


@dataclass(frozen=True, slots=True)
class HandInfo(Value):
    """The description of a hand at a posture, for grasp planners.

    Attributes:
        name: Its name.
        base: Root link: the frame of all poses.
        actuators: The actuators, in order.
        joints: Names of all moving joints.
        fingers: The fingers.
        posture: Actuator positions ``(n,)`` of the poses and Jacobians [rad | m].
        joint_positions: Joint positions at that posture ``(m,)`` [rad | m].
        transmission: Derivative of joint positions by actuator positions there ``(m, n)``.
        urdf: Text of the URDF.
        missing: Unknown properties, one sentence each.
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
    missing: tuple[str, ...] = ()

    @property
    def actuator_names(self) -> tuple[str, ...]:
        """Names of the actuators, in order."""
        return tuple(actuator.name for actuator in self.actuators)


def info_fields(hand: Hand, positions: Mapping[str, float]) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/HandInfo``; `UserError` if the posture does not fit."""
    u = _full_posture(hand, positions)
    return {
        "name": hand.name,
        "base": hand.base,
        "actuators": [
            asdict(actuator) | {"stiffness": _stiffness(hand, actuator.name)}
            for actuator in hand.actuators
        ],
        "joints": hand.joint_names,
        "fingers": [_finger_fields(hand, finger, u) for finger in hand.fingers],
        "posture_name": hand.actuator_names,
        "posture": u,
        # Messages have flat arrays only; `info_of` gives them their shapes again.
        "transmission": hand.transmission.jacobian(u).ravel(),
        "offset": hand.transmission.joints(u),
        "missing": list(_missing(hand)),
        "urdf": hand.urdf.text,
    }


def _stiffness(hand: Hand, actuator: str) -> float:
    known = hand.dynamics.get(actuator)
    return math.nan if known is None or known.kp is None else known.kp


def _missing(hand: Hand) -> Iterator[str]:
    """Yield one sentence for each unknown property of a hand."""
    for finger in hand.fingers:
        if finger.tip is None:
            yield f"finger '{finger.name}' has no fingertip"
    stiff = [name for name in hand.actuator_names if math.isnan(_stiffness(hand, name))]
    tips = [f.name for f in hand.fingers if f.tip is not None and f.name not in hand.tip_friction]
    if stiff:
        yield f"the stiffness of {_named(stiff, hand.actuator_names, 'actuators')} is not known"
    if tips:
        fingers = _named(tips, hand.finger_names, "fingers")
        yield f"the friction of the tips of {fingers} is not known"


def _named(some: Sequence[str], whole: Sequence[str], plural: str) -> str:
    return f"all {plural}" if len(some) == len(whole) > 1 else ", ".join(some)


def _finger_fields(hand: Hand, finger: Finger, u: FloatArray) -> dict[str, Any]:
    # Messages have no optional arrays: without a fingertip they are empty.
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
        "friction": hand.tip_friction.get(finger.name, math.nan),
    }


def info_of(fields: Mapping[str, Any]) -> HandInfo:
    """Return the description in the fields of a ``rtee_msgs/HandInfo``.

    Raises `MessageError` if the size of an array does not match the names.
    """
    n, m = len(fields["actuators"]), len(fields["joints"])
    try:
        return HandInfo(
            name=fields["name"],
            base=fields["base"],
            actuators=tuple(
                ActuatorInfo(
                    **(each | {"kind": JointKind(each["kind"]), "fingers": tuple(each["fingers"])})
                )
                for each in fields["actuators"]
            ),
            joints=tuple(fields["joints"]),
            fingers=tuple(_finger_of(entry, n) for entry in fields["fingers"]),
            posture=fields["posture"].reshape(n),
            joint_positions=fields["offset"].reshape(m),
            transmission=fields["transmission"].reshape(m, n),
            urdf=fields["urdf"],
            missing=tuple(fields["missing"]),
        )
    # `reshape` raises it where sizes disagree.
    except ValueError as error:
        raise MessageError(f"the hand's information is not consistent: {error}") from None


def _finger_of(fields: Mapping[str, Any], n: int) -> FingerInfo:
    pose, jacobian = fields["tip_pose"], fields["jacobian"]
    held: dict[str, Any] = {
        "links": tuple(fields["links"]),
        "actuators": tuple(fields["actuators"]),
        "tip_pose": pose.reshape(4, 4) if pose.size else None,
        "jacobian": jacobian.reshape(6, n) if jacobian.size else None,
    }
    return FingerInfo(**{**fields, **held})
