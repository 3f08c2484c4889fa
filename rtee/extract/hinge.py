"""Clipping of tips connected by a joint to the parts whose contact is a pinch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import coal
import numpy as np
import pinocchio as pin

from rtee.hand.geometry import Shape, hull_of
from rtee.hand.linalg import norms, rotated
from rtee.hand.tessellation import subdivided
from rtee.sample import FloatArray

OUTER: Final = 0.5
"""Start of the part of a jaw to keep, between the end of the contact at rest (0) and the end of the
shorter jaw (1)."""

_EDGE: Final = 0.006
"""Longest edge of the triangles along which a mesh is cut [m]: less than a fingertip's width."""

_PARTS: Final = 64
"""Maximum number of edges along the longest side of a shape, which limits the triangles of large
shapes."""

_HALVINGS: Final = 8
"""Number of halvings of the range of distances from the axis, to less than a millimetre."""


class ClippedShape(Shape):
    """The part of a shape beyond a distance from an axis.

    The convex part is the hull of this part. The exact geometry is the triangles of a mesh beyond
    the distance, or the hull if the whole shape is a primitive.
    """

    def __init__(self, whole: Shape, corners: FloatArray) -> None:
        """Take the triangles ``corners`` ``(t, 3, 3)`` of a shape, in its own frame [m]."""
        points = corners.reshape(-1, 3)
        # Round to 0.1 µm, which makes shared corners of triangles equal.
        hull = hull_of(np.unique(np.round(points, 7), axis=0))
        exact = _mesh(corners) if whole.is_mesh else hull
        super().__init__(whole.link, whole.body, whole.of_link, exact, whole.source)
        faces = np.arange(len(points), dtype=np.int64).reshape(-1, 3)
        self.convex = hull
        self.triangles = (points, faces)
        self.points = np.array(hull.points())


@dataclass(frozen=True)
class TipShape:
    """A shape of a tip, with its pose relative to the joint's axis.

    Attributes:
        shape: The shape.
        pose: Its pose at rest in the base frame.
        origin: A point of the axis in the base frame [m].
        axis: The axis, a unit vector in the base frame.
    """

    shape: Shape
    pose: pin.SE3
    origin: FloatArray
    axis: FloatArray

    def arms(self, points: FloatArray) -> FloatArray:
        """Return the distances from the axis [m] of points ``(..., 3)`` in the shape's frame."""
        there = rotated(points, self.pose.rotation) + self.pose.translation
        return norms(np.cross(there - self.origin, self.axis))

    def reach(self) -> float:
        """Return the distance of the farthest point from the axis [m]."""
        return float(self.arms(self.shape.triangles[0]).max())

    def outline(self, limit: float) -> FloatArray:
        """Return points ``(k, 3)`` whose hull contains the part beyond a distance from the axis."""
        vertices, faces = self.shape.triangles
        arms = self.arms(vertices)
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        near, far = np.minimum(arms[edges[:, 0]], arms[edges[:, 1]]), arms[edges].max(axis=1)
        crossing = edges[(near < limit) & (far > limit)]
        # Points where edges cross the limit, interpolated by the distances of their ends.
        a, b = crossing[:, 0], crossing[:, 1]
        share = ((limit - arms[a]) / (arms[b] - arms[a]))[:, None]
        cuts = vertices[a] + share * (vertices[b] - vertices[a])
        return np.concatenate([vertices[arms > limit], cuts])

    def beyond(self, limit: float) -> FloatArray:
        """Return the triangles ``(t, 3, 3)`` beyond a distance from the axis."""
        vertices, faces = self.shape.triangles
        outside = (self.arms(vertices) > limit)[faces]
        whole = outside.all(axis=1)
        low, high = self.shape.box
        edge = max(_EDGE, float((high - low).max()) / _PARTS)
        pieces = subdivided(vertices[faces[~whole]], edge)
        # Keep only whole triangles on the outer side, without slivers at the cut.
        kept = pieces[(self.arms(pieces) > limit).all(axis=1)]
        return np.concatenate([vertices[faces[whole]], kept])


def clip_tips(
    first: Sequence[TipShape], second: Sequence[TipShape]
) -> tuple[list[ClippedShape], list[ClippedShape]]:
    """Return the parts of two joined tips whose contact is a pinch.

    Tips connected by a joint may touch near the joint in every configuration, which is not a pinch.
    This contact ends at the least distance from the joint's axis beyond which the tips do not touch
    at rest. The returned parts lie beyond the midpoint between this distance and the end of the
    shorter tip.

    Returns:
        The clipped shapes of both tips; empty if nothing is left.
    """
    end = min(max(jaw.reach() for jaw in tip) for tip in (first, second))
    low, high = 0.0, end
    for _ in range(_HALVINGS):
        # Bisection: the farther from the axis, the less of the tips is left to overlap.
        middle = (low + high) / 2.0
        if _overlap(first, second, middle):
            low = middle
        else:
            high = middle
    limit = high + OUTER * (end - high)
    parts = []
    for tip in (first, second):
        cut = [(jaw.shape, jaw.beyond(limit)) for jaw in tip]
        parts.append([ClippedShape(shape, corners) for shape, corners in cut if len(corners)])
    return parts[0], parts[1]


def _overlap(first: Sequence[TipShape], second: Sequence[TipShape], limit: float) -> bool:
    """Return whether the convex parts beyond a distance from the axis overlap at rest."""
    hulls = []
    for tip in (first, second):
        outlines = [(jaw.pose, jaw.outline(limit)) for jaw in tip]
        hulls.append([(pose, hull_of(points)) for pose, points in outlines if len(points)])
    request = coal.CollisionRequest()
    # The hulls of the remaining parts are convex, so one cheap query per couple decides.
    return any(
        coal.collide(a, _transform(at_a), b, _transform(at_b), request, coal.CollisionResult())
        for at_a, a in hulls[0]
        for at_b, b in hulls[1]
    )


def _transform(pose: pin.SE3) -> coal.Transform3s:
    return coal.Transform3s(pose.rotation, pose.translation)


def _mesh(corners: FloatArray) -> coal.BVHModelOBBRSS:
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(corners), 3 * len(corners))
    mesh.addVertices(corners.reshape(-1, 3))
    mesh.addTriangles(np.arange(3 * len(corners), dtype=np.uint64).reshape(-1, 3))
    mesh.endModel()
    return mesh
