"""Bounds on how far joints move shapes relative to each other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtee.hand.geometry import Shape
from rtee.hand.kinematics import Kinematics
from rtee.hand.linalg import norm, norms, rotated
from rtee.hand.transmission import sample
from rtee.sample import FloatArray
from rtee.types import JointKind


class Levers:
    """Levers of the joints on shapes, from the lengths of the chains that carry them.

    The distance from a revolute joint to a point of a body that it moves is at most the length of
    the chain between them plus the body's radius.
    """

    def __init__(self, kinematics: Kinematics, shapes: Sequence[Shape]) -> None:
        """Prepare; ``shapes`` are all shapes, to which more may be added later."""
        self._kinematics = kinematics
        self._hand = kinematics.hand
        self._shapes = shapes
        self._radii: dict[int, float] = {}

    def of(
        self, shapes: tuple[Sequence[int], Sequence[int]], bodies: tuple[int, int]
    ) -> FloatArray:
        """Return the longest lever of each joint on some shapes of two bodies ``(m,)``.

        It is the largest motion of the shapes relative to each other per unit of the joint, in
        metres for revolute joints and 1 for prismatic ones; 0 for joints that move both bodies or
        neither.
        """
        levers = np.zeros(len(self._hand.joints))
        support = self._kinematics.support
        moved_by = support(bodies[1]) - support(bodies[0])
        for indices, start in zip(shapes, bodies, strict=True):
            reach, body = max(map(self._radius, indices)), start
            # From the link to the base, along all joints that carry the link.
            while body:
                if moved_by[body - 1] != 0.0:
                    joint = self._hand.joints[body - 1]
                    lever = 1.0 if joint.kind is JointKind.PRISMATIC else reach
                    levers[body - 1] = max(levers[body - 1], lever)
                # From the next joint towards the base, the point is farther away by this link.
                reach += self._lengths[body]
                body = self._kinematics.model.parents[body]
        return levers

    def between(self, first: Sequence[int], second: Sequence[int]) -> FloatArray:
        """Return the longest lever of each joint on any shape of the first and of the second set.

        Unlike with `of`, shapes of one set may belong to several bodies.
        """
        sides = []
        for indices in (first, second):
            of_body: dict[int, list[int]] = {}
            for i in indices:
                of_body.setdefault(self._shapes[i].body, []).append(i)
            sides.append(of_body.items())
        levers = [self.of((some, others), (a, b)) for a, some in sides[0] for b, others in sides[1]]
        longest: FloatArray = np.max(levers, axis=0)
        return longest

    def movers(self, shapes: Sequence[int]) -> NDArray[np.intp]:
        """Return the joints, by index, that move any of the shapes in the base frame."""
        bodies = {self._shapes[i].body for i in shapes}
        return np.flatnonzero(np.any([self._kinematics.support(b) for b in bodies], axis=0))

    @cached_property
    def _lengths(self) -> list[float]:
        """Distance of each joint's frame from its parent's frame, including travel [m]."""
        lengths = [norm(m.translation) for m in self._kinematics.model.jointPlacements]
        for i, joint in enumerate(self._hand.joints):
            if joint.kind is JointKind.PRISMATIC:
                lengths[i + 1] += max(abs(joint.lower), abs(joint.upper), self._farthest(i))
        return lengths

    def _farthest(self, joint: int) -> float:
        """Return the largest distance of a joint from 0 in its actuator's range [rad | m]."""
        coupling = self._hand.transmission.couplings[joint]
        if coupling.actuator is None:
            return abs(coupling.value(0.0))
        spec = self._hand.actuators[coupling.actuator]
        # Followers may exceed their own limits; use those of the actuator.
        return max(abs(coupling.value(u)) for u in sample(spec.lower, spec.upper))

    def _radius(self, i: int) -> float:
        """Return the distance of a shape's farthest point from its joint's frame [m]."""
        if i not in self._radii:
            shape = self._shapes[i]
            points = rotated(shape.points, shape.placement.rotation) + shape.placement.translation
            self._radii[i] = float(norms(points).max())
        return self._radii[i]
