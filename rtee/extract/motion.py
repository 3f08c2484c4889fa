"""Bounds on the relative motion of links on a straight path of the actuators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Final, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from rtee.extract.pairs import LinkPair
from rtee.extract.scene import Scene
from rtee.hand.linalg import applied, composed, dot, inner, matvec
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

_UPPER: Final = np.array([*product((False, True), repeat=3)]).T[:, :, None, None]
"""Whether each corner of a box is at the upper end of each axis ``(3, 8, 1, 1)``."""

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


class _Placed(NamedTuple):
    """Shapes on their bodies: rotations ``(3, 3, c)``, positions ``(3, c)`` [m] and bounding boxes.

    ``low`` and ``high`` are the corners of the boxes ``(3, c)`` [m].
    """

    rotations: FloatArray
    positions: FloatArray
    low: FloatArray
    high: FloatArray


class MotionBounds:
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
        there, back = _stacked(poses), _stacked([pose.inverse() for pose in poses])
        first, second = np.array([*product(*pair.shapes)]).T
        # The second link in the first one's frame, and the reverse, at once.
        turns, places = (
            np.repeat(np.stack(both, axis=-2), len(first), axis=-2)
            for both in zip(there, back, strict=True)
        )
        most = self._displacements(
            np.concatenate([first, second]), np.concatenate([second, first]), turns, places
        )
        return np.concatenate([[0.0], np.cumsum(most)])

    def _displacements(
        self,
        first: NDArray[np.intp],
        second: NDArray[np.intp],
        turns: FloatArray,
        places: FloatArray,
    ) -> FloatArray:
        """Return the largest motion ``(s - 1,)`` [m] between stations of points near a shape.

        The points belong to the second shape of a couple, which moves. ``turns`` and ``places`` are
        the rotations ``(3, 3, c, s)`` and positions ``(3, c, s)`` [m] of its body in that of the
        fixed shape.
        """
        shapes = self._placed
        fixed, moving = (_Placed(*(a[..., i, None] for a in shapes)) for i in (first, second))
        inward = fixed.rotations.swapaxes(0, 1)
        rotations = composed(composed(inward, turns), moving.rotations)
        positions = applied(inward, applied(turns, moving.positions) + places - fixed.positions)
        # The bounding box of the other shape's box, in the frame of the shape.
        middles, sizes = (fixed.high + fixed.low) / 2.0, (fixed.high - fixed.low) / 2.0 + _NEAR
        outward = rotations.swapaxes(0, 1)
        centres, halves = applied(outward, middles - positions), applied(np.abs(outward), sizes)
        lower = np.maximum(moving.low, centres - halves)
        upper = np.minimum(moving.high, centres + halves)
        near = np.logical_and.reduce(lower < upper, axis=0)
        most = np.zeros(near.shape[1] - 1)
        # Usually, few of the shapes come near each other.
        some = near.any(axis=1)
        if not some.any():
            return most
        near, lower, upper = near[some], lower[:, None, some], upper[:, None, some]
        corners = np.where(_UPPER, upper, lower)
        turns = np.diff(rotations[:, :, None, some])
        steps = np.diff(positions[:, None, some])
        for ends in (slice(None, -1), slice(1, None)):
            moved = applied(turns, corners[..., ends]) + steps
            squares = inner(moved, moved).max(axis=0)
            most = np.maximum(most, np.where(near[:, ends], squares, 0.0).max(axis=0))
        return np.sqrt(most)

    @cached_property
    def _placed(self) -> _Placed:
        """All shapes on their bodies."""
        shapes = self._scene.shapes
        return _Placed(
            np.array([shape.placement.rotation for shape in shapes]).transpose(1, 2, 0),
            np.array([shape.placement.translation for shape in shapes]).T,
            np.array([shape.box[0] for shape in shapes]).T,
            np.array([shape.box[1] for shape in shapes]).T,
        )


class LinkDistanceBounds:
    """Lower bounds on distances of links, from earlier distances and the motion since then."""

    def __init__(self, motion: MotionBounds, pairs: Sequence[LinkPair]) -> None:
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
    """Return the rotations ``(3, 3, s)`` and positions ``(3, s)`` [m] of poses."""
    rotations = np.array([pose.rotation for pose in poses]).transpose(1, 2, 0)
    return rotations, np.array([pose.translation for pose in poses]).T
