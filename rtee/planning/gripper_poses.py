"""Use planners' grasps of parallel grippers, each a pose and a width, with any hand.

Inside rtee a gripper's pose is that of GraspNet: x is the approach, y the direction in which the
fingers close, and the origin lies between the ends of the fingers.

| planner | array | read by |
| --- | --- | --- |
| GraspNet-1Billion, AnyGrasp | ``(n, 17)`` | `from_graspnet` |
| Contact-GraspNet | poses ``(n, 4, 4)`` and openings ``(n,)`` | `from_base_poses` |
| GraspGen and others that give the pose of a gripper's base | poses ``(n, 4, 4)`` | the same |
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from rtee.actions.naming import label
from rtee.actions.openings import MARGIN, OpeningTable, best_for
from rtee.actions.types import Action
from rtee.errors import ConfigError, suggestion
from rtee.hand.frames import homogeneous
from rtee.hand.model import Hand
from rtee.planning.closing import ActionPath
from rtee.planning.collisions import GraspCollisions
from rtee.planning.frames import (
    checked_direction,
    checked_pose,
    direction_of,
    flange_rows,
    retreated,
    rows,
)
from rtee.planning.grasp_solution import GraspSolution
from rtee.planning.objects import GraspObject
from rtee.planning.tips import Fingertips
from rtee.sample import FloatArray
from rtee.types import from_rest

_COLUMNS: Final = 17
"""Columns of a GraspNet array: score, width, height, depth, rotation (9), translation (3),
object."""

_AXES: Final = {"x": 0, "y": 1, "z": 2}

_STEP: Final = 0.02
"""Step of intensity that determines the direction in which tips close."""

_ROUNDS: Final = 5
"""Steps in which the middle between tips is found; two suffice for those of a parallel gripper."""


@dataclass(frozen=True)
class GripperPose:
    """A grasp of a parallel gripper.

    Attributes:
        pose: Its pose ``(4, 4)`` in the planner's frame: x approach, y closing, origin between the
            ends of the fingers [m].
        width: Width of the object between the fingers [m].
        score: The planner's score; the higher the better.
    """

    pose: FloatArray
    width: float
    score: float = 0.0


def from_graspnet(array: ArrayLike) -> list[GripperPose]:
    """Return the grasps in a GraspNet array, in its order, such as AnyGrasp's.

    The translation is a point on the object, and the ends of the fingers are ``depth`` beyond it
    along the approach (graspnetAPI, "Grasp Label Format").

    Args:
        array: ``(n, 17)``, or one grasp ``(17,)``: score, width, height, depth [m], rotation row by
            row, translation [m], and the object's number.

    Raises:
        ConfigError: if the array has another shape, or numbers that are not finite.
    """
    found = _numbers(array, "a GraspNet array")
    found = found[None] if found.ndim == 1 else found
    if found.ndim != 2 or found.shape[1] != _COLUMNS:
        raise ConfigError(f"a GraspNet array has {_COLUMNS} columns, not the shape {found.shape}")
    made = []
    for number, row in enumerate(found):
        turned = row[4:13].reshape(3, 3)
        pose = homogeneous(turned, row[13:16] + row[3] * turned[:, 0])
        made.append(_grasp(pose, row[1], row[0], number))
    return made


def from_base_poses(
    poses: ArrayLike,
    widths: ArrayLike,
    *,
    depth: float,
    approach: str = "z",
    closing: str = "x",
    scores: ArrayLike | None = None,
) -> list[GripperPose]:
    """Return grasps given by the pose of a gripper's base, in their order.

    Contact-GraspNet: its ``pred_grasps_cam`` and ``gripper_openings``, with the depth 0.1034 m of
    the Franka hand. GraspGen: the depth is in the configuration of the gripper it was trained for,
    and it gives no widths: give the object's.

    Args:
        poses: ``(n, 4, 4)``, or one ``(4, 4)``.
        widths: Width of the object ``(n,)``, or one for all [m].
        depth: From the base to the ends of the fingers, along the approach [m].
        approach: The base's axis along which it approaches: ``x``, ``y`` or ``z``.
        closing: The base's axis along which its fingers close.
        scores: The planner's scores ``(n,)``.

    Raises:
        ConfigError: if an array has another shape, or the axes are the same.
    """
    found = _numbers(poses, "an array of poses")
    found = found[None] if found.ndim == 2 else found
    if found.shape[1:] != (4, 4):
        raise ConfigError(f"poses must be 4 by 4 matrices, not of the shape {found.shape}")
    if {approach, closing} - _AXES.keys() or approach == closing:
        raise ConfigError(
            f"approach and closing must be two of x, y and z, not '{approach}' and '{closing}'"
        )
    if not math.isfinite(depth):
        raise ConfigError(f"a depth must be a finite number of metres, not {depth:g}")
    wide, good = (
        _for_each(values, len(found), what)
        for values, what in ((widths, "widths"), (0.0 if scores is None else scores, "scores"))
    )
    made = []
    for number, base in enumerate(found):
        checked = checked_pose(base, f"the pose of grasp {number}")
        x, y = checked[:3, _AXES[approach]], checked[:3, _AXES[closing]]
        turned = np.column_stack([x, y, np.cross(x, y)])
        pose = homogeneous(turned, checked[:3, 3] + depth * x)
        made.append(_grasp(pose, wide[number], good[number], number))
    return made


def _numbers(values: ArrayLike, what: str) -> FloatArray:
    try:
        found = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{what} must consist of numbers") from None
    if not np.isfinite(found).all():
        raise ConfigError(f"{what} must consist of finite numbers")
    return found


def _for_each(values: ArrayLike, count: int, what: str) -> FloatArray:
    found = _numbers(values, f"an array of {what}")
    if found.ndim == 0:
        return np.full(count, float(found))
    if found.shape != (count,):
        raise ConfigError(f"{count} poses need {count} {what}, not the shape {found.shape}")
    return found


def _grasp(pose: FloatArray, width: Any, score: Any, number: int) -> GripperPose:
    if not width >= 0.0:
        raise ConfigError(f"the width of grasp {number} must be 0 m or more, not {float(width):g}")
    return GripperPose(
        checked_pose(pose, f"the pose of grasp {number}"), float(width), float(score)
    )


def reach_gripper_pose(
    hand: Hand,
    actions: Iterable[tuple[Action, OpeningTable]],
    grasp: GripperPose,
    *,
    fingers: Sequence[str] = (),
    approach: Sequence[float] | None = None,
    retreat: float = 0.1,
    margin: float = MARGIN,
    tips: Fingertips | None = None,
    obj: GraspObject | None = None,
    object_pose: FloatArray | None = None,
) -> GraspSolution:
    """Return the action, posture and palm pose by which a hand executes a gripper's grasp.

    The midpoint between the fingertips, at the opening of the object's width, is placed at that of
    the gripper, with the same direction of closing. The tips reach as far along the approach as the
    gripper's fingers.

    Args:
        hand: The hand.
        actions: Its actions with their openings.
        grasp: The gripper's grasp.
        fingers: The fingers to grasp with; whichever suit best unless given.
        approach: Direction in which the palm approaches, in the planner's frame; the gripper's
            unless given.
        retreat: Distance of the palm along it before the approach [m].
        margin: How much wider the hand opens before it closes [m].
        tips: The fingertips, where their geometry was read already.
        obj: The object, or another obstacle, to check for collisions; without one, only those of
            the hand with itself are checked.
        object_pose: Its pose ``(4, 4)`` in the planner's frame; that frame's unless given.

    Raises:
        ConfigError: if a value is invalid, or no action has this opening; names the nearest.
        ModelError: if a mesh of the hand is missing or cannot be read.
    """
    for name in fingers:
        if name not in hand.finger_names:
            raise ConfigError(f"unknown finger '{name}'; {suggestion(name, hand.finger_names)}")
    if not (math.isfinite(margin) and margin >= 0.0):
        raise ConfigError(f"a margin must be 0 m or more, not {margin:g}")
    action, opening = _best(list(actions), grasp.width, fingers, margin, hand)
    tips = tips or Fingertips(hand)
    at = opening.intensity_at(grasp.width)
    before = opening.intensity_at(min(grasp.width + margin, opening.widest))
    there = grasp_frame(tips, action, opening, at)
    palm = checked_pose(grasp.pose, "the gripper's pose") @ np.linalg.inv(there)
    direction = grasp.pose[:3, 0] if approach is None else checked_direction(approach)
    object_in_palm = np.linalg.inv(palm) @ checked_pose(object_pose, "the object's pose")
    collisions = GraspCollisions(hand, tips.geometry, obj, object_in_palm)
    goal, rest = ActionPath.of(hand, action).end, np.array(hand.rest)
    touching = collisions.at(from_rest(rest, goal, at), opening.fingers)
    early = collisions.at(from_rest(rest, goal, before), (), "pre_grasp")
    return GraspSolution(
        hand=hand.name,
        fingers=opening.fingers,
        posture=_positions(hand, action, opening, at),
        pre_grasp=_positions(hand, action, opening, before),
        palm_pose=rows(palm),
        pre_palm_pose=rows(retreated(palm, direction, retreat)),
        flange_pose=flange_rows(hand, palm),
        pre_flange_pose=flange_rows(hand, retreated(palm, direction, retreat)),
        action=action.name,
        elements=action.elements,
        intensity=at,
        pre_intensity=before,
        width=grasp.width,
        collisions=touching + early,
    )


def _best(
    actions: Sequence[tuple[Action, OpeningTable]],
    width: float,
    fingers: Sequence[str],
    margin: float,
    hand: Hand,
) -> tuple[Action, OpeningTable]:
    """Return the action that suits a width best; see `best_for`."""
    able = [pair for pair in actions if not fingers or set(fingers) == set(pair[1].fingers)]
    if not able:
        raise ConfigError(f"no action of '{hand.name}' opposes exactly {', '.join(fingers)}")
    fits = [pair for pair in able if pair[1].narrowest <= width < pair[1].widest]
    if fits:
        return best_for(hand, fits, width, margin)
    action, opening = min(
        able, key=lambda pair: max(pair[1].narrowest - width, width - pair[1].widest)
    )
    name = label(action.name, action.elements)
    raise ConfigError(
        f"no action of '{hand.name}' grasps {1e3 * width:.1f} mm; the nearest, {name}, opens "
        f"{1e3 * opening.narrowest:.1f} to {1e3 * opening.widest:.1f} mm"
    )


def grasp_frame(
    tips: Fingertips, action: Action, opening: OpeningTable, intensity: float
) -> FloatArray:
    """Return the pose ``(4, 4)`` of a hand's grasp in its base frame; axes as in `GripperPose`.

    Raises:
        ConfigError: if the tips meet at the base frame's origin, which gives no direction of reach.
    """
    hand = tips.hand
    goal = ActionPath.of(hand, action).end
    one, *others = opening.sides
    other = [finger for side in others for finger in side]
    # Backwards at the end of the path: beyond intensity 1 there is no posture.
    step = _STEP if intensity + _STEP <= 1.0 else -_STEP

    tips.go(from_rest(np.array(hand.rest), goal, intensity))
    middle = tips.middle(opening.fingers)
    # The middle depends on the tips' nearest points, and these on the middle.
    for _ in range(_ROUNDS):
        near = {finger: tips.near(finger, middle)[1] for finger in opening.fingers}
        ends = [np.mean([near[f] for f in side], axis=0) for side in (one, other)]
        middle = 0.5 * (ends[0] + ends[1])
    # The same points of the tips are followed: the nearest ones would slide along them.
    local = {finger: tips.in_tip(finger, near[finger]) for finger in opening.fingers}
    before = {finger: tips.from_tip(finger, local[finger]) for finger in opening.fingers}
    tips.go(from_rest(np.array(hand.rest), goal, intensity + step))
    moved = {f: (tips.from_tip(f, local[f]) - before[f]) / step for f in opening.fingers}
    closing = np.mean([moved[f] for f in other], axis=0) - np.mean([moved[f] for f in one], axis=0)
    closing /= np.linalg.norm(closing)
    # Moved back after the difference: `reach` uses the last placement of the hand.
    tips.go(from_rest(np.array(hand.rest), goal, intensity))

    # Perpendicular to the closing, as the axes of the gripper's pose are.
    along = direction_of(
        middle - closing * float(middle @ closing),
        f"the fingertips of {opening.label} meet at the origin of the hand's base link: their "
        "direction of reach is not known",
    )
    # The side that reaches less decides: beyond it, only the other side would touch.
    reach = min(max(tips.reach(f, along) for f in side) for side in (one, other))
    turned = np.column_stack([along, closing, np.cross(along, closing)])
    return homogeneous(turned, middle + (reach - float(middle @ along)) * along)


def _positions(
    hand: Hand, action: Action, opening: OpeningTable, intensity: float
) -> dict[str, float]:
    u = from_rest(np.array(hand.rest), ActionPath.of(hand, action).end, intensity)
    return {name: float(u[hand.actuator_index(name)]) for name in opening.actuators}
