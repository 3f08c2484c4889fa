"""Bounds on the relative motion of links on a straight path of the actuators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from rtee.extract.pairs import LinkPair
from rtee.extract.scene import Scene
from rtee.hand.linalg import dot, matmul, matvec
from rtee.sample import FloatArray
from rtee.types import from_rest

_STATIONS: Final = 33
"""Number of points of a path at which non-linear couplings are evaluated; between these, those of
real hands are nearly linear."""

_SAFETY: Final = 1.5
"""Safety factor on the steepest slope between these points, as it may be steeper in between."""

_NEAR: Final = 0.005
"""Distance within which the motion of points matters [m]: farther points cannot touch between two
checks, which are at most a millimetre of motion apart."""

_UPPER: Final = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=bool)
"""Whether each corner of a box is at the upper end of each axis ``(8, 3)``."""

_sum = np.add.reduce


@dataclass(frozen=True)
class StraightPath:
    """The straight motion of the actuators from rest to a posture.

    Attributes:
        rest: Start ``(n,)`` [rad | m].
        goal: End ``(n,)`` [rad | m].
        travel: Upper bound of each joint's travel per unit of the path ``(m,)`` [rad | m].
    """

    rest: FloatArray
    goal: FloatArray
    travel: FloatArray

    def at(self, t: float) -> FloatArray:
        """Return the posture at intensity ``t``, 0 (rest) to 1 (goal)."""
        return from_rest(self.rest, self.goal, t)


@dataclass(frozen=True, slots=True)
class _Placed:
    """Shapes on their bodies: rotations ``(c, 3, 3)``, positions ``(c, 3)`` [m] and bounding boxes.

    ``low`` and ``high`` are the corners of the boxes ``(c, 3)`` [m].
    """

    rotations: FloatArray
    positions: FloatArray
    low: FloatArray
    high: FloatArray


class Motion:
    """Bounds on the motion of links on straight paths."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._bounds: dict[tuple[str, str], FloatArray] = {}

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self._scene.hand.joints)

    def path_to(self, goal: FloatArray) -> StraightPath:
        """Return the straight path from rest to a posture."""
        hand = self._scene.hand
        # Along a straight path, linear couplings move their joints evenly.
        if hand.transmission.linear:
            travel = np.abs(matvec(hand.transmission.matrix, goal - hand.rest))
        else:
            stations = np.linspace(0.0, 1.0, _STATIONS).tolist()
            q = hand.transmission.joints(
                np.array([from_rest(hand.rest, goal, t) for t in stations])
            )
            # Non-linear followers move unevenly; the steepest part gives the bound.
            travel = _SAFETY * np.abs(np.diff(q, axis=0)).max(axis=0) * (_STATIONS - 1)
        return StraightPath(hand.rest, goal, travel)

    def levers(self, pair: LinkPair) -> FloatArray:
        """Return the largest relative motion of two links per unit of each joint ``(m,)``.

        The values are in metres for revolute joints, 1 for prismatic ones, and 0 for joints that
        move both links or neither.
        """
        if pair.links not in self._bounds:
            self._bounds[pair.links] = self._scene.levers.of(pair.shapes, pair.bodies)
        return self._bounds[pair.links]

    def speed(self, pair: LinkPair, path: StraightPath) -> float:
        """Return a bound on the relative speed of two links per unit of the path [m]."""
        return dot(self.levers(pair), path.travel)

    def travelled(
        self, pair: LinkPair, path: StraightPath, stations: Sequence[float]
    ) -> FloatArray:
        """Return the relative motion of two links at points where they are near each other.

        These are the points of one link's bounding boxes inside the other link's boxes, widened by
        5 mm, at either end of a part of the path. In a box, the corners move farthest.

        Args:
            pair: The links.
            path: The path.
            stations: Intensities, increasing ``(s,)``.

        Returns:
            The sum of the largest displacements up to each station ``(s,)`` [m].
        """
        poses = [self._scene.relative_pose(pair, path.at(t)) for t in stations]
        there = _stacked(poses)
        back = _stacked([pose.inverse() for pose in poses])
        couples = [*product(*pair.shapes)]
        most = self._displacements(couples, there)
        most = np.maximum(most, self._displacements([(j, i) for i, j in couples], back))
        return np.concatenate([[0.0], np.cumsum(most)])

    def _displacements(
        self, couples: Sequence[tuple[int, int]], motion: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        """Return the largest motion ``(s - 1,)`` [m] between stations of points near a shape.

        The points belong to the second shape of a couple, which moves. ``motion`` has the rotations
        ``(s, 3, 3)`` and positions ``(s, 3)`` [m] of its body in that of the fixed shape.
        """
        fixed, moving = (self._placed([couple[k] for couple in couples]) for k in (0, 1))
        inward = fixed.rotations.transpose(0, 2, 1)[:, None]
        rotations = matmul(matmul(inward, motion[0]), moving.rotations[:, None])
        positions = _sum(motion[0] * moving.positions[:, None, None, :], axis=3) + motion[1]
        positions = matmul(positions - fixed.positions[:, None], fixed.rotations)
        # The bounding box of the other shape's box, in the frame of the shape.
        middles, sizes = (fixed.high + fixed.low) / 2.0, (fixed.high - fixed.low) / 2.0 + _NEAR
        centres = _sum(rotations * (middles[:, None] - positions)[..., None], axis=2)
        halves = _sum(np.abs(rotations) * sizes[:, None, :, None], axis=2)
        lower = np.maximum(moving.low[:, None], centres - halves)
        upper = np.minimum(moving.high[:, None], centres + halves)
        near = (lower < upper).all(axis=2)
        most = np.zeros(len(motion[0]) - 1)
        # Usually, few of the shapes come near each other.
        some = near.any(axis=1)
        if not some.any():
            return most
        rotations, positions, near = rotations[some], positions[some], near[some]
        corners = np.where(_UPPER, upper[some][:, :, None], lower[some][:, :, None])
        turns, steps = np.diff(rotations, axis=1), np.diff(positions, axis=1)[:, :, None]
        for ends in (slice(None, -1), slice(1, None)):
            moved = matmul(corners[:, ends], turns.transpose(0, 1, 3, 2)) + steps
            squares = _sum(moved * moved, axis=3).max(axis=2)
            most = np.maximum(most, np.where(near[:, ends], squares, 0.0).max(axis=0))
        result: FloatArray = np.sqrt(most)
        return result

    def _placed(self, shapes: Sequence[int]) -> _Placed:
        chosen = [self._scene.shapes[i] for i in shapes]
        return _Placed(
            np.array([shape.placement.rotation for shape in chosen]),
            np.array([shape.placement.translation for shape in chosen]),
            np.array([shape.box[0] for shape in chosen]),
            np.array([shape.box[1] for shape in chosen]),
        )


class LinkDistanceBounds:
    """Lower bounds on distances of links, from earlier distances and the motion since then."""

    def __init__(self, motion: Motion, pairs: Sequence[LinkPair]) -> None:
        """Start without known distances for these pairs of links."""
        self._levers = np.zeros((len(pairs), motion.joints))
        for levers, pair in zip(self._levers, pairs, strict=True):
            levers[:] = motion.levers(pair)
        self._gaps = np.full(len(pairs), -np.inf)
        self._joints = np.zeros(self._levers.shape)

    def least(self, joints: FloatArray) -> FloatArray:
        """Return a lower bound on each pair's distance ``(p,)`` [m] at joint positions ``(m,)``."""
        # A joint's contribution is at most its travel times its longest lever.
        moved = np.abs(joints - self._joints)
        least: FloatArray = self._gaps - _sum(self._levers * moved, axis=1)
        return least

    def learn(self, pairs: NDArray[np.intp], gaps: Sequence[float], joints: FloatArray) -> None:
        """Store distances [m] of the pairs with these indices, at joint positions ``(m,)``."""
        self._gaps[pairs] = gaps
        # Each pair has its own joint positions, since pairs are measured at different postures.
        self._joints[pairs] = joints


def _stacked(poses: Sequence[pin.SE3]) -> tuple[FloatArray, FloatArray]:
    return np.array([p.rotation for p in poses]), np.array([p.translation for p in poses])
