"""Choice of the camera's pose and field of view for a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.hand.geometry import HandGeometry
from rtee.hand.model import Hand
from rtee.sample import FloatArray

FIELD: Final = math.radians(22.0)
"""Vertical field of view [rad]: that of a long lens, which hardly distorts fingers."""

_AZIMUTH: Final = math.radians(28.0)
"""Angle of the camera to the side, so that fingers hide one another less [rad]."""
_ELEVATION: Final = math.radians(16.0)
"""Angle of the camera above the horizontal, which shows depth [rad]."""
_MARGIN: Final = 1.08
"""Size of the picture relative to its content, which leaves a narrow margin."""
_FIRST_PART: Final = 0.3
"""Share of the travel over which tips show the direction of closing; later, they curl back."""
_SNAP: Final = math.radians(35.0)
"""Largest angle between a hand and an axis of its base for an upright view [rad]."""
_ONE_WAY: Final = 0.45
"""Ratio of the tips' mean motion to the mean length of their motions, below which fingers close
towards one another."""


@dataclass(frozen=True)
class Camera:
    """A perspective camera.

    Attributes:
        position: Position in the hand's base frame [m].
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
        """Return the positions of points ``(k, 3)`` [m] in the picture ``(k, 2)`` [pixels]."""
        width, height = self.size
        scale = height / (2.0 * math.tan(FIELD / 2))
        offset = points - self.position
        # A minimum depth keeps points behind the camera from being mirrored into the picture.
        depth = np.maximum(offset @ self.forward, 1e-9)
        x = width / 2 + scale * (offset @ self.right) / depth
        y = height / 2 - scale * (offset @ self.up) / depth
        return np.stack([x, y], axis=1)


def fit_camera(
    points: FloatArray, back: FloatArray, up: FloatArray, size: tuple[int, int]
) -> Camera:
    """Return the closest camera that sees all points.

    Args:
        points: The points ``(k, 3)`` [m].
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
    # A point (x, y, z) is inside if |x - cx| <= half_x · (z - cz), and likewise for y.
    # The tighter of the two directions decides how far away the camera must be.
    cx, depth_x = _between(x, z, half_x)
    cy, depth_y = _between(y, z, half_y)
    cz = min(depth_x, depth_y)
    return Camera(cx * right + cy * above + cz * forward, right, above, forward, size)


def _between(across: FloatArray, depth: FloatArray, half: float) -> tuple[float, float]:
    """Return the centre and depth of the apex of the smallest wedge that contains all points."""
    upper = float((across - half * depth).max())
    lower = float((-across - half * depth).max())
    return (upper - lower) / 2, -(upper + lower) / (2 * half)


def choose_view(geometry: HandGeometry) -> tuple[FloatArray, FloatArray]:
    """Return the direction of view that shows well how a hand closes.

    If all fingers close in the same direction, as in a human hand, the camera is on that side; if
    they close towards one another, it is beside them. In both cases, it is slightly turned to the
    side and raised.

    Returns:
        Unit vectors towards the camera and from the palm to the fingertips.
    """
    hand = geometry.hand
    rest = _tips(geometry, hand.rest)
    moves = _tips(geometry, hand.rest + _FIRST_PART * (farthest(hand) - hand.rest)) - rest
    base = geometry.kinematics.link_pose(_palm(hand), hand.rest)[:3, 3]
    up = _snapped(_unit(rest.mean(axis=0) - base, np.array([0.0, 0.0, 1.0])))
    moves -= np.outer(moves @ up, up)  # only the motion across the fingers matters
    total = float(np.linalg.norm(moves, axis=1).sum())
    front = moves.sum(axis=0)
    if len(rest) < 3 or float(np.linalg.norm(front)) < _ONE_WAY * total or total == 0.0:
        # The fingers close towards one another: look across their motion.
        spread = rest - rest.mean(axis=0)
        widest = np.linalg.svd(np.concatenate([spread - np.outer(spread @ up, up), moves]))[2][0]
        front = np.cross(widest, up)
        if float(spread[0] @ np.cross(up, front)) > 0:
            front = -front  # so that the first finger is on the left
    front = _unit(front - (front @ up) * up, _perpendicular(up))
    side = np.cross(up, front)
    level = math.cos(_AZIMUTH) * front + math.sin(_AZIMUTH) * side
    return math.cos(_ELEVATION) * level + math.sin(_ELEVATION) * up, up


def farthest(hand: Hand) -> FloatArray:
    """Return the posture with each actuator at its bound farthest from rest."""
    bounds = np.array([actuator.farthest for actuator in hand.actuators])
    # A continuous actuator has no bound; one radian shows the direction of its motion.
    return np.where(np.isfinite(bounds), bounds, hand.rest + 1.0)


def _palm(hand: Hand) -> str:
    """Return the deepest link from which all fingers start."""
    paths = [hand.urdf.links_to(finger.base) for finger in hand.fingers]
    palm = hand.base
    for links in zip(*paths, strict=False):
        if len(set(links)) > 1:
            break
        palm = links[0]
    return palm


def _tips(geometry: HandGeometry, u: FloatArray) -> FloatArray:
    """Return the centre of each fingertip's geometry ``(f, 3)`` [m]."""
    poses = geometry.kinematics.placements(u)
    middles = []
    for finger in geometry.hand.fingers:
        link = finger.tip or finger.links[-1]
        vertices, _ = geometry.triangles(link)
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2 if len(vertices) else np.zeros(3)
        middles.append(poses[link][:3, :3] @ middle + poses[link][:3, 3])
    return np.array(middles or [poses[geometry.hand.joints[-1].child][:3, 3]])


def _snapped(direction: FloatArray) -> FloatArray:
    """Return the axis of the base frame near a direction, or the direction if none is near."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < math.cos(_SNAP):
        return direction
    snapped = np.zeros(3)
    snapped[axis] = math.copysign(1.0, direction[axis])
    return snapped


def _unit(vector: FloatArray, otherwise: FloatArray) -> FloatArray:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-9 else otherwise


def _perpendicular(direction: FloatArray) -> FloatArray:
    axis = np.eye(3)[int(np.argmin(np.abs(direction)))]
    return _unit(np.cross(direction, axis), axis)
