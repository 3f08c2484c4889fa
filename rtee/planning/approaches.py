"""Approaches of an object to the open hand, and its possible poses there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from rtee.planning.distance_bounds import DistanceBounds
from rtee.planning.objects import GraspObject
from rtee.planning.postures import HandPoses
from rtee.planning.scene import GraspScene
from rtee.sample import FloatArray

GAP: Final = 1e-3
"""Gap between the object and the hand during the approach [m]: the accuracy of models."""

APPROACH_LENGTH: Final = 0.15
"""Distance from which an object approaches [m]: beyond the reach of open fingers."""

_DEEPEST: Final = 0.08
"""Farthest position of an object beyond the fingertips' middle [m]: every palm is nearer."""


@dataclass(frozen=True, slots=True)
class PoseCandidate:
    """A pose of the object that an action may grasp.

    Attributes:
        pose: Pose of the object ``(4, 4)`` in the base frame.
        approach_from: Start of its approach, relative to the hand ``(3,)`` [m]; free of contact.
        width: Its width between the fingers [m].
        opening: How far apart they are at rest [m].
        start: Step of the action's path at which the hand approaches, and from which it closes.
        raised: Whether it was moved once already, so that the closing hand clears the table.
        centred: Whether it was moved to where the fingers meet, if they wait for one another.
    """

    pose: FloatArray
    approach_from: FloatArray
    width: float
    opening: float
    start: int = 0
    raised: bool = False
    centred: bool = False


@dataclass(slots=True)
class Approach:
    """A straight approach of the object to the hand; `bring_in` finds where it ends.

    Attributes:
        pose: Pose of the object at depth 0 ``(4, 4)``.
        direction: Unit vector towards where it comes from ``(3,)``.
        frames: Poses of the hand's bodies during the approach ``(m + 1, 4, 4)``.
        depth: How far before the pose it stops [m]; negative beyond it; ``None`` if the path is
            blocked.
    """

    pose: FloatArray
    direction: FloatArray
    frames: FloatArray
    depth: float | None = None


Found: TypeAlias = PoseCandidate | Approach
"""A candidate; or an approach, whose depth decides which candidates come next."""


def bring_in(scene: GraspScene, approaches: Sequence[Approach]) -> None:
    """Set the depths of approaches: how far the object comes before it touches the hand."""
    if not approaches:
        return
    directions = np.array([approach.direction for approach in approaches])
    poses = np.array([approach.pose for approach in approaches])
    # Its near side, not its middle, begins beyond the reach of the fingers.
    obj = scene.object
    first = APPROACH_LENGTH + np.array(
        [near_side(obj, e.pose, e.direction, obj.inside) for e in approaches]
    )
    depths = first.copy()
    poses[:, :3, 3] += depths[:, None] * directions
    left = np.arange(len(approaches))
    at = HandPoses(scene.postures, np.array([approach.frames for approach in approaches]))
    near = DistanceBounds(scene, [at.one(row) for row in left.tolist()], poses)
    while len(left):
        # A step of the free distance cannot pass a link; `GAP` is left at the end.
        free = near.least(at, first[left], left) - GAP
        there = free < 0.5 * GAP
        for row in left[there].tolist():
            # It touches before its first step: the approach is blocked.
            depth = float(depths[row])
            approaches[row].depth = None if depth >= first[row] else depth
        left, free = left[~there], free[~there]
        depths[left] -= free
        near.pushed(-free[:, None] * directions[left], left)
        for row in left[depths[left] <= -_DEEPEST].tolist():
            approaches[row].depth = -_DEEPEST
        left = left[depths[left] > -_DEEPEST]


def near_side(
    obj: GraspObject, pose: FloatArray, direction: FloatArray, origin: FloatArray
) -> float:
    """Return how far an object extends against a direction from a point of its frame [m]."""
    along = direction @ pose[:3, :3]
    return float(obj.support(-along[None])[0] + along @ origin)


def at_most(found: Iterator[Found], most: int) -> Iterator[Found]:
    """Yield a limited number of candidates, with the approaches before them."""
    while most:
        item = next(found, None)
        if item is None:
            return
        most -= isinstance(item, PoseCandidate)
        yield item


def interleaved(first: Iterator[Found], second: Iterator[Found]) -> Iterator[Found]:
    """Yield candidates from two iterators alternately, with the approaches before them."""
    left = [first, second]
    while left:
        for found in list(left):
            one = list[Found]()
            for item in at_most(found, 1):
                one.append(item)
                yield item
            if not one or isinstance(one[-1], Approach):
                left.remove(found)
