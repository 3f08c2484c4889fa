"""How far links can move against each other on a straight way of the actuators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from rtee.extract.scene import LinkPair, Scene
from rtee.types import BoolArray, FloatArray, JointKind

_STATIONS: Final = 33

_NEAR: Final = 0.005
"""How near points must be for their motion to count [m]."""


@dataclass(frozen=True)
class Way:
    """The straight motion of the actuators from rest to a posture.

    Attributes:
        rest: Start ``(n,)`` [rad | m].
        goal: End ``(n,)`` [rad | m].
        travel: Upper bound of what each joint travels per unit of the way ``(m,)`` [rad | m].
    """

    rest: FloatArray
    goal: FloatArray
    travel: FloatArray

    def at(self, t: float) -> FloatArray:
        """Return the posture at intensity ``t``, 0 (rest) to 1 (goal)."""
        result: FloatArray = self.rest + t * (self.goal - self.rest)
        return result


class Motion:
    """Bounds on the speed of links, from the lengths of the chains that carry them.

    A point of a body, seen from a revolute joint that moves it, is never farther away than the
    lengths of the chain between them and the body's own radius add up to.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._bounds: dict[tuple[str, str], FloatArray] = {}

    def way(self, goal: FloatArray) -> Way:
        """Return the straight way from rest to a posture."""
        hand = self._scene.hand
        if hand.transmission.linear:
            travel = np.abs(hand.transmission.matrix @ (goal - hand.rest))
        else:
            stations = np.linspace(0.0, 1.0, _STATIONS)[:, None]
            q = hand.transmission.joints(hand.rest + stations * (goal - hand.rest))
            travel = 1.5 * np.abs(np.diff(q, axis=0)).max(axis=0) * (_STATIONS - 1)
        return Way(hand.rest, goal, travel)

    def speed(self, pair: LinkPair, way: Way) -> float:
        """Return a bound on the speed of two links against each other per unit of the way [m]."""
        if pair.links not in self._bounds:
            self._bounds[pair.links] = self._bound(pair)
        return float(self._bounds[pair.links] @ way.travel)

    def travelled(self, pair: LinkPair, way: Way, stations: Sequence[float]) -> FloatArray:
        """Return how far two links have moved against each other where they are near.

        Near are the points of one link that lie within the other one's bounding box, widened by
        5 mm and the distance of the points, at the one or the other end of a part of the way.

        Args:
            pair: The links.
            way: The way.
            stations: Intensities, increasing ``(s,)``.

        Returns:
            The sum of the greatest displacements up to each station ``(s,)`` [m].
        """
        scene, shapes = self._scene, self._scene.shapes
        first, second = pair.shapes
        couples = [(a, b) for i in first for j in second for a, b in ((i, j), (j, i))]
        total = [0.0]
        last: list[tuple[FloatArray, BoolArray]] = []
        for t in stations:
            scene.place(way.at(t))
            now = []
            for fixed, moving in couples:
                to_fixed = scene.shape_pose(fixed).actInv(scene.shape_pose(moving))
                points = shapes[moving].lattice @ to_fixed.rotation.T + to_fixed.translation
                low, high = shapes[fixed].box
                reach = _NEAR + shapes[moving].spacing
                near = ((points > low - reach) & (points < high + reach)).all(axis=1)
                now.append((points, near))
            if last:
                total.append(total[-1] + max(map(_displacement, last, now)))
            last = now
        return np.array(total)

    def _bound(self, pair: LinkPair) -> FloatArray:
        """Return the longest lever of every joint on the pair ``(m,)``: metres, 1 if prismatic."""
        scene = self._scene
        levers = np.zeros(len(scene.hand.joints))
        for shapes, body in zip(pair.shapes, pair.bodies, strict=True):
            reach = max(self._radius[i] for i in shapes)
            while body:
                if pair.moved_by[body - 1] != 0.0:
                    joint = scene.hand.joints[body - 1]
                    lever = 1.0 if joint.kind is JointKind.PRISMATIC else reach
                    levers[body - 1] = max(levers[body - 1], lever)
                reach += self._length[body]
                body = scene.kinematics.model.parents[body]
        return levers

    @cached_property
    def _length(self) -> list[float]:
        """Distance of every joint's frame from its parent's, travel included [m]."""
        scene = self._scene
        lengths = [
            float(np.linalg.norm(m.translation)) for m in scene.kinematics.model.jointPlacements
        ]
        for i, joint in enumerate(scene.hand.joints):
            if joint.kind is JointKind.PRISMATIC:
                lengths[i + 1] += max(abs(joint.lower), abs(joint.upper))
        return lengths

    @cached_property
    def _radius(self) -> list[float]:
        """Distance of the farthest point of every shape from its joint's frame [m]."""
        radii = []
        for shape in self._scene.shapes:
            placement = shape.placement
            points = shape.points @ placement.rotation.T + placement.translation
            radii.append(float(np.linalg.norm(points, axis=1).max()))
        return radii


def _displacement(
    before: tuple[FloatArray, BoolArray], after: tuple[FloatArray, BoolArray]
) -> float:
    near = before[1] | after[1]
    if not near.any():
        return 0.0
    step = after[0][near] - before[0][near]
    return float(np.sqrt(np.einsum("ij,ij->i", step, step).max()))
