"""A hand and an object: how far they are apart, and where they touch."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import coal
import numpy as np
import pinocchio as pin

from rtee.hand.geometry import HandGeometry
from rtee.hand.model import Hand
from rtee.planning.objects import GraspObject
from rtee.planning.result import Contact
from rtee.sample import FloatArray

TOUCH: Final = 5e-4
"""Surfaces this near touch [m]."""

_OTHERS: Final = 4
"""Most contacts of one link with one piece that count: the corners of a patch."""

_BALL_AXES: Final = np.vstack([np.zeros(3), np.eye(3)])
"""A shape moves no faster than these points of its ball, in units of the radius, nearly."""


_NOWHERE: Final = np.zeros(3)


@dataclass(frozen=True, slots=True)
class Touch:
    """A shape of the hand that touches the object.

    Attributes:
        shape: Its index.
        distance: Signed distance; negative inside [m].
        point: The middle of the closest points ``(3,)`` in the base frame [m], if they touch.
        normal: Unit normal into the object ``(3,)``, if they touch.
    """

    shape: int
    distance: float
    point: FloatArray
    normal: FloatArray


@dataclass(frozen=True)
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


class GraspScene:
    """The shapes of a hand, as convex parts, and an object that can be put anywhere.

    Attributes:
        hand: The hand.
        object: The object.
        geometry: The hand's geometry.
        finger: Per shape, the finger that alone has its link; empty for the palm and linkages.
        asked: How many distances were measured.
    """

    def __init__(
        self, hand: Hand, thing: GraspObject, geometry: HandGeometry | None = None
    ) -> None:
        """Read the hand's geometry.

        Args:
            hand: The hand.
            thing: The object.
            geometry: The hand's geometry, where there is one already.

        Raises:
            ModelError: A mesh of the hand is missing or cannot be read.
        """
        self.hand, self.object = hand, thing
        self.geometry = geometry or HandGeometry(hand)
        self.asked = 0
        shapes = self.geometry.shapes
        self._bodies = np.array([shape.body for shape in shapes], dtype=np.int64)
        self._turns = np.array([shape.placement.rotation for shape in shapes]).reshape(-1, 3, 3)
        self._places = np.array([shape.placement.translation for shape in shapes]).reshape(-1, 3)
        self._balls = np.array([shape.ball[0] for shape in shapes]).reshape(-1, 3)
        self.radii = np.array([shape.ball[1] for shape in shapes])
        self.finger = tuple(_finger_of(hand, shape.link) for shape in shapes)
        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()
        self._pose, self._transform = b"", coal.Transform3s()
        balls = [piece.ball for piece in thing.pieces]
        self._centres = self._middles = np.array([middle for middle, _ in balls])
        self._reaches = np.array([reach for _, reach in balls])
        self._middle, self._half = thing.box
        self._axes = thing.frame

    def posed(self, u: FloatArray) -> HandPose:
        """Return where the shapes are at actuator positions ``(n,)`` [rad | m]."""
        kinematics = self.geometry.kinematics
        joints = self.hand.transmission.joints(u)
        pin.forwardKinematics(kinematics.model, kinematics.data, joints)
        # Copied into arrays: the next posture overwrites Pinocchio's data.
        frames = [(m.rotation, m.translation) for m in kinematics.data.oMi]
        turns = np.array([frame[0] for frame in frames])[self._bodies]
        origins = np.array([frame[1] for frame in frames])[self._bodies]
        places = origins + np.einsum("nij,nj->ni", turns, self._places)
        turns = turns @ self._turns
        return HandPose(turns, places, places + np.einsum("nij,nj->ni", turns, self._balls))

    def bounds(self, at: HandPose, pose: FloatArray) -> FloatArray:
        """Return lower bounds of the shapes' distances from the object ``(n,)`` [m].

        Args:
            at: Where the hand is.
            pose: Pose of the object ``(4, 4)`` in the base frame.
        """
        turn = pose[:3, :3] @ self._axes
        middle = pose[:3, :3] @ self._middle + pose[:3, 3]
        # A box holds the object and a ball each shape, so their distance is a lower bound.
        outside = np.maximum(np.abs((at.middles - middle) @ turn) - self._half, 0.0)
        found: FloatArray = np.sqrt((outside * outside).sum(axis=1)) - self.radii
        return found

    def touch(self, shape: int, at: HandPose, pose: FloatArray) -> Touch:
        """Return how near a shape is to the object, and where if they touch."""
        # Before `_rooms`, which takes the pieces to be where this puts them.
        there, here = at.where(shape), self._where(pose)
        body, result = self.geometry.shapes[shape].convex, self._result
        least, point, normal = math.inf, _NOWHERE, _NOWHERE
        pieces = self.object.pieces
        rooms = self._rooms(shape, at) if len(pieces) > 1 else (-math.inf,)
        # The nearest piece first: its distance rules most others out.
        for room, piece in sorted(zip(rooms, pieces, strict=True), key=lambda pair: pair[0]):
            if room >= least:
                break
            result.clear()
            self.asked += 1
            distance = coal.distance(body, there, piece.shape, here, self._request, result)
            if distance < least:
                least = distance
                # Only contacts need the points, and each takes a copy.
                if distance <= TOUCH:
                    point = 0.5 * (result.getNearestPoint1() + result.getNearestPoint2())
                    normal = np.array(result.normal)
        return Touch(shape, least, point, normal)

    def _rooms(self, shape: int, at: HandPose) -> list[float]:
        """Return lower bounds of a shape's distances from the pieces, where they are last."""
        apart = np.sqrt(((self._middles - at.middles[shape]) ** 2).sum(axis=1))
        rooms: list[float] = (apart - self._reaches - self.radii[shape]).tolist()
        return rooms

    def _where(self, pose: FloatArray) -> coal.Transform3s:
        """Return a pose of the object for Coal; the one asked for last is kept."""
        # By content, not identity: callers move an object by changing the same array.
        key = pose.tobytes()
        if key != self._pose:
            self._pose, self._transform = key, coal.Transform3s(pose[:3, :3], pose[:3, 3])
            self._middles = self._centres @ pose[:3, :3].T + pose[:3, 3]
        return self._transform

    def apart(
        self, shape: int, at: HandPose, other: coal.ShapeBase, where: coal.Transform3s
    ) -> float:
        """Return the signed distance of a shape of the hand from another one [m]."""
        self._result.clear()
        body = self.geometry.shapes[shape].convex
        return float(
            coal.distance(body, at.where(shape), other, where, self._request, self._result)
        )

    def nearest(self, at: HandPose, pose: FloatArray, enough: float = np.inf) -> float:
        """Return the least distance of the hand from the object [m].

        Args:
            at: Where the hand is.
            pose: Pose of the object ``(4, 4)`` in the base frame.
            enough: Distances above this need not be exact [m].
        """
        bounds = self.bounds(at, pose)
        least = enough
        for shape in np.argsort(bounds, kind="stable").tolist():
            # The bounds rise: no shape after this one can be nearer.
            if bounds[shape] >= least:
                break
            least = min(least, self.touch(shape, at, pose).distance)
        return float(least)

    def touching(self, at: HandPose, pose: FloatArray, within: float = TOUCH) -> list[Touch]:
        """Return the shapes that touch the object, in their order."""
        near = np.flatnonzero(self.bounds(at, pose) <= within).tolist()
        found = (self.touch(shape, at, pose) for shape in near)
        return [touch for touch in found if touch.distance <= within]

    def contacts(self, touches: Sequence[Touch], at: HandPose, pose: FloatArray) -> list[Contact]:
        """Return the contacts of shapes that touch: one for a point, several for a patch."""
        return [contact for touch in touches for contact in self._patch(touch, at, pose)]

    def _patch(self, touch: Touch, at: HandPose, pose: FloatArray) -> Iterator[Contact]:
        body = self.geometry.shapes[touch.shape]
        there, here = at.where(touch.shape), self._where(pose)
        request, result = coal.CollisionRequest(), coal.CollisionResult()
        # What touches within `TOUCH` need not overlap, and without a margin has no patch.
        request.security_margin = 2.0 * TOUCH
        found = 0
        for piece in self.object.pieces:
            result.clear()
            if not coal.collide(body.convex, there, piece.shape, here, request, result):
                continue
            patches = coal.ContactPatchResult()
            coal.computeContactPatch(
                body.convex, there, piece.shape, here, result, coal.ContactPatchRequest(), patches
            )
            for number in range(patches.numContactPatches()):
                patch = patches.getContactPatch(number)
                points = [np.array(patch.getPoint(i)) for i in range(patch.size())]
                for point in _corners(points):
                    found += 1
                    yield self._contact(touch.shape, point, np.array(patch.getNormal()))
        # The distance said that they touch: without a patch, its point is the contact.
        if not found:
            yield self._contact(touch.shape, touch.point, touch.normal)

    def _contact(self, shape: int, point: FloatArray, normal: FloatArray) -> Contact:
        x, y, z = (float(v) for v in point)
        a, b, c = (float(v) for v in normal / np.linalg.norm(normal))
        return Contact(self.geometry.shapes[shape].link, self.finger[shape], (x, y, z), (a, b, c))

    def speeds(self, before: HandPose, after: HandPose) -> FloatArray:
        """Return how far points of the shapes go at most, from a posture to one near it [m]."""
        reach = self.radii[:, None, None] * _BALL_AXES
        moved = [
            at.middles[:, None] + reach @ at.turns.transpose(0, 2, 1) for at in (before, after)
        ]
        found: FloatArray = np.linalg.norm(moved[1] - moved[0], axis=2).max(axis=1)
        return found

    def torques(self, u: FloatArray, contacts: Sequence[Contact]) -> FloatArray:
        """Return the maps from forces at contacts to the actuators' efforts ``(k, n, 3)``.

        Args:
            u: Actuator positions ``(n,)`` [rad | m].
            contacts: The contacts.

        Returns:
            Per contact the transposed Jacobian of its point with respect to the actuators.
        """
        kinematics = self.geometry.kinematics
        pin.computeJointJacobians(
            kinematics.model, kinematics.data, self.hand.transmission.joints(u)
        )
        whole = kinematics.data.J.reshape(6, -1)
        drive = self.hand.transmission.jacobian(u)
        found = []
        for contact in contacts:
            # data.J has the columns of all joints; those that do not carry the link do not move it.
            columns = whole * kinematics.support(kinematics.body(contact.link))
            # J's linear part is the velocity at the base's origin; at the contact it is v + ω x p.
            linear = columns[:3] - pin.skew(np.array(contact.point)) @ columns[3:]
            found.append((linear @ drive).T)
        return np.array(found).reshape(-1, len(u), 3)


def _corners(points: list[FloatArray]) -> list[FloatArray]:
    """Return the outermost points of a patch, at most `_OTHERS`; equal ones once."""
    if len(points) <= _OTHERS:
        return points
    middle = np.mean(points, axis=0)
    spread = np.array(points) - middle
    first = int(np.argmax(np.linalg.norm(spread, axis=1)))
    axis = spread[first] / max(float(np.linalg.norm(spread[first])), 1e-12)
    along = spread @ axis
    across = spread - np.outer(along, axis)
    widest = across[int(np.argmax(np.linalg.norm(across, axis=1)))]
    aside = across @ widest
    chosen = [first, int(np.argmin(along)), int(np.argmax(aside)), int(np.argmin(aside))]
    return [points[i] for i in dict.fromkeys(chosen)]


def _finger_of(hand: Hand, link: str) -> str:
    names = [finger.name for finger in hand.fingers if link in finger.links]
    return names[0] if len(names) == 1 else ""
