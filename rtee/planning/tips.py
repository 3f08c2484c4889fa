"""The surfaces of a hand's fingertips: which point of one is nearest to a given point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import coal
import numpy as np
import pinocchio as pin

from rtee.hand.geometry import HandGeometry, Shape
from rtee.hand.model import Hand
from rtee.sample import FloatArray

_POINT: Final = 1e-6
"""Radius of the sphere that replaces a point for Coal [m]: a thousandth of a millimetre."""


class Fingertips:
    """The fingertips of a hand at one posture after another.

    Attributes:
        hand: The hand.
        geometry: Its geometry.
        fingers: The fingers that have a tip with a shape.
    """

    def __init__(self, hand: Hand) -> None:
        """Read the geometry.

        Raises:
            ModelError: if a mesh of the hand is missing or cannot be read.
        """
        self.hand = hand
        self.geometry = HandGeometry(hand)
        self._shapes: dict[str, list[Shape]] = {}
        for finger in hand.fingers:
            found = [self.geometry.shapes[i] for i in self.geometry.of_links(*finger.tip_links)]
            if found:
                self._shapes[finger.name] = found
        self.fingers = tuple(self._shapes)
        self._request = coal.DistanceRequest()
        self._request.enable_signed_distance = True
        self._sphere = coal.Sphere(_POINT)

    def go(self, u: FloatArray) -> None:
        """Place the hand at actuator positions ``(n,)`` [rad | m]."""
        robot = self.geometry.kinematics
        pin.forwardKinematics(robot.model, robot.data, self.hand.transmission.joints(u))

    def near(self, finger: str, point: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Return the placement of a tip relative to a point, both in the hand's base frame.

        Meshes count as their convex hulls, whose distance is negative inside.

        Returns:
            The signed distance [m], the nearest point of the tip's surface ``(3,)`` [m], and the
            surface's outward unit normal there ``(3,)``.
        """
        at, data = coal.Transform3s(np.eye(3), point), self.geometry.kinematics.data
        best = (math.inf, point, np.zeros(3))
        for shape in self._shapes[finger]:
            place = data.oMi[shape.body] * shape.placement
            result = coal.DistanceResult()
            distance = coal.distance(
                shape.convex,
                coal.Transform3s(place.rotation, place.translation),
                self._sphere,
                at,
                self._request,
                result,
            )
            if distance < best[0]:
                best = (float(distance), np.array(result.getNearestPoint1()), result.normal)
        length = float(np.linalg.norm(best[2]))
        normal = np.array(best[2]) / length if length > 0.0 else np.zeros(3)
        # Coal's distance ends at the sphere's surface, this much before the point.
        return best[0] + _POINT, best[1], normal

    def middle(self, fingers: Sequence[str]) -> FloatArray:
        """Return the mean of the middles of some tips ``(3,)`` [m] in the base frame."""
        found = []
        for finger in fingers:
            data = self.geometry.kinematics.data
            places = [(data.oMi[s.body] * s.placement) * s.ball[0] for s in self._shapes[finger]]
            found.append(np.mean(places, axis=0))
        mean: FloatArray = np.mean(found, axis=0)
        return mean

    def reach(self, finger: str, direction: FloatArray) -> float:
        """Return how far a tip reaches along a unit vector from the base frame's origin [m]."""
        data = self.geometry.kinematics.data
        ends = []
        for shape in self._shapes[finger]:
            place = data.oMi[shape.body] * shape.placement
            ends.append((shape.points @ place.rotation.T + place.translation) @ direction)
        return float(np.concatenate(ends).max())

    def in_tip(self, finger: str, point: FloatArray) -> FloatArray:
        """Return a point ``(3,)`` [m] of the base frame in that of a tip's body."""
        body = self._shapes[finger][0].body
        return np.array(self.geometry.kinematics.data.oMi[body].actInv(point))

    def from_tip(self, finger: str, point: FloatArray) -> FloatArray:
        """Return a point ``(3,)`` [m] of a tip's body in the base frame."""
        body = self._shapes[finger][0].body
        return np.array(self.geometry.kinematics.data.oMi[body].act(point))
