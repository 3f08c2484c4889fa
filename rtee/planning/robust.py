"""Find object poses that an action holds even if the object is slightly misplaced."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from rtee.actions.types import Action
from rtee.hand.model import Hand
from rtee.planning.approaches import GAP, PoseCandidate
from rtee.planning.closing import Closure, HandClosing, close_all
from rtee.planning.nearby import closed_nearby
from rtee.planning.planner import Planner
from rtee.planning.poses import Poses

_CANDIDATES: Final = 24
"""Poses between all fingers that are compared: two or three depths of each orientation."""

_OF_GROUP: Final = 8
"""Poses between the fingers of a group that are compared."""

_GROUPS: Final = 4
"""Groups of fingers that are checked, the largest first."""

_JUDGED: Final = 12
"""Poses that are also evaluated nearby: the most promising ones."""


@dataclass(frozen=True, slots=True)
class RobustPose:
    """A pose of an object and how well an action holds it there and nearby.

    Attributes:
        candidate: The pose, and from where the object comes.
        first: Intensity at which the fingers first oppose each other on it.
        held: Share of the poses nearby at which the fingers oppose each other on it.
        promise: Mean of what these grasps promise; larger is better.
    """

    candidate: PoseCandidate
    first: float
    held: float
    promise: float


def robust_poses(
    planner: Planner,
    action: Action,
    groups: Sequence[Action] = (),
    others: Iterable[PoseCandidate] = (),
) -> list[RobustPose]:
    """Return poses at which an action holds an object, the most robust ones first.

    Args:
        planner: The hand with the object.
        action: The action.
        groups: Actions whose fingers it moves, too: the object may be between those alone.
        others: Further poses to compare.
    """
    closing = planner.closing(action)
    if not closing.path.moving.any():
        return []
    candidates = [*others]
    for group in (action, *_largest(groups)):
        poses = Poses(planner.scene, closing, group, planner.out)
        most = _CANDIDATES if group is action else _OF_GROUP
        candidates += poses.candidates(planner.turns, most)
    closures = close_all([(closing, candidate.pose, candidate.start) for candidate in candidates])
    closed = [(c, k) for c, k in zip(candidates, closures, strict=True) if k is not None]
    between = _two_tips(planner.hand, action, closing)
    if between:  # a gripper holds with its tips, though its linkage might hold more firmly
        tips = planner.hand.tip_links
        closed = [
            pair for pair in closed if between <= {tips.get(c.link) for c in pair[1].contacts}
        ] or closed
    # Judging nearby takes 13 closings for each: only the most promising are judged.
    closed.sort(key=lambda pair: -planner.promise(pair[1]))
    found = [_judged(planner, closing, *pair) for pair in closed[:_JUDGED]]
    # Rounded, so that the processor's last bit does not decide.
    found.sort(key=lambda pose: (-round(pose.held, 6), -pose.promise))
    return found


def too_wide(planner: Planner, action: Action, groups: Sequence[Action] = ()) -> str:
    """Return why an object can't come into the hand at rest; empty if it can.

    Args:
        planner: The hand with the object.
        action: The action.
        groups: Actions whose fingers it moves, too.
    """
    closing = planner.closing(action)
    if not closing.path.moving.any():
        return ""
    widest, wide = 0.0, math.inf
    for group in (action, *_largest(groups)):
        poses = Poses(planner.scene, closing, group, planner.out)
        if next(poses.candidates(planner.turns, _OF_GROUP), None) is not None:
            return ""
        opened = float(poses.gaps.max())
        if opened >= widest:  # the width across the direction in which this group closes
            widest, wide = opened, poses.narrowest(planner.turns)
    if wide <= widest - 2.0 * GAP:
        return ""  # it has room; a trial shows what else is in its way
    return f"{wide * 1e3:.0f} mm wide, the hand opens to {widest * 1e3:.0f} mm"


def _two_tips(hand: Hand, action: Action, closing: HandClosing) -> frozenset[str]:
    """Return the two fingers whose tips grasp in an action; empty if more than two do."""
    moved = {
        name for name, moves in zip(hand.actuator_names, closing.path.moving, strict=True) if moves
    }
    tips = [
        finger.name
        for finger in hand.fingers
        if finger.tip
        and (not action.fingers or finger.name in action.fingers)
        and (not finger.actuators or moved.intersection(finger.actuators))
    ]
    return frozenset(tips) if len(tips) == 2 else frozenset()


def _largest(groups: Sequence[Action]) -> list[Action]:
    return sorted(groups, key=lambda group: -len(group.fingers))[:_GROUPS]


def _judged(
    planner: Planner, closing: HandClosing, candidate: PoseCandidate, middle: Closure
) -> RobustPose:
    """Return how well an object is held at a pose and nearby."""
    promises = [planner.promise(middle)]
    closures = closed_nearby(closing, candidate)
    promises += [planner.promise(closure) for closure in closures if closure is not None]
    # Nearby poses that do not hold count in the mean, with a score of 0.
    count = len(closures) + 1
    return RobustPose(candidate, middle.first, len(promises) / count, sum(promises) / count)
