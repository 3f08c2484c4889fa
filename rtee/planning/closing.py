"""Close a hand on an object, link by link until links oppose each other; no dynamics.

The object is pushed by what touches it, without turning, until the forces of the contacts can
balance, friction included. Then the actuators of the links that touch stand still, and the others
go on until they touch, too, or are at the action's end: an actuator stalls where its link is
blocked, as those of a real hand do. In a grasp with a force, fingers do not push: what touches
first stands still at once, until the others touch. `Search.pressing` tells which fingers are there
in time to press, and `springs` what they then do to the object.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from rtee.actions.types import Action
from rtee.hand.model import Hand
from rtee.planning.distance_bounds import DistanceBounds
from rtee.planning.postures import HandPose, HandPoses, Slots
from rtee.planning.result import Contact
from rtee.planning.scene import TOUCH, GraspScene, Touch
from rtee.planning.wrench import balanced, cones
from rtee.sample import BoolArray, FloatArray

STEPS: Final = 16
"""Steps of the table of an action's path; a step of a finger is about 6 mm."""

TICKS: Final = 120
"""Number of intensities at which the hand is checked: less than 1 mm of a fingertip's path
apart."""

_STEP: Final = 4
"""Ticks of a step while links touch: about 3 mm of a fingertip's path."""

_SOON: Final = 4.0
"""Ticks ahead for which distances are measured before the hand touches; beyond, bounds suffice."""

_PUSHES: Final = 4
"""Pushes that one step may take until nothing is inside the object."""

_INSIDE: Final = 1.5e-3
"""A link that stays this deep inside the object is blocked [m]."""

_FARTHEST: Final = 0.05
"""Displacement beyond which a pushed object has escaped [m]."""

_MOVES: Final = 1e-6
"""Actuators whose set-points differ by less don't move [rad | m]."""

SEVERAL: Final = 3
"""Number of fingertips that may close along one axis, or from all around."""

_DECIDED: Final = 4.0
"""Fingertips close along an axis if their squared motion along it is this many times that along the
next axis."""

_TAKES_PART: Final = 0.1
"""A fingertip moves along that axis if it travels this share of the fastest one's path."""

_STILL: Final = 1e-3
"""Motion of fingertips that counts as 0 [m]."""


def opposition(motions: FloatArray, out: FloatArray) -> tuple[FloatArray | None, FloatArray]:
    """Return the axis ``(3,)`` along which fingertips close, and which side each is on ``(k,)``.

    There is no axis when they close from all around, or are fewer than three. Sides are -1, 1, or 0
    for a fingertip that takes no part.

    Args:
        motions: The motions of the closing fingertips ``(k, 3)`` [m].
        out: The unit vector ``(3,)`` along which the hand reaches out.
    """
    # Only motion across the reach closes on an object; curling tips also move along it.
    motions = motions - np.outer(motions @ out, out)
    sizes, axes = np.linalg.eigh(motions.T @ motions)
    along = motions @ axes[:, -1]
    least = _TAKES_PART * float(np.abs(along).max())
    # A tip that moves along the axis starts at its lower end: on side -1.
    sides = np.where(along > least, -1.0, np.where(along < -least, 1.0, 0.0))
    decided = len(motions) >= SEVERAL and sizes[-1] >= max(_DECIDED * sizes[-2], _STILL**2)
    return axes[:, -1] if decided else None, sides


@dataclass(frozen=True)
class ActionPath:
    """The path of an action from rest, by intensity.

    Attributes:
        hand: The hand.
        knots: Actuator positions at rest and after each inner action ``(m + 1, n)`` [rad | m].
    """

    hand: Hand
    knots: FloatArray

    @classmethod
    def of(cls, hand: Hand, action: Action) -> ActionPath:
        """Return the path of an action."""
        knots = [np.array(hand.rest)]
        for posture in action.waypoints:
            after = knots[-1].copy()
            for name in posture.involved:
                after[hand.actuator_index(name)] = posture.position[name]
            knots.append(after)
        return cls(hand, np.array(knots))

    @property
    def end(self) -> FloatArray:
        """Actuator positions at its end ``(n,)`` [rad | m]."""
        return np.array(self.knots[-1])

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
        """Mask of the actuators that it moves ``(n,)``."""
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


class HandClosing:
    """Closes a hand by an action; the table of its path serves all poses of the object.

    Attributes:
        scene: The hand and the object.
        path: The action's path.
        friction: Coefficient of friction between the hand and the object.
        waits: Whether fingers that touch the object wait until the others touch it, as in a grasp
            with a force; otherwise they push it on.
        grid: Intensities of the table ``(STEPS + 1,)``.
        table: Poses of the hand at these.
        frames: Poses of the bodies at `TICKS` intensities and rest ``(TICKS + 1, m + 1, 4, 4)``.
        speed: Largest speed of each shape ``(shapes,)`` [m per unit of intensity].
        drives: Which moving actuators move each shape ``(shapes, n)``.
    """

    def __init__(self, scene: GraspScene, path: ActionPath, friction: float) -> None:
        """Make the table."""
        self.scene, self.path, self.friction = scene, path, friction
        self.waits = False
        self.grid: FloatArray = np.linspace(0.0, 1.0, STEPS + 1)
        postures = scene.postures
        table = postures.frames(path.along(self.grid))
        self.table: list[HandPose] = [postures.posed(frames) for frames in table]
        self.frames = postures.frames(path.along(np.arange(TICKS + 1) / TICKS))
        self.speed = postures.farthest_steps(table) * STEPS
        # Absolute values, so that joints which move against each other do not cancel.
        drive = postures.carried @ np.abs(scene.hand.transmission.jacobian(path.at(1.0))) > 0.0
        self.drives: BoolArray = drive & path.moving

    @cached_property
    def waiting(self) -> HandClosing:
        """The same closing, but with fingers that wait for one another."""
        other = copy.copy(self)
        other.waits = True
        return other

    def close(self, pose: FloatArray, start: int) -> Closure | None:
        """Close on an object; see `close_all`."""
        return close_all([(self, pose, start)])[0]

    @staticmethod
    def tick(start: int) -> int:
        """Return the tick at a step of the table, rounded down."""
        return start * TICKS // STEPS


def close_all(asked: Sequence[tuple[HandClosing, FloatArray, int]]) -> list[Closure | None]:
    """Close hands on an object, each by an action; together this takes a fraction of the time.

    Args:
        asked: Actions of one scene, each with the initial pose of the object ``(4, 4)``, free of
            the hand, and the step of the table from which the hand closes.

    Returns:
        The closed hands; ``None`` where one never holds the object from two sides.
    """
    return _HandBatch(asked).closed() if asked else []


class _HandBatch:
    """Hands that close on an object at the same time, one in each row."""

    def __init__(self, asked: Sequence[tuple[HandClosing, FloatArray, int]]) -> None:
        self._closings = [closing for closing, _, _ in asked]
        first = self._closings[0]
        self._scene, self._friction = first.scene, first.friction
        self._links = [shape.link for shape in self._scene.geometry.shapes]
        poses = np.array([pose for _, pose, _ in asked])
        self._poses = poses
        self._ticks = np.array([first.tick(start) for _, _, start in asked], dtype=np.intp)
        begun = zip(self._closings, self._ticks.tolist(), strict=True)
        frames = np.array([closing.frames[tick] for closing, tick in begun])
        self._at = HandPoses(self._scene.postures, frames)
        at = [self._at.one(row) for row in range(len(asked))]
        self._near = DistanceBounds(self._scene, at, poses)
        self._speed = np.array([closing.speed for closing in self._closings])
        self._fastest = np.maximum(self._speed, 1e-9)
        self._touches: list[list[Touch]] = [[] for _ in asked]
        self._facing = [False] * len(asked)
        """Whether these touches oppose each other."""

    def closed(self) -> list[Closure | None]:
        """Return the closed hands."""
        self._until_contact()
        waits = np.array([closing.waits for closing in self._closings])
        opposed = self._until_opposed(np.flatnonzero(~waits))
        rows = np.sort(np.concatenate([opposed, np.flatnonzero(waits)]))
        found: list[Closure | None] = [None] * len(self._closings)
        if len(rows):
            for row, closure in zip(rows.tolist(), self._rest_closed(rows), strict=True):
                found[row] = closure
        return found

    def _go(self, rows: Slots, ticks: Slots) -> None:
        """Close hands by some ticks ``(len(rows),)``."""
        if not len(rows):
            return
        self._ticks[rows] += ticks
        self._near.closed(self._speed[rows] * (ticks / TICKS)[:, None], rows)
        now = zip(rows.tolist(), self._ticks[rows].tolist(), strict=True)
        self._at.put(rows, np.array([self._closings[row].frames[tick] for row, tick in now]))

    def _until_contact(self) -> None:
        """Close the hands until just before a moving link touches (conservative advancement)."""
        rows, pace = np.arange(len(self._closings)), self._fastest / TICKS
        while len(rows):
            # No farther than needed: distant shapes are checked when they come near.
            least = self._near.least(self._at, _SOON, rows, paces=pace[rows], below=1.0)
            rows, least = rows[least >= 1.0], least[least >= 1.0]
            # Rounded down, so that the hand stops before it touches.
            ticks = np.minimum(np.floor(least).astype(np.intp), TICKS - self._ticks[rows])
            self._go(rows, ticks)
            rows = rows[self._ticks[rows] < TICKS]

    def _until_opposed(self, rows: Slots) -> Slots:
        """Close hands until contacts oppose each other; return the rows in which they do."""
        pace = self._fastest / TICKS
        start, done = self._near.places.copy(), [np.zeros(0, dtype=np.intp)]
        while len(rows):
            self._push(rows)
            pushed = np.linalg.norm(self._near.places[rows] - start[rows], axis=1)
            rows = rows[pushed <= _FARTHEST]
            facing = np.array([self._facing[row] for row in rows.tolist()], dtype=np.bool_)
            done.append(rows[facing])
            rows = rows[~facing & (self._ticks[rows] < TICKS)]
            steps = np.full(len(rows), _STEP)
            nothing = np.array([not self._touches[row] for row in rows.tolist()], dtype=np.bool_)
            if nothing.any():  # skip the steps after which nothing touches either
                free = rows[nothing]
                least = self._near.least(self._at, _SOON, free, paces=pace[free], until=TOUCH)
                steps[nothing] *= np.maximum(np.ceil(least / _STEP).astype(np.intp), 1)
            self._go(rows, np.minimum(steps, TICKS - self._ticks[rows]))
        return np.sort(np.concatenate(done))

    def _push(self, rows: Slots) -> None:
        """Move the object out of the links that push it, unless they oppose each other."""
        self._touch(rows)
        for _ in range(_PUSHES):
            pushes: dict[int, FloatArray] = {}
            for row in rows.tolist():
                deep = [touch for touch in self._touches[row] if touch.distance < 0.0]
                if not deep or self._facing[row]:
                    continue
                push = sum((_clear_of(touch) for touch in deep), np.zeros(3)) / len(deep)
                # All belong to one link: the mean push would leave the object inside the deepest.
                if len({self._links[touch.shape] for touch in deep}) == 1:
                    push = _clear_of(min(deep, key=lambda touch: touch.distance))
                pushes[row] = push
            if not pushes:
                return
            rows = np.array(list(pushes))
            self._near.pushed(np.array(list(pushes.values())), rows)
            self._touch(rows)

    def _touch(self, rows: Slots) -> None:
        """Examine the touching shapes in some rows."""
        found = self._near.touching(self._at, rows)
        for row, touches in zip(rows.tolist(), found, strict=True):
            self._touches[row], self._facing[row] = touches, self._opposed(touches)

    def _opposed(self, touches: Sequence[Touch]) -> bool:
        """Return whether forces at the contacts can balance, with friction."""
        if len(touches) < 2:
            return False
        if all(touch.distance < -_INSIDE for touch in touches) and (
            len({self._links[touch.shape] for touch in touches}) > 1
        ):
            return True  # squeezed from all sides
        normals = np.array([touch.normal for touch in touches])
        slope = math.atan(self._friction)
        if float((normals @ normals.T).min()) <= -math.cos(slope):
            return True  # two sides face each other
        mean = normals.sum(axis=0)
        # Near their mean, every edge of every cone has a part along it: no sum of them is zero.
        if float((normals @ mean).min()) > math.sin(slope) * math.sqrt(float(mean @ mean)):
            return False  # all push the same way
        # Forces alone: an object that does not turn needs no balance of torques.
        return balanced(cones(normals, self._friction).reshape(-1, 3))

    def _rest_closed(self, rows: Slots) -> list[Closure | None]:
        """Move on the actuators that are not blocked.

        Returns:
            The closed hands; ``None`` where the contacts do not oppose each other at the end.
        """
        paths = [self._closings[row].path for row in rows.tolist()]
        drives = np.array([self._closings[row].drives for row in rows.tolist()])
        touches = [self._touches[row] for row in rows.tolist()]
        there = [{touch.shape for touch in found} for found in touches]
        facing = [self._facing[row] for row in rows.tolist()]
        first: FloatArray = self._ticks[rows] / TICKS
        s = first.copy()
        shares = np.repeat(s[:, None], drives.shape[2], axis=1)
        # Those that never move count as blocked, so that the loop can end early.
        blocked = np.array([~path.moving for path in paths])
        for k, found in enumerate(touches):
            blocked[k] |= drives[k, [touch.shape for touch in found]].any(axis=0)
        free = (drives & ~blocked[:, None]).any(axis=2)
        left = np.flatnonzero((s < 1.0) & ~blocked.all(axis=1))
        shortest = _STEP / TICKS
        while len(left):
            mine = rows[left]
            for k, found in zip(
                left.tolist(), self._near.touching(self._at, mine, free[left]), strict=True
            ):
                new = [touch for touch in found if touch.shape not in there[k]]
                there[k].update(touch.shape for touch in new)
                touches[k] += new
                for touch in new:
                    blocked[k] |= drives[k, touch.shape]
                if new and not facing[k]:
                    facing[k], first[k] = self._opposed(touches[k]), s[k]
            least = self._near.least(
                self._at,
                1.0,
                mine,
                paces=self._fastest[mine],
                among=free[left],
                below=shortest,
            )
            # At least one step: a link inside the object may have a negative distance left.
            after = np.minimum(1.0, s[left] + np.maximum(shortest, least))
            gone, s[left] = after - s[left], after
            shares[left] = np.where(blocked[left], shares[left], after[:, None])
            u = np.array([paths[k].at(shares[k]) for k in left.tolist()])
            self._at.put(mine, self._scene.postures.frames(u))
            free[left] = (drives[left] & ~blocked[left, None]).any(axis=2)
            moved = np.where(free[left], self._speed[mine] * gone[:, None], 0.0)
            self._near.closed(moved, mine)
            left = left[(s[left] < 1.0) & ~blocked[left].all(axis=1)]
        return [
            self._closure(row, float(first[k]), shares[k], blocked[k], touches[k])
            if facing[k]
            else None
            for k, row in enumerate(rows.tolist())
        ]

    def _closure(
        self, row: int, first: float, shares: FloatArray, blocked: BoolArray, touches: list[Touch]
    ) -> Closure:
        """Return a hand that has closed."""
        path, pose, at = self._closings[row].path, self._poses[row].copy(), self._at.one(row)
        pose[:3, 3] = self._near.places[row]
        found = [self._near.touch(row, touch.shape, self._at) for touch in touches]
        contacts = tuple(self._scene.contacts(found, at, pose))
        return Closure(pose, shares, path.at(shares), first, contacts, blocked & path.moving)


def _clear_of(touch: Touch) -> FloatArray:
    """Return the shift that moves an object out of a link until they just touch ``(3,)`` [m]."""
    return (TOUCH / 2.0 - touch.distance) * touch.normal
