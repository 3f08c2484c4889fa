"""Forward kinematics with NumPy alone, for computers without Pinocchio."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from rtee.hand.config_schema import FlangeSection
from rtee.hand.model import Hand
from rtee.hand.urdf import Triple
from rtee.objects.description import BASE_POSE, OBJECT_POSE
from rtee.sample import FloatArray

PARALLEL: Final = 0.9
"""Least cosine of the angle between parallel axes: 26 degrees."""

_LEVEL: Final = 1e-9
"""Cosine of the pitch below which it counts as a quarter turn: roll and yaw then share an axis."""


def rotation(axis: Sequence[float], angle: float) -> FloatArray:
    """Return the rotation by ``angle`` [rad] about a unit axis ``(3, 3)`` (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: FloatArray = (
        np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    )
    return matrix


def homogeneous(turned: FloatArray, xyz: Sequence[float] | FloatArray) -> FloatArray:
    """Return the transform ``(4, 4)`` with a rotation ``(3, 3)`` and a position [m]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turned, xyz
    return pose


def origin(xyz: Triple, rpy: Triple) -> FloatArray:
    """Return the transform ``(4, 4)`` of a URDF ``origin``: position [m], then angles [rad]."""
    roll, pitch, yaw = rpy
    turned = (
        rotation((0.0, 0.0, 1.0), yaw)
        @ rotation((0.0, 1.0, 0.0), pitch)
        @ rotation((1.0, 0.0, 0.0), roll)
    )
    return homogeneous(turned, xyz)


def angles(turn: FloatArray) -> Triple:
    """Return roll, pitch and yaw about fixed axes [rad] of a rotation matrix ``(3, 3)``."""
    level = math.hypot(turn[0, 0], turn[1, 0])
    # From sine and cosine, as an arcsine would lose half of the digits near a quarter turn.
    pitch = math.atan2(-turn[2, 0], level)
    yaw = math.atan2(turn[1, 0], turn[0, 0]) if level > _LEVEL else 0.0
    # From the chosen yaw, since near a pitch of 90° only the sum of both is well-defined.
    s, c = math.sin(yaw), math.cos(yaw)
    roll = math.atan2(s * turn[0, 2] - c * turn[1, 2], c * turn[1, 1] - s * turn[0, 1])
    return roll, pitch, yaw


def quaternion(rpy: Triple) -> FloatArray:
    """Return the unit quaternion (w, x, y, z) of roll, pitch, yaw about fixed axes [rad]."""
    (cr, cp, cy), (sr, sp, sy) = (
        tuple(math.cos(0.5 * a) for a in rpy),
        tuple(math.sin(0.5 * a) for a in rpy),
    )
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def turn(axis: FloatArray, angle: float) -> FloatArray:
    """Return the quaternion (w, x, y, z) of a rotation by ``angle`` [rad] about a unit axis."""
    half = 0.5 * angle
    return np.concatenate(([math.cos(half)], math.sin(half) * axis))


def pose_matrix(pose: FloatArray) -> FloatArray:
    """Return the transform ``(4, 4)`` of a position [m] and a quaternion (w, x, y, z) ``(7,)``."""
    # The quaternion may be rounded, and the matrix of one that is not of unit length would scale.
    w, x, y, z = pose[3:] / np.linalg.norm(pose[3:])
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return homogeneous(np.eye(3) + 2.0 * (w * cross + cross @ cross), pose[:3])


def relative_pose(base: FloatArray, pose: FloatArray) -> FloatArray:
    """Return ``pose`` relative to ``base``; each a position [m] and a quaternion ``(7,)``."""
    w, x, y, z = base[3:] / np.linalg.norm(base[3:])
    # The matrix of left multiplication by the conjugate of the quaternion of `base`.
    back = np.array([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    position = pose_matrix(base)[:3, :3].T @ (pose[:3] - base[:3])
    return np.concatenate((position, back @ pose[3:]))


def pose_in_hand(channels: Mapping[str, FloatArray]) -> FloatArray | None:
    """Return the pose ``(7,)`` of a simulated object in the hand's base frame, if it is known.

    Args:
        channels: The further channels of a state by name, without the prefix of the device.
    """
    pose, base = channels.get(OBJECT_POSE), channels.get(BASE_POSE)
    if pose is None or not _is_pose(pose):
        return None
    if base is None:
        return pose
    return relative_pose(base, pose) if _is_pose(base) else None


def _is_pose(values: FloatArray) -> bool:
    """Return whether a channel is a valid pose; it may come from another program, or a file."""
    return len(values) == 7 and bool(np.isfinite(values).all()) and bool(values[3:].any())


def joint_motion(kind: str, axis: Triple, q: float) -> FloatArray:
    """Return the transform ``(4, 4)`` of a joint at position ``q`` [rad | m], in its frame."""
    if kind == "prismatic":
        return homogeneous(np.eye(3), q * np.array(axis, dtype=np.float64))
    return homogeneous(rotation(axis, q), np.zeros(3))


def tip_pose_and_jacobian(hand: Hand, link: str, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the pose and the Jacobian of a link at actuator positions ``(n,)`` [rad | m].

    Returns:
        Its pose in the hand's base frame ``(4, 4)``, and its Jacobian by the actuator positions
        ``(6, n)``: linear velocity above angular velocity.
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
        # After storing the axis, which the joint's motion does not change.
        pose = pose @ joint_motion(joint.kind, joint.axis, float(q[row]))
    jacobian = np.zeros((6, len(hand.actuators)))
    for row, axis, where, turning in axes:
        column = np.zeros(6)
        if turning:
            # The lever arm from the axis to the final position of the link.
            column[:3], column[3:] = np.cross(axis, pose[:3, 3] - where), axis
        else:
            column[:3] = axis
        jacobian += np.outer(column, slope[row])
    return pose, jacobian


class JointFrames:
    """The poses of the child links of joints in their parent links.

    A revolute joint rotates its child link, a prismatic one translates it. Both are linear in a few
    numbers per joint, so that NumPy computes all joints at once.

    Attributes:
        moving: Parent and child link of every moving joint, in the order of ``hand.joints``.
        fixed: Parent and child link of every fixed joint.
        still: Poses of the child links of the fixed joints, as `at` returns them.
    """

    def __init__(self, hand: Hand) -> None:
        joints = hand.urdf.joints
        driven = [joints[name] for name in hand.joint_names]
        still = [joint for joint in joints.values() if not joint.moving]
        self.moving = tuple((joint.parent, joint.child) for joint in driven)
        self.fixed = tuple((joint.parent, joint.child) for joint in still)
        self.still = (
            np.array([joint.xyz for joint in still]).reshape(-1, 3),
            _last_first(np.array([quaternion(joint.rpy) for joint in still]).reshape(-1, 4)),
        )
        begin = np.array([quaternion(joint.rpy) for joint in driven]).reshape(-1, 4)
        axes = np.array([joint.axis for joint in driven]).reshape(-1, 3)
        slides = np.array([joint.kind == "prismatic" for joint in driven], dtype=bool)
        # 0 for a prismatic joint, which keeps its orientation in the formula below.
        self._half = np.where(slides, 0.0, 0.5)
        # The quaternion product of the orientation at 0 and a rotation by q about the axis is
        # cos(q/2) · begin + sin(q/2) · (begin × axis).
        self._begin = _last_first(begin)
        self._across = _last_first(_times_axis(begin, axes))
        self._xyz = np.array([joint.xyz for joint in driven]).reshape(-1, 3)
        along = [origin(joint.xyz, joint.rpy)[:3, :3] @ np.array(joint.axis) for joint in driven]
        self._along = np.where(slides[:, None], np.array(along).reshape(-1, 3), 0.0)

    def at(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the poses of the links of the moving joints at positions ``(m,)`` [rad | m].

        Returns:
            Positions ``(m, 3)`` [m] and unit quaternions (x, y, z, w) ``(m, 4)``.
        """
        half = self._half * q
        turned = np.cos(half)[:, None] * self._begin + np.sin(half)[:, None] * self._across
        return self._xyz + q[:, None] * self._along, turned


def _last_first(wxyz: FloatArray) -> FloatArray:
    """Return quaternions (w, x, y, z) as (x, y, z, w)."""
    return np.ascontiguousarray(np.roll(wxyz, -1, axis=1))


def _times_axis(wxyz: FloatArray, axes: FloatArray) -> FloatArray:
    """Return the products ``(n, 4)`` of quaternions (w, x, y, z) and pure ones (0, axis)."""
    w, v = wxyz[:, :1], wxyz[:, 1:]
    return np.hstack([-np.sum(v * axes, axis=1, keepdims=True), w * axes + np.cross(v, axes)])


def base_in_flange(flange: FlangeSection) -> FloatArray:
    """Return the pose ``(4, 4)`` of the hand's base frame in that of the flange [m]."""
    return origin(flange.xyz, flange.rpy)


def flange_with(flange: FlangeSection, base: FloatArray) -> FloatArray:
    """Return the pose ``(4, 4)`` of the flange when the hand's base has a pose, in its frame."""
    return base @ np.linalg.inv(base_in_flange(flange))
