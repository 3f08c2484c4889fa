"""Find the actuators of abduction, which swing a finger sideways instead of bending it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rtee.hand.frames import PARALLEL, tip_pose_and_jacobian
from rtee.hand.model import Finger, Hand
from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, JointKind

_ACROSS: Final = 0.5
"""Largest cosine of the angle between transverse axes: 60 degrees."""

_MIDDLE: Final = 0.2
"""Largest distance of the rest position from the middle of the range [fraction of the range]."""

_ACTUATORS: Final = 2
"""Least number of actuators with parallel axes that bend the finger. With a single one, bending
cannot be distinguished from swinging."""

_JOINTS: Final = 3
"""Least number of joints with transverse axes, as in fingers with three phalanges. All motion of a
finger with two phalanges counts as bending, as in the paper."""


def abduction(hand: Hand, finger: Finger) -> tuple[str, ...]:
    """Return the actuators that swing a finger sideways, nearest the palm first.

    Such an actuator moves only this finger and rests in the middle of its range. It rotates the
    fingertip about an axis transverse to the parallel axes of at least two other actuators, which
    bend the finger, and to those of at least three joints. Axes are compared at rest.
    """
    if finger.tip is None or len(finger.own) <= _ACTUATORS:
        return ()
    turning = tip_pose_and_jacobian(hand, finger.tip, hand.rest)[1][3:]
    axes: dict[str, FloatArray] = {}
    for name in finger.own:
        axis = turning[:, hand.actuator_index(name)]
        # Zero for an actuator that translates the tip without rotating it.
        length = float(np.linalg.norm(axis))
        if hand.actuator(name).kind is not JointKind.PRISMATIC and length > 0.0:
            axes[name] = axis / length
    bending = _bending(hand, axes)
    if len(bending) < _ACTUATORS:
        return ()
    found = []
    for name, axis in axes.items():
        across = [n for n, other in axes.items() if abs(float(axis @ other)) <= _ACROSS]
        if (
            _rests_in_the_middle(hand.actuator(name))
            and set(bending) <= set(across)
            and _joints(hand, finger.tip, across) >= _JOINTS
        ):
            found.append(name)
    return tuple(found)


def _bending(hand: Hand, axes: dict[str, FloatArray]) -> tuple[str, ...]:
    """Return the actuators with parallel axes that together bend the finger farthest."""
    groups = [
        tuple(name for name, axis in axes.items() if abs(float(axis @ axes[first])) >= PARALLEL)
        for first in axes
    ]
    # By the sum of their ranges, not their number, so that joints of small range count less.
    return max(groups, key=lambda group: sum(_span(hand.actuator(n)) for n in group), default=())


def _joints(hand: Hand, tip: str, actuators: Sequence[str]) -> int:
    """Return how many joints on the path to a fingertip are moved by some actuators."""
    moving = {hand.actuator_index(name) for name in actuators}
    rows = (hand.joint_index(joint.name) for joint in hand.urdf.path_to(tip) if joint.moving)
    return sum(hand.transmission.moves(row) in moving for row in rows)


def _span(actuator: ActuatorSpec) -> float:
    """Return the range of an actuator, one turn if it has no limits [rad]."""
    span = actuator.upper - actuator.lower
    return span if np.isfinite(span) else 2.0 * np.pi


def _rests_in_the_middle(actuator: ActuatorSpec) -> bool:
    span = actuator.upper - actuator.lower
    if not np.isfinite(span):
        return False
    return abs(actuator.rest - (actuator.lower + actuator.upper) / 2.0) <= _MIDDLE * span
