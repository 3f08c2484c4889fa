"""How a hand closes on an object: link after link until they oppose each other; no dynamics.

The object is pushed by what touches it, without turning, until the forces of the contacts can
balance, friction included. Then the actuators of the links that touch stand still, and the others
go on until they touch, too, or are at the action's end: an actuator stalls where its link is
blocked, as those of a real hand do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.actions.types import Action
from rtee.hand.model import Hand
from rtee.planning.result import Contact
from rtee.planning.scene import TOUCH, GraspScene, HandPose, Touch
from rtee.planning.wrench import balanced, cone
from rtee.types import BoolArray, FloatArray

STEPS: Final = 16
"""Steps of the table of an action's way; a step of a finger is about 6 mm."""

_STEP: Final = 1.0 / 32.0
"""Step of intensity while links touch: about 3 mm of a fingertip's way."""

_SLOWEST: Final = 0.3
"""Gaps below this many steps count as contact."""

_PUSHES: Final = 4
"""Pushes that one step may take until nothing is inside the object."""

_INSIDE: Final = 1.5e-3
"""A link that stays this deep inside the object is blocked [m]."""

_FARTHEST: Final = 0.05
"""An object that was pushed farther has escaped [m]."""

_MOVES: Final = 1e-6
"""Actuators whose set-points differ by less don't move [rad | m]."""


@dataclass(frozen=True)
class ActionWay:
    """The way of an action from rest, at intensities.

    Attributes:
        hand: The hand.
        knots: Actuator positions at rest and after each inner action ``(m + 1, n)`` [rad | m].
    """

    hand: Hand
    knots: FloatArray

    @classmethod
    def of(cls, hand: Hand, action: Action) -> ActionWay:
        """Return the way of an action."""
        knots = [np.array(hand.rest)]
        for posture in action.waypoints:
            after = knots[-1].copy()
            for name in posture.involved:
                after[hand.actuator_index(name)] = posture.position[name]
            knots.append(after)
        return cls(hand, np.array(knots))

    def at(self, shares: FloatArray | float) -> FloatArray:
        """Return actuator positions ``(n,)`` [rad | m].

        Args:
            shares: How far each actuator has come ``(n,)``, or all, from 0 to 1.
        """
        count = len(self.knots) - 1
        along = np.broadcast_to(np.asarray(shares, dtype=np.float64), self.knots.shape[1:]) * count
        leg = np.minimum(along.astype(np.int64), count - 1)
        rows = np.arange(self.knots.shape[1])
        begin, end = self.knots[leg, rows], self.knots[leg + 1, rows]
        found: FloatArray = begin + (along - leg) * (end - begin)
        return found

    @property
    def moving(self) -> BoolArray:
        """Which actuators it moves ``(n,)``."""
        moves: BoolArray = np.ptp(self.knots, axis=0) > _MOVES
        return moves


@dataclass(frozen=True)
class Closure:
    """A hand that has closed on an object.

    Attributes:
        pose: Pose of the object ``(4, 4)`` in the base frame, where it was pushed to.
        shares: How far each actuator came ``(n,)``, 0 to 1 of the action.
        u: Actuator positions ``(n,)`` [rad | m].
        first: Intensity at which the contacts first opposed each other.
        contacts: The contacts.
        blocked: Which actuators were blocked ``(n,)``.
    """

    pose: FloatArray
    shares: FloatArray
    u: FloatArray
    first: float
    contacts: tuple[Contact, ...]
    blocked: BoolArray


class Closing:
    """Closes a hand by an action; its table of the way serves all poses of the object."""

    def __init__(self, scene: GraspScene, way: ActionWay, friction: float) -> None:
        """Make the table.

        Args:
            scene: The hand and the object.
            way: The action's way.
            friction: Coefficient of friction between the hand and the object.
        """
        self.scene, self.way, self.friction = scene, way, friction
        self.grid: FloatArray = np.linspace(0.0, 1.0, STEPS + 1)
        self.table: list[HandPose] = [scene.posed(way.at(float(s))) for s in self.grid]
        steps = [scene.speeds(a, b) for a, b in zip(self.table, self.table[1:], strict=False)]
        self._speed = np.max(steps, axis=0) * STEPS
        """How fast each shape moves at most [m per unit of intensity]."""
        kinematics = scene.geometry.kinematics
        drive = np.array(
            [
                kinematics.support(shape.body) @ np.abs(scene.hand.transmission.jacobian(u)) > 0.0
                for shape in scene.geometry.shapes
                for u in (way.at(1.0),)
            ]
        )
        self._drives = drive & way.moving
        """Which moving actuators move each shape ``(shapes, n)``."""

    def close(self, pose: FloatArray, begin: float = 0.0) -> Closure | None:
        """Close on an object.

        Args:
            pose: Where the object is at first ``(4, 4)``, free of the hand.
            begin: Intensity from which the hand closes.

        Returns:
            The closed hand, or ``None`` where it never holds the object from two sides.
        """
        start, pose = pose, pose.copy()
        s = self._until_contact(begin, pose)
        shares = np.full(len(self.scene.hand.rest), s)
        blocked: BoolArray = ~self.way.moving
        first = -1.0
        while True:
            at = self.scene.posed(self.way.at(shares))
            touches = self.scene.touching(at, pose)
            if first < 0.0:
                touches = self._push(touches, at, pose)
                if float(np.linalg.norm(pose[:3, 3] - start[:3, 3])) > _FARTHEST:
                    return None
            if touches and self._opposed(touches):
                first = s if first < 0.0 else first
                for touch in touches:
                    blocked = blocked | self._drives[touch.shape]
            if blocked.all() or s >= 1.0:
                break
            s = min(1.0, s + _STEP)
            shares = np.where(blocked, shares, s)
        if first < 0.0:
            return None
        contacts = tuple(self.scene.contacts(touches, at, pose))
        u = self.way.at(shares)
        return Closure(pose, shares, u, first, contacts, blocked & self.way.moving)

    def _until_contact(self, s: float, pose: FloatArray) -> float:
        """Return the intensity just before a moving link touches (conservative advancement)."""
        floor = _SLOWEST * _STEP
        speed = np.maximum(self._speed, 1e-9)
        while s < 1.0:
            at = self.scene.posed(self.way.at(s))
            room = self.scene.bounds(at, pose) / speed
            least = 1.0
            for shape in np.argsort(room, kind="stable").tolist():
                if room[shape] >= least:
                    break
                least = min(least, self.scene.touch(shape, at, pose).distance / speed[shape])
                if least < floor:
                    return s
            s = min(1.0, s + least)
        return 1.0

    def _push(self, touches: list[Touch], at: HandPose, pose: FloatArray) -> list[Touch]:
        """Move the object out of the links that push it, unless they oppose each other."""
        for _ in range(_PUSHES):
            deep = [touch for touch in touches if touch.distance < 0.0]
            if not deep or self._opposed(touches):
                break
            for touch in deep:
                pose[:3, 3] += (TOUCH / 2.0 - touch.distance) / len(deep) * touch.normal
            touches = self.scene.touching(at, pose)
        return touches

    def _opposed(self, touches: Sequence[Touch]) -> bool:
        """Return whether forces at the contacts can balance, with friction."""
        if len(touches) < 2:
            return False
        if all(touch.distance < -_INSIDE for touch in touches):
            return True  # squeezed from all sides
        normals = np.array([touch.normal for touch in touches])
        slope = np.arctan(self.friction)
        if float((normals @ normals.T).min()) <= -np.cos(slope):
            return True  # two of them face each other
        mean = normals.sum(axis=0)
        if float((normals @ mean).min()) > np.sin(slope) * np.linalg.norm(mean):
            return False  # all push the same way
        edges = [cone(normal, self.friction) for normal in normals]
        return balanced(np.concatenate(edges))
