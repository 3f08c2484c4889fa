"""Poses of a hand's bodies and shapes at many postures at once.

Planning looks at a hundred postures of each action. Pinocchio computes one at a time, and bringing
its frames into arrays takes longer than computing them; here all are computed in numpy together,
level by level of the tree of joints.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, TypeAlias

import coal
import numpy as np
from numpy.typing import NDArray

from rtee.hand.geometry import HandGeometry
from rtee.sample import FloatArray

_BALL_AXES: Final = np.vstack([np.zeros(3), np.eye(3)])
"""Points of a shape's ball, in units of its radius; the shape moves hardly faster than these."""

Slots: TypeAlias = NDArray[np.intp]
"""Numbers of shapes, pairs or rows."""


@dataclass(slots=True)
class HandPose:
    """Shape poses of a hand at one posture; the same for any number of rows.

    Attributes:
        turns: Their rotations ``(n, 3, 3)`` in the base frame.
        places: Their positions ``(n, 3)`` [m].
        middles: Middles of their bounding balls ``(n, 3)`` [m].
        bodies: Rotations of the bodies that carry them ``(n, 3, 3)``.
    """

    turns: FloatArray
    places: FloatArray
    middles: FloatArray
    bodies: FloatArray
    _transforms: dict[int, coal.Transform3s] = field(default_factory=dict, repr=False)

    def where(self, slot: int) -> coal.Transform3s:
        """Return a shape's pose for Coal."""
        shape = slot % len(self.places)
        # Cached: one posture is compared with many poses of the object.
        if shape not in self._transforms:
            self._transforms[shape] = coal.Transform3s(self.turns[shape], self.places[shape])
        return self._transforms[shape]

    def carried(self, slots: Slots) -> tuple[FloatArray, FloatArray]:
        """Return rotations ``(k, 3, 3)`` of the bodies of some shapes, and middles ``(k, 3)``."""
        shapes = slots % len(self.places)
        return self.bodies[shapes], self.middles[shapes]


class HandPoses:
    """Poses of a hand's shapes at several postures, computed lazily.

    There is one posture in each row; a slot is the number of a shape in an array
    ``(rows, shapes)``.
    """

    def __init__(self, postures: Postures, frames: FloatArray) -> None:
        self._postures, self._frames = postures, frames
        self._transforms: list[dict[int, coal.Transform3s]] = [{} for _ in frames]
        """Poses of shapes for Coal, and of bodies by their complements, which are negative."""

    def put(self, rows: Slots, frames: FloatArray) -> None:
        """Replace some postures by others ``(len(rows), m + 1, 4, 4)``."""
        self._frames[rows] = frames
        for row in rows.tolist():
            self._transforms[row].clear()

    def one(self, row: int) -> HandPose:
        """Return the poses of all shapes at one posture."""
        return self._postures.posed(self._frames[row])

    def where(self, slot: int) -> coal.Transform3s:
        """Return a shape's pose for Coal."""
        row, shape = divmod(slot, len(self._postures.body))
        known, body = self._transforms[row], ~self._postures.body[shape]
        found = known.get(shape)
        if found is None:
            # The body's pose is kept, too: several of its shapes are near the object, or none is.
            carrier = known.get(body)
            if carrier is None:
                frame = self._frames[row, ~body]
                carrier = known[body] = coal.Transform3s(frame[:3, :3], frame[:3, 3])
            found = known[shape] = carrier * self._postures.placements[shape]
        return found

    def carried(self, slots: Slots) -> tuple[FloatArray, FloatArray]:
        """Return rotations ``(k, 3, 3)`` of the bodies of some shapes, and middles ``(k, 3)``."""
        rows, shapes = np.divmod(slots, len(self._postures.radii))
        mine = self._frames[rows, self._postures.bodies[shapes]]
        turns: FloatArray = mine[:, :3, :3]
        middles = (turns @ self._postures.middles[shapes, :, None])[:, :, 0] + mine[:, :3, 3]
        return turns, middles


class Postures:
    """Computes the poses of a hand's shapes.

    Attributes:
        radii: Radii of the shapes' bounding balls ``(n,)`` [m].
        halves: Half extents of their bounding boxes, along their own axes ``(n, 3)`` [m].
        carried: Per shape, which joints move it: 1 or 0 ``(n, m)``.
        body: Per shape, its body; `bodies` has the same as an array ``(n,)``.
        bodies: The bodies.
        placements: Poses of the shapes in their bodies' frames, for Coal.
        middles: Middles of their bounding balls in the bodies' frames ``(n, 3)`` [m].
    """

    def __init__(self, geometry: HandGeometry) -> None:
        kinematics, shapes = geometry.kinematics, geometry.shapes
        self._joints = kinematics.hand.transmission.joints
        hand, model = kinematics.hand, kinematics.model
        joints = [hand.urdf.joints[name] for name in hand.joint_names]
        self._placed = np.tile(np.eye(4), (len(joints), 1, 1))
        """Poses of the joints in the frames of their parents ``(m, 4, 4)``, at position 0."""
        basis = np.zeros((len(joints), 3, 4, 4))
        levels: dict[int, list[int]] = {}
        for index, joint in enumerate(joints):
            placement = model.jointPlacements[index + 1]
            self._placed[index] = placement.homogeneous
            turn, (x, y, z) = placement.rotation, joint.axis
            if joint.kind == "prismatic":
                basis[index, 2, :3, 3] = turn @ np.array(joint.axis)
            else:  # Rodrigues' formula: 1 + sin q K + (1 - cos q) K²
                cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
                basis[index, 0, :3, :3] = turn @ cross
                basis[index, 1, :3, :3] = turn @ cross @ cross
            # A joint's supports are the joints between the base and it, itself and the universe.
            levels.setdefault(len(model.supports[index + 1]), []).append(index + 1)
        self._basis = basis.reshape(-1, 3, 16)
        """Terms that sine, 1 - cosine and position add to it, row after row."""
        self._levels = [
            (np.array(bodies), np.array([model.parents[body] for body in bodies]))
            for _, bodies in sorted(levels.items())
        ]
        self.body = [shape.body for shape in shapes]
        self.bodies = np.array(self.body, dtype=np.intp)
        self._turns = np.array([shape.placement.rotation for shape in shapes]).reshape(-1, 3, 3)
        places = np.array([shape.placement.translation for shape in shapes]).reshape(-1, 3)
        balls = np.array([shape.ball[0] for shape in shapes]).reshape(-1, 3)
        self.placements = [coal.Transform3s(t, p) for t, p in zip(self._turns, places, strict=True)]
        self.middles: FloatArray = places + np.einsum("nij,nj->ni", self._turns, balls)
        self._points = np.stack([places, self.middles], axis=2)
        """Origins of the shapes and middles of their balls in the bodies' frames ``(n, 3, 2)``."""
        self.radii = np.array([shape.ball[1] for shape in shapes])
        boxes = np.array([shape.box for shape in shapes]).reshape(-1, 2, 3)
        self.halves = 0.5 * (boxes[:, 1] - boxes[:, 0])
        self.carried = np.array([kinematics.support(shape.body) for shape in shapes])

    def frames(self, u: FloatArray) -> FloatArray:
        """Return poses of the bodies, base first ``(k, m + 1, 4, 4)``, at positions ``(k, n)``."""
        q = self._joints(u).T
        turned = np.stack([np.sin(q), 1.0 - np.cos(q), q], axis=2)
        moved = (turned @ self._basis).reshape(*q.shape, 4, 4)
        moved += self._placed[:, None]
        moved = moved.swapaxes(0, 1)
        found = np.empty((len(u), len(self._placed) + 1, 4, 4))
        found[:, 0] = np.eye(4)
        for bodies, parents in self._levels:
            found[:, bodies] = found[:, parents] @ moved[:, bodies - 1]
        return found

    def posed(self, frames: FloatArray) -> HandPose:
        """Return the poses of the shapes for poses of the bodies ``(m + 1, 4, 4)``."""
        mine = frames[self.bodies]
        turns = mine[:, :3, :3]
        points = turns @ self._points + mine[:, :3, 3:]
        return HandPose(turns @ self._turns, points[:, :, 0], points[:, :, 1], turns)

    def farthest_steps(self, frames: FloatArray) -> FloatArray:
        """Return the longest travel of any point of each shape in a single step ``(n,)`` [m].

        Args:
            frames: Poses of the bodies at postures near each other ``(k, m + 1, 4, 4)``.
        """
        mine = frames[:, self.bodies]
        turns = mine[..., :3, :3] @ self._turns
        middles = mine[..., :3, :3] @ self._points[:, :, 1:] + mine[..., :3, 3:]
        reach = self.radii[:, None, None] * _BALL_AXES
        moved = middles[..., None, :, 0] + reach @ turns.swapaxes(-1, -2)
        found: FloatArray = np.linalg.norm(np.diff(moved, axis=0), axis=3).max(axis=(0, 2))
        return found
