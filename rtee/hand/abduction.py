"""Find the actuators that swing a finger sideways instead of bending it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rtee.hand.frames import tip_pose_and_jacobian
from rtee.hand.model import Finger, Hand
from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, JointKind

_PARALLEL: Final = 0.9
"""Least cosine of the angle of axes that count as parallel: 26 degrees."""

_ACROSS: Final = 0.5
"""Greatest cosine of the angle of an axis that lies across others: they enclose 60 degrees."""

_MIDDLE: Final = 0.2
"""Rest is in the middle of a range within this share of it to either side."""

_ACTUATORS: Final = 2
"""Fewest actuators with parallel axes that bend the finger. With a single one, bending cannot be
told from swinging."""

_JOINTS: Final = 3
"""Fewest joints across its axis, as in fingers with three phalanges. Where a finger with two turns
as a whole, all of its motion counts as bending, as in the paper."""


def abduction(hand: Hand, finger: Finger) -> tuple[str, ...]:
    """Return the actuators that swing a finger sideways, nearest the palm first.

    Such an actuator rests in the middle of its range and turns the fingertip about an axis across
    those by which the finger bends, which at least two other actuators share; three joints or more
    lie across it. It is one of those that move this finger only. Axes are compared at rest.
    """
    if finger.tip is None or len(finger.own) <= _ACTUATORS:
        return ()
    turning = tip_pose_and_jacobian(hand, finger.tip, hand.rest)[1][3:]
    axes: dict[str, FloatArray] = {}
    for name in finger.own:
        axis = turning[:, hand.actuator_index(name)]
        # Zero for what shifts the tip without turning it, such as a slide.
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
    """Return the actuators with about parallel axes that bend the finger farthest together."""
    groups = [
        tuple(name for name, axis in axes.items() if abs(float(axis @ axes[first])) >= _PARALLEL)
        for first in axes
    ]
    # The largest sum of ranges, not the largest number: an idle joint more must not decide.
    return max(groups, key=lambda group: sum(_span(hand.actuator(n)) for n in group), default=())


def _joints(hand: Hand, tip: str, actuators: Sequence[str]) -> int:
    """Return how many joints on the way to a fingertip some actuators move."""
    rows = {joint.name: row for row, joint in enumerate(hand.joints)}
    moving = {hand.actuator_index(name) for name in actuators}
    way = (rows[joint.name] for joint in hand.urdf.path_to(tip) if joint.moving)
    return sum(hand.transmission.moves(row) in moving for row in way)


def _span(actuator: ActuatorSpec) -> float:
    """Return the range of an actuator, one turn if it has no limits [rad]."""
    span = actuator.upper - actuator.lower
    return span if np.isfinite(span) else 2.0 * np.pi


def _rests_in_the_middle(actuator: ActuatorSpec) -> bool:
    span = actuator.upper - actuator.lower
    if not np.isfinite(span):
        return False
    return abs(actuator.rest - (actuator.lower + actuator.upper) / 2.0) <= _MIDDLE * span
