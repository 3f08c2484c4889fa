"""Opposition of the forces of two tips in a pinch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import coal
import numpy as np

from rtee.actions.types import Opposition
from rtee.extract.pairs import LinkPair, Witness
from rtee.extract.scene import Scene
from rtee.hand.linalg import dot, matvec, norm
from rtee.sample import FloatArray

FRICTION: Final = 0.5
"""Coefficient of friction: rubber on most surfaces has more, bare plastic less."""

BALL: Final = 0.005
"""Radius of a small ball [m] that two fingertips can hold and most hands can close on."""

_STILL: Final = 1e-3
"""Speed of a tip, as a share of the other tip's speed, below which it counts as still."""

_TOUCH: Final = 1e-6
"""Largest gap that counts as contact [m]: far below the ball's radius, above rounding errors."""

_NO_SPEED: Final = 1e-9
"""Speed per unit of the path [m] below which it is only a rounding error."""

_FAR: Final = 1.0
"""Longest motion of a tip backward or forward to meet the ball [m]: larger than any hand."""


def opposition(
    scene: Scene, tips: LinkPair, witness: Witness, direction: FloatArray
) -> Opposition | None:
    """Return the opposition of two tips at the current posture of the scene.

    The closing direction of a tip is the velocity of its contact point on the straight path from
    rest; for a tip that does not move, the reversed velocity of the other tip. The angle of a tip
    is the one between its closing direction and its outward contact normal.

    A small ball is placed at the contact. Each tip moves back along its closing direction until it
    just touches the ball, where it would meet the ball when closing. The grasp is in force closure
    if the line between the two contact points lies within both friction cones (Nguyen, 1988).

    Args:
        scene: The scene at the posture.
        tips: The tips.
        witness: Their contact, or their closest points.
        direction: Displacement of the actuators from rest ``(n,)`` [rad | m].

    Returns:
        The opposition, or ``None`` if it is unknown, or the tips do not move relative to each
        other.
    """
    closing = [
        matvec(scene.point_jacobian(link, point), direction)
        for link, point in zip(tips.links, (witness.first, witness.second), strict=True)
    ]
    speeds = [norm(v) for v in closing]
    if max(speeds) < _NO_SPEED or norm(closing[0] - closing[1]) < _NO_SPEED:
        return None
    # If Coal found no points or no normal, the opposition is unknown.
    if not np.isfinite(speeds).all() or norm(witness.normal) < 0.5:
        return None
    for i in (0, 1):
        if speeds[i] < _STILL * speeds[1 - i]:
            # Seen from a still tip, the other one approaches.
            closing[i] = -closing[1 - i]
    lines = [v / norm(v) for v in closing]
    outward = (witness.normal, -witness.normal)
    angles = [_angle(line, normal) for line, normal in zip(lines, outward, strict=True)]
    centre = (witness.first + witness.second) / 2.0
    contacts = [
        _meet(scene, shapes, line, centre) for shapes, line in zip(tips.shapes, lines, strict=True)
    ]
    closed = all(c is not None for c in contacts) and force_closure(
        [c for c in contacts if c is not None], centre, FRICTION
    )
    return Opposition((angles[0], angles[1]), closed, FRICTION)


def force_closure(contacts: list[FloatArray], centre: FloatArray, friction: float) -> bool:
    """Return whether the line between two contacts lies within both friction cones.

    Args:
        contacts: Two points on the ball's surface ``(3,)`` [m].
        centre: The ball's centre ``(3,)`` [m].
        friction: Coefficient of friction.
    """
    line = contacts[1] - contacts[0]
    if norm(line) < 1e-12:  # both tips meet the ball at one point, and cannot hold it
        return False
    # Half the angle of the friction cone.
    half = math.atan(friction)
    inward = [centre - contact for contact in contacts]
    return _angle(line, inward[0]) <= half and _angle(-line, inward[1]) <= half


def _meet(
    scene: Scene, shapes: Sequence[int], line: FloatArray, centre: FloatArray
) -> FloatArray | None:
    """Return the point where a tip closing along a line first touches the ball [m], or ``None``."""
    radius = BALL * scene.unit
    ball = coal.Sphere(radius)
    # The ball moves instead of the tip, so that the scene stays unchanged.
    gap, towards = _gap(scene, shapes, ball, centre)
    if gap > 0.0:
        # Conservative advancement: a motion by the gap never passes the first contact.
        drawn_back = 0.0
        while gap > _TOUCH:
            drawn_back -= gap
            if drawn_back < -_FAR:
                return None
            gap, towards = _gap(scene, shapes, ball, centre + drawn_back * line)
        return centre + radius * towards
    # The tip overlaps the ball; move it back until it leaves the ball, then bisect.
    low, high = 0.0, radius
    while _gap(scene, shapes, ball, centre + high * line)[0] <= 0.0:
        low, high = high, 2.0 * high
        if high > _FAR:
            return None
    while high - low > _TOUCH:
        middle = (low + high) / 2.0
        if _gap(scene, shapes, ball, centre + middle * line)[0] <= 0.0:
            low = middle
        else:
            high = middle
    return centre + radius * _gap(scene, shapes, ball, centre + high * line)[1]


def _gap(
    scene: Scene, shapes: Sequence[int], ball: coal.Sphere, centre: FloatArray
) -> tuple[float, FloatArray]:
    """Return a link's signed distance from a ball, and the direction from the ball to the link.

    Moving the ball forward is the same as moving the tip back.
    """
    request, least, towards = coal.DistanceRequest(), math.inf, np.zeros(3)
    at = coal.Transform3s(np.eye(3), centre)
    for i in shapes:
        pose = scene.shape_pose(i)
        result = coal.DistanceResult()
        there = coal.Transform3s(pose.rotation, pose.translation)
        shape = scene.shapes[i].convex
        distance = coal.distance(ball, at, shape, there, request, result)
        if distance < least:
            least, towards = distance, np.array(result.normal)
    return least, towards


def _angle(a: FloatArray, b: FloatArray) -> float:
    cosine = dot(a, b) / (norm(a) * norm(b))
    return math.acos(min(1.0, max(-1.0, cosine)))
