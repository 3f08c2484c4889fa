"""Rate how well the forces of two tips oppose each other at a pinch."""

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
"""Radius of the small ball [m]: what two fingertips can hold and most hands can close on."""

_STILL: Final = 1e-3
"""A tip that moves less than this share of the other one counts as still."""

_TOUCH: Final = 1e-6
"""A gap that counts as touching [m]: far below the ball's radius, above rounding errors."""

_NO_SPEED: Final = 1e-9
"""Speeds per unit of the path that are rounding errors [m]."""

_FAR: Final = 1.0
"""How far a tip is drawn back or moved on to meet the ball [m]: larger than any hand."""


def opposition(
    scene: Scene, tips: LinkPair, witness: Witness, direction: FloatArray
) -> Opposition | None:
    """Return how well two tips oppose each other at the posture where the scene is placed.

    The line of closing of a tip is the velocity of its contact point on the straight path from
    rest. A tip that does not move closes by the other one's motion, reversed. The angle of a tip is
    that between its line of closing and the contact normal that points out of it.

    The small ball is put at the contact. Each tip is drawn back along its line of closing until it
    just touches the ball: there it would meet the ball when it closes. The grasp is in force
    closure if the line between the two contact points lies within both cones of friction (Nguyen,
    1988).

    Args:
        scene: The scene, placed.
        tips: The tips.
        witness: Their contact, or where they are closest.
        direction: The path from rest ``(n,)`` [rad | m].

    Returns:
        The opposition, or ``None`` if the tips do not move against each other there.
    """
    closing = [
        matvec(scene.point_jacobian(link, point), direction)
        for link, point in zip(tips.links, (witness.first, witness.second), strict=True)
    ]
    speeds = [norm(v) for v in closing]
    if max(speeds) < _NO_SPEED or norm(closing[0] - closing[1]) < _NO_SPEED:
        return None
    if (
        not np.isfinite(speeds).all() or norm(witness.normal) < 0.5
    ):  # no unit vector: none was found
        return None
    for i in (0, 1):
        if speeds[i] < _STILL * speeds[1 - i]:
            # Seen from a still tip, it is the other one that comes.
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
    """Return whether two contacts hold a ball: their line lies within both cones of friction.

    Args:
        contacts: Two points on the ball's surface ``(3,)`` [m].
        centre: The ball's centre ``(3,)`` [m].
        friction: Coefficient of friction.
    """
    line = contacts[1] - contacts[0]
    if norm(line) < 1e-12:
        return False
    # The half angle of the cone of friction.
    half = math.atan(friction)
    inward = [centre - contact for contact in contacts]
    return _angle(line, inward[0]) <= half and _angle(-line, inward[1]) <= half


def _meet(
    scene: Scene, shapes: Sequence[int], line: FloatArray, centre: FloatArray
) -> FloatArray | None:
    """Return where a tip that closes along a line first touches the ball, on the ball [m]."""
    ball = coal.Sphere(BALL)
    # The ball moves instead of the tip: the scene stays where it is placed.
    gap, towards = _gap(scene, shapes, ball, centre)
    if gap > 0.0:
        # Conservative advancement: moving by the gap never passes the first contact.
        drawn_back = 0.0
        while gap > _TOUCH:
            drawn_back -= gap
            if drawn_back < -_FAR:
                return None
            gap, towards = _gap(scene, shapes, ball, centre + drawn_back * line)
        return _on_ball(centre, towards)
    # The tip overlaps the ball: it is drawn back until it leaves the ball, then bisected.
    low, high = 0.0, BALL
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
    return _on_ball(centre, _gap(scene, shapes, ball, centre + high * line)[1])


def _on_ball(centre: FloatArray, towards: FloatArray) -> FloatArray:
    contact: FloatArray = centre + BALL * towards
    return contact


def _gap(
    scene: Scene, shapes: Sequence[int], ball: coal.Sphere, centre: FloatArray
) -> tuple[float, FloatArray]:
    """Return the signed distance of a link from a ball and the direction from it to the link.

    Drawing the tip back from the ball and moving the ball on from the tip are the same.
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
