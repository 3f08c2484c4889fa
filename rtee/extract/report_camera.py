"""Where a picture is taken from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.hand.kinematics import Kinematics
from rtee.hand.model import Hand
from rtee.types import FloatArray

FIELD: Final = math.radians(22.0)
"""Vertical field of view [rad]."""

_AZIMUTH: Final = math.radians(28.0)
_ELEVATION: Final = math.radians(16.0)
_MARGIN: Final = 1.08
_FIRST_PART: Final = 0.3
"""Where fingertips move on this part of the way is where fingers close; later they curl back."""


@dataclass(frozen=True)
class Camera:
    """A perspective camera.

    Attributes:
        position: Where it stands, in the hand's base frame [m].
        right: Unit vector to the right of the picture.
        up: Unit vector to the top of the picture.
        forward: Unit vector into the picture.
        size: Width and height of the picture [pixels].
    """

    position: FloatArray
    right: FloatArray
    up: FloatArray
    forward: FloatArray
    size: tuple[int, int]

    def rays(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return unit directions ``(k, 3)`` through points of the picture [pixels]."""
        width, height = self.size
        scale = 2.0 * math.tan(FIELD / 2) / height
        across = (x - width / 2) * scale
        along = (height / 2 - y) * scale
        rays = self.forward + across[:, None] * self.right + along[:, None] * self.up
        directions: FloatArray = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return directions

    def project(self, points: FloatArray) -> FloatArray:
        """Return where points ``(k, 3)`` [m] are in the picture ``(k, 2)`` [pixels]."""
        width, height = self.size
        scale = height / (2.0 * math.tan(FIELD / 2))
        offset = points - self.position
        depth = np.maximum(offset @ self.forward, 1e-9)
        x = width / 2 + scale * (offset @ self.right) / depth
        y = height / 2 - scale * (offset @ self.up) / depth
        return np.stack([x, y], axis=1)


def fitted(points: FloatArray, back: FloatArray, up: FloatArray, size: tuple[int, int]) -> Camera:
    """Return the camera that sees all points as large as they fit.

    Args:
        points: Points to be seen ``(k, 3)`` [m].
        back: Unit vector from the points towards the camera.
        up: Vector to the top of the picture.
        size: Width and height [pixels].
    """
    forward = -back
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    above = np.cross(right, forward)
    half_y = math.tan(FIELD / 2) / _MARGIN
    half_x = half_y * size[0] / size[1]
    x, y, z = points @ right, points @ above, points @ forward
    # A point (x, y, z) is inside when |x - cx| <= half_x · (z - cz), and so for y.
    cx, depth_x = _between(x, z, half_x)
    cy, depth_y = _between(y, z, half_y)
    cz = min(depth_x, depth_y)
    return Camera(cx * right + cy * above + cz * forward, right, above, forward, size)


def _between(across: FloatArray, depth: FloatArray, half: float) -> tuple[float, float]:
    """Return centre and depth of the apex of the wedge that just holds all points."""
    upper = float((across - half * depth).max())
    lower = float((-across - half * depth).max())
    return (upper - lower) / 2, -(upper + lower) / (2 * half)


def view(hand: Hand, kinematics: Kinematics) -> tuple[FloatArray, FloatArray]:
    """Choose where to look at a hand from: a little to the side of where its fingers close.

    Returns:
        Unit vectors towards the camera and from the palm to the fingertips.
    """
    rest = _tips(hand, kinematics, hand.rest)
    closing = hand.rest + _FIRST_PART * (farthest(hand) - hand.rest)
    closed = _tips(hand, kinematics, closing)
    base = kinematics.link_pose(hand.rest, _palm(hand))[:3, 3]
    up = _unit(rest.mean(axis=0) - base, np.array([0.0, 0.0, 1.0]))
    moves = closed - rest
    moves -= np.outer(moves @ up, up)
    spread = rest - rest.mean(axis=0)
    spread -= np.outer(spread @ up, up)
    total = float(np.linalg.norm(moves, axis=1).sum())
    front = moves.sum(axis=0)
    if total == 0.0 or float(np.linalg.norm(front)) < 0.25 * total:
        widest = np.linalg.svd(np.concatenate([spread, moves]))[2][0]
        front = np.cross(widest - (widest @ up) * up, up)
    front = _unit(front - (front @ up) * up, _perpendicular(up))
    side = np.cross(up, front)
    level = math.cos(_AZIMUTH) * front + math.sin(_AZIMUTH) * side
    return math.cos(_ELEVATION) * level + math.sin(_ELEVATION) * up, up


def farthest(hand: Hand) -> FloatArray:
    """Return the posture with every actuator at its bound farthest from rest."""
    lower = np.where(np.isfinite(hand.lower), hand.lower, hand.rest - 1.0)
    upper = np.where(np.isfinite(hand.upper), hand.upper, hand.rest + 1.0)
    return np.where(upper - hand.rest >= hand.rest - lower, upper, lower)


def _palm(hand: Hand) -> str:
    """Return the deepest link from which all fingers start."""
    paths = [
        [hand.base, *(joint.child for joint in hand.urdf.path_to(finger.base))]
        for finger in hand.fingers
    ]
    palm = hand.base
    for links in zip(*paths, strict=False):
        if len(set(links)) > 1:
            break
        palm = links[0]
    return palm


def _tips(hand: Hand, kinematics: Kinematics, u: FloatArray) -> FloatArray:
    poses = kinematics.placements(u)
    tips = [poses[finger.tip or finger.links[-1]][:3, 3] for finger in hand.fingers]
    return np.array(tips) if tips else np.array([poses[hand.joints[-1].child][:3, 3]])


def _unit(vector: FloatArray, otherwise: FloatArray) -> FloatArray:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-9 else otherwise


def _perpendicular(direction: FloatArray) -> FloatArray:
    axis = np.eye(3)[int(np.argmin(np.abs(direction)))]
    return _unit(np.cross(direction, axis), axis)
