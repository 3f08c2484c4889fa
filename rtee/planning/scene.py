"""A hand and an object: how far they are apart, and where they touch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple, TypeAlias

import coal
import numpy as np
import pinocchio as pin

from rtee.hand.geometry import HandGeometry
from rtee.hand.model import Hand
from rtee.planning.objects import GraspObject
from rtee.planning.postures import HandPose, Postures
from rtee.planning.result import Contact
from rtee.sample import FloatArray

TOUCH: Final = 5e-4
"""Distance up to which surfaces touch [m]."""

_OTHERS: Final = 4
"""Most contacts of one link with one piece that count: the corners of a patch."""

NOWHERE: Final = np.zeros(3)
"""Point and normal of a pair that does not touch."""


class Touch(NamedTuple):
    """Distance of a shape of the hand to the object.

    Attributes:
        shape: Its index.
        distance: Signed distance; negative inside [m].
        point: The middle of the closest points ``(3,)`` in the base frame [m], if they touch.
        normal: Unit normal into the object ``(3,)``.
    """

    shape: int
    distance: float
    point: FloatArray
    normal: FloatArray


Measured: TypeAlias = tuple[float, FloatArray, FloatArray]
"""Distance of a shape from a piece, and point and normal as in `Touch`; the normal in any case."""


class GraspScene:
    """The shapes of a hand, as convex parts, and an object that can be put anywhere.

    Attributes:
        hand: The hand.
        object: The object.
        geometry: The hand's geometry.
        postures: Poses of its shapes.
        finger: Per shape, the finger that alone has its link; empty for the palm and linkages.
    """

    def __init__(self, hand: Hand, obj: GraspObject, geometry: HandGeometry | None = None) -> None:
        """Read the hand's geometry, unless it is given.

        Raises:
            ModelError: if a mesh of the hand is missing or cannot be read.
        """
        self.hand, self.object = hand, obj
        self.geometry = geometry or HandGeometry(hand)
        self.postures = Postures(self.geometry)
        self.finger = tuple(_finger_of(hand, shape.link) for shape in self.geometry.shapes)
        self._convex = [shape.convex for shape in self.geometry.shapes]
        self._pieces = [piece.shape for piece in obj.pieces]
        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()
        # Cached: every action needs those of the same few orientations.
        self._sizes: dict[bytes, tuple[float, float, float]] = {}
        # A box around each piece, along the axes of the object's box.
        high = np.array([piece.support(obj.frame.T) for piece in obj.pieces])
        low = -np.array([piece.support(-obj.frame.T) for piece in obj.pieces])
        self._middles, self._halves = 0.5 * (high + low), 0.5 * (high - low)

    def posed(self, u: FloatArray) -> HandPose:
        """Return the poses of the shapes at actuator positions ``(n,)`` [rad | m]."""
        return self.postures.posed(self.postures.frames(u[None])[0])

    def gaps(self, at: HandPose, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return gaps between the shapes and the pieces, without measuring distances.

        Args:
            at: Poses of the hand's shapes.
            pose: Pose of the object ``(4, 4)`` in the base frame.

        Returns:
            Widths ``(n, pieces)`` of gaps between two parallel planes, lower bounds of the
            distances [m], and their unit normals ``(n, pieces, 3)``, from the shape to the piece.
        """
        # Boxes enclose shapes and pieces, and boxes around these boxes bound their distances:
        # in the axes of the pieces' boxes and in those of the shapes' ones.
        axes = pose[:3, :3] @ self.object.frame
        turns, halves = axes.T @ at.turns, self.postures.halves
        swung = np.abs(turns)
        between = self._middles - ((at.middles - pose[:3, 3]) @ axes)[:, None]
        reach = self._halves + (swung @ halves[:, :, None]).swapaxes(1, 2)
        gaps, offsets = _box_gaps(between, reach)
        others, aside = _box_gaps(between @ turns, halves[:, None] + self._halves @ swung)
        wider = others > gaps
        normals = np.where(wider[:, :, None], aside @ at.turns.swapaxes(1, 2), offsets @ axes.T)
        return np.where(wider, others, gaps), normals

    def measured(
        self, shape: int, piece: int, there: coal.Transform3s, here: coal.Transform3s
    ) -> Measured:
        """Return the distance between a shape and a piece of the object.

        Args:
            shape: The shape.
            piece: The piece.
            there: Pose of the shape in the base frame.
            here: Pose of the object in the base frame.
        """
        result = self._result
        result.clear()
        distance: float = coal.distance(
            self._convex[shape], there, self._pieces[piece], here, self._request, result
        )
        # Only contacts need the points, and each takes a copy.
        point = NOWHERE
        if distance <= TOUCH:
            point = 0.5 * (result.getNearestPoint1() + result.getNearestPoint2())
        return distance, point, np.array(result.normal)

    def sizes(self, turn: FloatArray) -> tuple[float, float, float]:
        """Return the extents of the turned object ``(3, 3)`` along three axes [m]."""
        key = turn.tobytes()
        if key not in self._sizes:
            low, high = self.object.support(-turn), self.object.support(turn)
            x, y, z = (low + high).tolist()
            self._sizes[key] = x, y, z
        return self._sizes[key]

    def distance(
        self, shape: int, at: HandPose, other: coal.ShapeBase, where: coal.Transform3s
    ) -> float:
        """Return the signed distance of a shape of the hand from another one [m]."""
        self._result.clear()
        body, there = self._convex[shape], at.where(shape)
        return float(coal.distance(body, there, other, where, self._request, self._result))

    def contacts(self, touches: Sequence[Touch], at: HandPose, pose: FloatArray) -> list[Contact]:
        """Return the contacts of shapes that touch: one for a point, several for a patch."""
        return [contact for touch in touches for contact in self._patch(touch, at, pose)]

    def _patch(self, touch: Touch, at: HandPose, pose: FloatArray) -> Iterator[Contact]:
        body = self.geometry.shapes[touch.shape]
        there, here = at.where(touch.shape), coal.Transform3s(pose[:3, :3], pose[:3, 3])
        request, result = coal.CollisionRequest(), coal.CollisionResult()
        # Shapes that touch within `TOUCH` need not overlap, and without a margin have no patch.
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

    def torques(self, u: FloatArray, contacts: Sequence[Contact]) -> FloatArray:
        """Return the maps from forces at contacts to efforts ``(k, n, 3)``, at positions [rad | m].

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


def _box_gaps(between: FloatArray, reach: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the gaps ``(n, k)`` between upright boxes and their unit normals ``(n, k, 3)``.

    ``between`` are the offsets between their middles ``(n, k, 3)`` [m], ``reach`` the sums of their
    half extents [m]. Where boxes overlap, the axis along which they overlap least counts, with a
    negative gap.
    """
    separation = np.abs(between) - reach
    offsets = np.maximum(separation, 0.0)
    gaps = np.sqrt(np.einsum("nki,nki->nk", offsets, offsets))
    inside = gaps <= 0.0
    if inside.any():
        axis = separation[inside].argmax(axis=-1)
        offsets[inside] = np.eye(3)[axis]
        gaps[inside] = separation[inside].max(axis=-1)
    size = np.where(inside, 1.0, gaps)
    return gaps, np.copysign(offsets, between) / size[:, :, None]


def _finger_of(hand: Hand, link: str) -> str:
    names = [finger.name for finger in hand.fingers if link in finger.body]
    return names[0] if len(names) == 1 else ""
