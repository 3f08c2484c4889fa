"""Where the bodies and shapes of a hand are, at many postures at once.

Planning looks at a hundred postures of each action. Pinocchio computes one at a time, and bringing
its frames into arrays takes longer than computing them; here all are computed in numpy together,
level by level of the tree of joints.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import coal
import numpy as np

from rtee.hand.geometry import HandGeometry
from rtee.sample import FloatArray

_BALL_AXES: Final = np.vstack([np.zeros(3), np.eye(3)])
"""A shape moves no faster than these points of its ball, in units of the radius, nearly."""


@dataclass(slots=True)
class HandPose:
    """Where the shapes of a hand are at a posture.

    Attributes:
        turns: Their rotations ``(n, 3, 3)`` in the base frame.
        places: Their positions ``(n, 3)`` [m].
        middles: Middles of their bounding balls ``(n, 3)`` [m].
    """

    turns: FloatArray
    places: FloatArray
    middles: FloatArray
    _transforms: dict[int, coal.Transform3s] = field(default_factory=dict, repr=False)

    def where(self, shape: int) -> coal.Transform3s:
        """Return a shape's pose for Coal."""
        # Kept, since one posture is compared with many poses of the object.
        if shape not in self._transforms:
            self._transforms[shape] = coal.Transform3s(self.turns[shape], self.places[shape])
        return self._transforms[shape]


class Postures:
    """Computes where the shapes of a hand are.

    Args:
        geometry: The hand's geometry.

    Attributes:
        radii: Radii of the shapes' bounding balls ``(n,)`` [m].
        halves: Half extents of their bounding boxes, along their own axes ``(n, 3)`` [m].
        carried: Per shape, which joints move it: 1 or 0 ``(n, m)``.
    """

    def __init__(self, geometry: HandGeometry) -> None:
        kinematics, shapes = geometry.kinematics, geometry.shapes
        self._joints = kinematics.hand.transmission.joints
        hand, model = kinematics.hand, kinematics.model
        joints = [hand.urdf.joints[name] for name in hand.joint_names]
        self._placed = np.tile(np.eye(4), (len(joints), 1, 1))
        """Poses of the joints in the frames of their parents ``(m, 4, 4)``, at position 0."""
        self._once, self._twice, self._along = (np.zeros((len(joints), 4, 4)) for _ in range(3))
        levels: dict[int, list[int]] = {}
        for index, joint in enumerate(joints):
            placement = model.jointPlacements[index + 1]
            self._placed[index] = placement.homogeneous
            turn, (x, y, z) = placement.rotation, joint.axis
            if joint.kind == "prismatic":
                self._along[index, :3, 3] = turn @ np.array(joint.axis)
            else:  # Rodrigues' formula: 1 + sin q K + (1 - cos q) K²
                cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
                self._once[index, :3, :3] = turn @ cross
                self._twice[index, :3, :3] = turn @ cross @ cross
            # A joint's supports are those on its way from the base, itself and the universe.
            levels.setdefault(len(model.supports[index + 1]), []).append(index + 1)
        self._levels = [
            (np.array(bodies), np.array([model.parents[body] for body in bodies]))
            for _, bodies in sorted(levels.items())
        ]
        self._bodies = np.array([shape.body for shape in shapes], dtype=np.int64)
        self._turns = np.array([shape.placement.rotation for shape in shapes]).reshape(-1, 3, 3)
        places = np.array([shape.placement.translation for shape in shapes]).reshape(-1, 3)
        balls = np.array([shape.ball[0] for shape in shapes]).reshape(-1, 3)
        middles = places + np.einsum("nij,nj->ni", self._turns, balls)
        self._points = np.stack([places, middles], axis=2)
        """Origins of the shapes and middles of their balls in the bodies' frames ``(n, 3, 2)``."""
        self.radii = np.array([shape.ball[1] for shape in shapes])
        boxes = np.array([shape.box for shape in shapes]).reshape(-1, 2, 3)
        self.halves = 0.5 * (boxes[:, 1] - boxes[:, 0])
        self.carried = np.array([kinematics.support(shape.body) for shape in shapes])

    def frames(self, u: FloatArray) -> FloatArray:
        """Return the poses of the bodies, the base first ``(k, m + 1, 4, 4)``.

        Args:
            u: Actuator positions ``(k, n)`` [rad | m].
        """
        q = self._joints(u)[:, :, None, None]
        moved = (
            self._placed
            + np.sin(q) * self._once
            + (1.0 - np.cos(q)) * self._twice
            + q * self._along
        )
        found = np.empty((len(u), len(self._placed) + 1, 4, 4))
        found[:, 0] = np.eye(4)
        for bodies, parents in self._levels:
            found[:, bodies] = found[:, parents] @ moved[:, bodies - 1]
        return found

    def posed(self, frames: FloatArray) -> HandPose:
        """Return where the shapes are at the poses of the bodies ``(m + 1, 4, 4)``."""
        mine = frames[self._bodies]
        turns = mine[:, :3, :3]
        points = turns @ self._points + mine[:, :3, 3:]
        return HandPose(turns @ self._turns, points[:, :, 0], points[:, :, 1])

    def farthest_steps(self, frames: FloatArray) -> FloatArray:
        """Return how far points of the shapes go at most in one of the steps ``(n,)`` [m].

        Args:
            frames: Poses of the bodies at postures near each other ``(k, m + 1, 4, 4)``.
        """
        mine = frames[:, self._bodies]
        turns = mine[..., :3, :3] @ self._turns
        middles = mine[..., :3, :3] @ self._points[:, :, 1:] + mine[..., :3, 3:]
        reach = self.radii[:, None, None] * _BALL_AXES
        moved = middles[..., None, :, 0] + reach @ turns.swapaxes(-1, -2)
        found: FloatArray = np.linalg.norm(np.diff(moved, axis=0), axis=3).max(axis=(0, 2))
        return found
