"""Levers of the actuators on their fingertips: the effort that balances a force at a fingertip.

For actions without an opening, whose levers no table gives.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from rtee.hand.frames import tip_pose_and_jacobian
from rtee.hand.model import Finger, Hand
from rtee.sample import FloatArray

_HOLDS: Final = 0.1
"""A lever is used for this long before it is computed again [s]: at the 0.1 rad/s of a touch, a
finger turns by half a degree in that time."""


class TipLevers:
    r"""The levers of fingertips at a hand's present posture.

    The effort :math:`\tau = F\,r` with :math:`r = |J\,\partial q/\partial u|` balances a force
    :math:`F` against the motion of a fingertip, by virtual work (Murray, Li, Sastry: *A
    Mathematical Introduction to Robotic Manipulation*, 1994, chapter 5). :math:`J` is the Jacobian
    of the point where the fingertip is likely to touch: the centre of its collision shape farthest
    from the last joint.
    """

    def __init__(self, hand: Hand) -> None:
        self._hand = hand
        # Computed at rest before the loop runs: all at once would take several ticks.
        self._known = dict(enumerate((lever, -math.inf) for lever in _at_rest(hand)))
        self._renewed = -math.inf

    def of(self, i: int, stamp: float, position: Sequence[float]) -> float:
        """Return the lever of an actuator [m/rad | 1]; ``NaN`` if it moves no fingertip.

        Of several fingers, the one that moves farthest counts, since its force is the least. At
        most one lever is computed per tick, to keep ticks short.

        Args:
            i: The actuator's index.
            stamp: Now [s].
            position: Positions of all actuators [rad | m].
        """
        lever, at = self._known[i]
        if stamp - at < _HOLDS or stamp == self._renewed:
            return lever
        self._renewed = stamp
        # Unmeasured actuators count as at rest: a finger's other joints change the lever little.
        u = np.where(np.isfinite(position), position, self._hand.rest)
        self._known[i] = _lever(self._hand, i, u), stamp
        return self._known[i][0]


@lru_cache(maxsize=8)
def _at_rest(hand: Hand) -> list[float]:
    """Return the levers of all actuators at rest; trials make many controllers of a hand."""
    return [_lever(hand, i, hand.rest) for i in range(len(hand.actuators))]


def _lever(hand: Hand, i: int, u: FloatArray) -> float:
    """Return an actuator's lever at positions ``(n,)`` [m/rad | 1]; ``NaN`` without a fingertip."""
    names = hand.actuators[i].fingers
    fingers = [f for f in hand.fingers if f.name in names and f.tip is not None]
    levers = [_at(hand, finger, i, u) for finger in fingers]
    most = max(levers, default=math.nan)
    return most if most > 0.0 else math.nan


def _at(hand: Hand, finger: Finger, i: int, u: FloatArray) -> float:
    pose, jacobian = tip_pose_and_jacobian(hand, str(finger.tip), u)
    # From the link's origin to the point, at the velocity v + ω × r.
    arm = pose[:3, :3] @ _point(hand, finger)
    return float(np.linalg.norm(jacobian[:3, i] + np.cross(jacobian[3:, i], arm)))


@lru_cache(maxsize=64)
def _point(hand: Hand, finger: Finger) -> FloatArray:
    """Return the point of a fingertip that is likely to touch, in its link's frame ``(3,)`` [m]."""
    tip = np.linalg.inv(tip_pose_and_jacobian(hand, str(finger.tip), hand.rest)[0])
    middles = []
    for link in finger.tip_links:
        # Welded to the tip, so that any posture gives the same pose.
        in_tip = tip @ tip_pose_and_jacobian(hand, link, hand.rest)[0]
        shapes = hand.urdf.links[link].collisions
        middles += [(in_tip @ [*shape.xyz, 1.0])[:3] for shape in shapes]
    return max(middles, key=lambda middle: float(np.linalg.norm(middle)))
