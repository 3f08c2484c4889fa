"""Poses near the one at which an action holds an object, since arms and cameras are inexact."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtee.planning.approaches import PoseCandidate
from rtee.planning.closing import Closure, HandClosing, close_all
from rtee.planning.distance_bounds import DistanceBounds
from rtee.sample import FloatArray

_BESIDE: Final = 0.008
"""Displacement along each axis at which an object must also be held [m]: the accuracy of arms and
cameras."""

_TURNED: Final = 0.15
"""The same for a rotation about each axis [rad]."""

_PUSHED: Final = 0.05
"""Largest distance by which the coming open hand may push an object ahead [m]; farther, the
fingertips no longer reach it."""

_PUSH: Final = 0.002
"""Step by which the object is pushed [m]."""


def closed_nearby(closing: HandClosing, candidate: PoseCandidate) -> list[Closure | None]:
    """Return the hand closed at twelve poses near a candidate; ``None`` where it does not hold."""
    nearby = _nearby(candidate.pose)
    free = [_pushed(closing, pose, candidate) for pose in nearby]
    asked = [(closing, pose, candidate.start) for pose in free if pose is not None]
    closures = iter(close_all(asked))
    return [None if pose is None else next(closures) for pose in free]


def _pushed(closing: HandClosing, pose: FloatArray, candidate: PoseCandidate) -> FloatArray | None:
    """Return the pose to which the approaching hand pushes an object; ``None`` if it is too far."""
    approach_from, at = candidate.approach_from, closing.table[candidate.start]
    pose, length = pose.copy(), float(np.linalg.norm(approach_from))
    for _ in range(round(_PUSHED / _PUSH)):
        if DistanceBounds(closing.scene, [at], pose[None]).least(at, enough=_PUSH)[0] > 0.0:
            return pose
        # Without an approach, there is no direction to push it.
        if not length:
            return None
        pose[:3, 3] += _PUSH * approach_from / length
    return None


def _nearby(pose: FloatArray) -> list[FloatArray]:
    """Return poses that differ along or about one axis, to either side."""
    found = []
    for axis in np.eye(3):
        for sign in (1.0, -1.0):
            beside = pose.copy()
            beside[:3, 3] += sign * _BESIDE * axis
            found.append(beside)
            x, y, z = sign * _TURNED * axis
            turned = pose.copy()
            small = np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
            # The nearest rotation: the first-order one would stretch the object.
            u, _, v = np.linalg.svd(small)
            turned[:3, :3] = u @ v @ pose[:3, :3]
            found.append(turned)
    return found
