"""How an object comes towards the open hand, and which poses it may have there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from rtee.planning.distance_bounds import DistanceBounds
from rtee.planning.objects import GraspObject
from rtee.planning.postures import HandPose
from rtee.planning.scene import GraspScene
from rtee.sample import FloatArray

GAP: Final = 1e-3
"""What an object leaves free at the hand when it is brought in [m]: models are that exact."""

WAY: Final = 0.15
"""From where an object is brought in [m]: beyond the reach of fingers that stand open."""

_DEEPEST: Final = 0.08
"""How far beyond the fingertips' middle an object is brought at most [m]: palms are nearer."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A pose of the object that an action may grasp.

    Attributes:
        pose: Pose of the object ``(4, 4)`` in the base frame.
        way: From where it comes, relative to the hand ``(3,)`` [m]; free of contact.
        width: Its width between the fingers [m].
        opening: How far apart they are at rest [m].
        raised: It was moved once already, so that the closing hand clears the table.
    """

    pose: FloatArray
    way: FloatArray
    width: float
    opening: float
    raised: bool = False


@dataclass(slots=True)
class Approach:
    """A way of the object towards the open hand; where it ends is to be found by `bring_in`.

    Attributes:
        pose: Pose of the object at depth 0 ``(4, 4)``.
        way: From where it comes, a unit vector ``(3,)``.
        depth: How far before the pose it stops [m]; negative beyond it; ``None`` if it can't come.
    """

    pose: FloatArray
    way: FloatArray
    depth: float | None = None


Found: TypeAlias = Candidate | Approach
"""A candidate; or an approach, whose depth decides which candidates come next."""


def bring_in(scene: GraspScene, at: HandPose, approaches: Sequence[Approach]) -> None:
    """Find how far the object comes towards the open hand, before it touches.

    The depths of its ways are filled in.
    """
    if not approaches:
        return
    ways = np.array([approach.way for approach in approaches])
    poses = np.array([approach.pose for approach in approaches])
    # Its near side, not its middle, begins beyond the reach of the fingers.
    obj = scene.object
    first = WAY + np.array([near_side(obj, e.pose, e.way, obj.inside) for e in approaches])
    depths = first.copy()
    poses[:, :3, 3] += depths[:, None] * ways
    near = DistanceBounds(scene, at, poses)
    left = np.arange(len(approaches))
    while len(left):
        # A step of the free distance cannot pass a link; `GAP` is left at the end.
        free = near.least(at, first[left], left) - GAP
        there = free < 0.5 * GAP
        for row in left[there].tolist():
            # What touches before its first step has no way in.
            depth = float(depths[row])
            approaches[row].depth = None if depth >= first[row] else depth
        left, free = left[~there], free[~there]
        depths[left] -= free
        near.pushed(-free[:, None] * ways[left], left)
        for row in left[depths[left] <= -_DEEPEST].tolist():
            approaches[row].depth = -_DEEPEST
        left = left[depths[left] > -_DEEPEST]


def near_side(obj: GraspObject, pose: FloatArray, way: FloatArray, origin: FloatArray) -> float:
    """Return how far an object reaches against a way ``(3,)`` from a point of its frame [m]."""
    along = way @ pose[:3, :3]
    return float(obj.support(-along[None])[0] + along @ origin)


def at_most(found: Iterator[Found], most: int) -> Iterator[Found]:
    """Yield at most so many candidates, with the approaches before them."""
    while most:
        item = next(found, None)
        if item is None:
            return
        most -= isinstance(item, Candidate)
        yield item


def interleaved(first: Iterator[Found], second: Iterator[Found]) -> Iterator[Found]:
    """Yield candidates from two iterators by turns, with the approaches before them."""
    left = [first, second]
    while left:
        for found in list(left):
            one = list[Found]()
            for item in at_most(found, 1):
                one.append(item)
                yield item
            if not one or isinstance(one[-1], Approach):
                left.remove(found)
