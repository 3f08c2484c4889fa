"""Where links are and how actuators move them, with NumPy alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rtee.hand.model import Hand
from rtee.types import FloatArray


def _rotation(axis: Sequence[float], angle: float) -> FloatArray:
    """Return the rotation about a unit axis (Rodrigues' formula) ``(3, 3)``."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: FloatArray = (
        np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    )
    return rotation


def _pose(rotation: FloatArray, xyz: Sequence[float] | FloatArray) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, xyz
    return pose


def _origin(xyz: Sequence[float], rpy: Sequence[float]) -> FloatArray:
    roll, pitch, yaw = rpy
    rotation = (
        _rotation((0.0, 0.0, 1.0), yaw)
        @ _rotation((0.0, 1.0, 0.0), pitch)
        @ _rotation((1.0, 0.0, 0.0), roll)
    )
    return _pose(rotation, xyz)


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
        pose = pose @ _origin(joint.xyz, joint.rpy)
        if not joint.moving:
            continue
        row, turning = rows[joint.name], joint.kind != "prismatic"
        axis = np.array(joint.axis, dtype=np.float64)
        axes.append((row, pose[:3, :3] @ axis, pose[:3, 3].copy(), turning))
        if turning:
            pose = pose @ _pose(_rotation(joint.axis, float(q[row])), np.zeros(3))
        else:
            pose = pose @ _pose(np.eye(3), float(q[row]) * axis)
    jacobian = np.zeros((6, len(hand.actuators)))
    for row, axis, where, turning in axes:
        column = np.zeros(6)
        if turning:
            column[:3], column[3:] = np.cross(axis, pose[:3, 3] - where), axis
        else:
            column[:3] = axis
        jacobian += np.outer(column, slope[row])
    return pose, jacobian
