"""How a hand closes on an object: link after link until they oppose each other; no dynamics.

The object is pushed by what touches it, without turning, until the forces of the contacts can
balance, friction included. Then the actuators of the links that touch stand still, and the others
go on until they touch, too, or are at the action's end: an actuator stalls where its link is
blocked, as those of a real hand do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.actions.types import Action
from rtee.hand.model import Hand
from rtee.planning.nearness import Nearness
from rtee.planning.postures import HandPose
from rtee.planning.result import Contact
from rtee.planning.scene import TOUCH, GraspScene, Touch
from rtee.planning.wrench import balanced, cones
from rtee.sample import BoolArray, FloatArray

STEPS: Final = 16
"""Steps of the table of an action's way; a step of a finger is about 6 mm."""

_TICKS: Final = 120
"""Intensities at which the hand is looked at; less than 1 mm of a fingertip's way apart."""

_STEP: Final = 4
"""Ticks of a step while links touch: about 3 mm of a fingertip's way."""

_SOON: Final = 4.0
"""Ticks ahead for which distances are measured before the hand touches; farther, bounds will do."""

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
        # A share of 1 is the end of the last leg, not the beginning of another one.
        leg = np.minimum(along.astype(np.int64), count - 1)
        rows = np.arange(self.knots.shape[1])
        begin, end = self.knots[leg, rows], self.knots[leg + 1, rows]
        found: FloatArray = begin + (along - leg) * (end - begin)
        return found

    def along(self, intensities: FloatArray) -> FloatArray:
        """Return actuator positions ``(k, n)`` [rad | m] at intensities ``(k,)``, 0 to 1."""
        along = intensities * (len(self.knots) - 1)
        leg = np.minimum(along.astype(np.int64), len(self.knots) - 2)
        begin, end = self.knots[leg], self.knots[leg + 1]
        found: FloatArray = begin + (along - leg)[:, None] * (end - begin)
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
        postures = scene.postures
        table = postures.frames(way.along(self.grid))
        self.table: list[HandPose] = [postures.posed(frames) for frames in table]
        self._frames = postures.frames(way.along(np.arange(_TICKS + 1) / _TICKS))
        self._known: dict[int, HandPose] = {}
        self._speed = postures.farthest_steps(table) * STEPS
        """How fast each shape moves at most [m per unit of intensity]."""
        # Absolute values, so that joints which move against each other do not cancel.
        drive = postures.carried @ np.abs(scene.hand.transmission.jacobian(way.at(1.0))) > 0.0
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
        # `_push` moves the object in place, and the caller's pose must stay.
        start, pose = pose, pose.copy()
        tick = math.floor(begin * _TICKS)
        near = Nearness(self.scene, self._posed(tick), pose)
        pace = np.maximum(self._speed, 1e-9) / _TICKS
        tick = self._until_contact(tick, near, pose)
        while True:
            at = self._posed(tick)
            touches = self._push(near, at, pose)
            if float(np.linalg.norm(pose[:3, 3] - start[:3, 3])) > _FARTHEST:
                return None
            if self._opposed(touches):
                break
            if tick >= _TICKS:
                return None
            step = min(_STEP, _TICKS - tick)
            if not touches:  # over all steps after which nothing touches either
                least = near.least(at, pose, _SOON, pace, until=TOUCH)
                step = min(max(1, math.ceil(least / _STEP)) * _STEP, _TICKS - tick)
            near.closed(self._speed * (step / _TICKS))
            tick += step
        return self._rest_closed(pose, tick / _TICKS, near, touches)

    def _posed(self, tick: int) -> HandPose:
        """Return where the hand is at an intensity; poses of the object share these."""
        if tick not in self._known:
            self._known[tick] = self.scene.postures.posed(self._frames[tick])
        return self._known[tick]

    def _rest_closed(
        self, pose: FloatArray, first: float, near: Nearness, touches: list[Touch]
    ) -> Closure:
        """Let the actuators go on that are not blocked, with the object where it is."""
        s, shares = first, np.full(len(self.scene.hand.rest), first)
        # Those that never move count as blocked, so that the loop can end early.
        blocked: BoolArray = ~self.way.moving
        for touch in touches:
            blocked = blocked | self._drives[touch.shape]
        there = {touch.shape for touch in touches}
        speed, shortest = np.maximum(self._speed, 1e-9), _STEP / _TICKS
        at = self.scene.posed(self.way.at(shares))
        free: BoolArray = np.any(self._drives[:, ~blocked], axis=1)
        while s < 1.0 and not blocked.all():
            for touch in near.touching(at, pose, free):
                if touch.shape not in there:
                    there.add(touch.shape)
                    touches.append(touch)
                    blocked = blocked | self._drives[touch.shape]
            # At least one step: a link inside the object has a negative way left.
            step = max(shortest, near.least(at, pose, 1.0, speed, free, below=shortest))
            before, s = s, min(1.0, s + step)
            shares = np.where(blocked, shares, s)
            at = self.scene.posed(self.way.at(shares))
            free = np.any(self._drives[:, ~blocked], axis=1)
            near.closed(np.where(free, self._speed * (s - before), 0.0))
        found = [near.touch(touch.shape, at, pose) for touch in touches]
        contacts = tuple(self.scene.contacts(found, at, pose))
        u = self.way.at(shares)
        return Closure(pose, shares, u, first, contacts, blocked & self.way.moving)

    def _until_contact(self, tick: int, near: Nearness, pose: FloatArray) -> int:
        """Return the intensity just before a moving link touches (conservative advancement).

        Args:
            tick: Intensity from which the hand closes.
            near: How near the hand is there; kept up to date.
            pose: Pose of the object.
        """
        speed = np.maximum(self._speed, 1e-9) / _TICKS
        while tick < _TICKS:
            # No farther than needed: what is far away is looked at when it comes near.
            least = near.least(self._posed(tick), pose, _SOON, speed, below=1.0)
            if least < 1.0:
                return tick
            # Rounded down, so that the hand stops before it touches.
            ticks = min(math.floor(least), _TICKS - tick)
            tick += ticks
            near.closed(self._speed * (ticks / _TICKS))
        return _TICKS

    def _push(self, near: Nearness, at: HandPose, pose: FloatArray) -> list[Touch]:
        """Move the object out of the links that push it, unless they oppose each other."""
        touches = near.touching(at, pose)
        for _ in range(_PUSHES):
            deep = [touch for touch in touches if touch.distance < 0.0]
            if not deep or self._opposed(touches):
                break
            push = sum((_clear_of(touch) for touch in deep), np.zeros(3)) / len(deep)
            if (
                len(self._links(deep)) == 1
            ):  # as several shapes of a jaw: the mean would leave it inside
                push = _clear_of(min(deep, key=lambda touch: touch.distance))
            pose[:3, 3] += push
            near.pushed(push)
            touches = near.touching(at, pose)
        return touches

    def _opposed(self, touches: Sequence[Touch]) -> bool:
        """Return whether forces at the contacts can balance, with friction."""
        if len(touches) < 2:
            return False
        if all(touch.distance < -_INSIDE for touch in touches) and len(self._links(touches)) > 1:
            return True  # squeezed from all sides
        normals = np.array([touch.normal for touch in touches])
        slope = np.arctan(self.friction)
        if float((normals @ normals.T).min()) <= -np.cos(slope):
            return True  # two of them face each other
        mean = normals.sum(axis=0)
        # Near their mean, every edge of every cone has a part along it: no sum of them is zero.
        if float((normals @ mean).min()) > np.sin(slope) * np.linalg.norm(mean):
            return False  # all push the same way
        # Forces alone: an object that does not turn needs no balance of torques.
        return balanced(cones(normals, self.friction).reshape(-1, 3))

    def _links(self, touches: Sequence[Touch]) -> set[str]:
        """Return the links that touch."""
        return {self.scene.geometry.shapes[touch.shape].link for touch in touches}


def _clear_of(touch: Touch) -> FloatArray:
    """Return the way that brings an object out of a link, but still in touch ``(3,)`` [m]."""
    way: FloatArray = (TOUCH / 2.0 - touch.distance) * touch.normal
    return way
