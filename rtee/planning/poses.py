"""Find poses of an object for an action: between the closing links, as deep as it fits."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from functools import cached_property
from typing import Final, TypeAlias

import coal
import numpy as np

from rtee.actions.types import Action, Timed
from rtee.hand.frames import homogeneous
from rtee.hand.linalg import cross
from rtee.planning.approaches import (
    APPROACH_LENGTH,
    GAP,
    Approach,
    Found,
    PoseCandidate,
    at_most,
    bring_in,
    interleaved,
    near_side,
)
from rtee.planning.closing import SEVERAL, HandClosing, opposition
from rtee.planning.objects import GraspObject
from rtee.planning.postures import HandPose
from rtee.planning.scene import GraspScene
from rtee.planning.table import STEEP, Ground
from rtee.sample import FloatArray

_TIPS: Final = 0.008
"""How far fingertips reach over an object that they hold at its end [m]."""

_TIP: Final = 0.035
"""How far the shapes of a fingertip reach from the outermost one's middle [m]."""

_APART: Final = 0.006
"""Depths that differ by less count as one [m]."""

_PROBE: Final = 0.004
"""Radius of the probe by which openings are measured [m]: half a fingertip's breadth."""

_ROOM: Final = 0.025
"""Space that jaws leave on either side of an object that comes between them [m]: a fixed jaw stays
clear of an object that is up to 10 mm misplaced, 10 % larger and turned by 10 degrees."""

_LOW: Final = 1e-3
"""Fingertips whose heights above a table differ by less count as equally low [m]."""

_SLANTED: Final = 0.5
"""Least cosine of the angle to the reach at which fingertips oppose along it: 60 degrees."""

Way: TypeAlias = tuple[FloatArray, list[tuple[FloatArray, FloatArray]]]
"""Axis of closing, side and reach of an approaching hand, as columns ``(3, 3)``, and the directions
from which the object comes, with shifts of it [m]."""

_SHIFTS: Final = (0.0, 0.015, 0.03)
"""Jaws that turn about a hinge have room for an object farther out than their middles [m]."""

_ROOMY: Final = 0.7
"""Least share of the most room that a shift must give; the smallest such shift is taken."""

_PROBED: Final = 3e-4
"""A probe touches a fingertip that is this close [m]."""

_BACK: Final = 0.03
"""Distance behind the fingertips' middle at which an object from the palm's front is held [m]."""

_STILL: Final = 1e-3
"""Smaller motions count as 0 [m]."""

_SAME: Final = 0.03
"""Orientations count as one if the outlines differ by less than this share of the object's size."""

_TURNS: Final = tuple(
    np.array([[sign[i] * (axis[i] == j) for j in range(3)] for i in range(3)], dtype=np.float64)
    for axis in itertools.permutations(range(3))
    for sign in itertools.product((1, -1), repeat=3)
)
"""Signed permutations of three axes; those with determinant 1 are the 24 turns of a cube."""

_OUTLOOK: Final = np.array([d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)], float)
"""Directions in which outlines are compared: a cube's faces, edges and corners."""


def outward(scene: GraspScene) -> FloatArray:
    """Return the axis ``(3,)`` of the base frame along which the hand reaches out."""
    shapes = list(scene.geometry.of_links(*scene.hand.tip_links))
    middles = scene.posed(np.array(scene.hand.rest)).middles[shapes]
    centre = middles.mean(axis=0) if shapes else np.array([0.0, 0.0, 1.0])
    axis = np.zeros(3)
    widest = int(np.argmax(np.abs(centre)))
    # np.sign gives 0 where the tips' middle is the origin; an axis needs a direction even then.
    axis[widest] = np.sign(centre[widest]) or 1.0
    return axis


def orientations(obj: GraspObject, up: FloatArray | None = None) -> list[FloatArray]:
    """Return the distinct orientations ``(3, 3)`` of an object's box, relative to three axes.

    For an object that stands on a table, orientations also differ if its upward axis ``(3,)`` does.
    """
    directions = _OUTLOOK / np.linalg.norm(_OUTLOOK, axis=1, keepdims=True)
    middle, _ = obj.box
    limit = _SAME * max(obj.extents)
    found: list[FloatArray] = []
    seen: list[FloatArray] = []
    stands = np.zeros(3) if up is None else up
    for turn in _TURNS:
        if np.linalg.det(turn) < 0.0:
            continue
        whole = turn @ obj.frame.T
        local = directions @ whole  # the directions in the object's frame
        # Relative to the box's centre, since the origin of a mesh does not change its shape.
        outline = np.append(obj.support(local) - local @ middle, whole @ stands)
        if all(np.abs(outline - other).max() > limit for other in seen):
            found.append(whole)
            seen.append(outline)
    return found


class Poses:
    """Finds poses of the object for one action."""

    def __init__(
        self,
        scene: GraspScene,
        closing: HandClosing,
        action: Action,
        out: FloatArray,
        ground: Ground | None = None,
    ) -> None:
        """Examine how the action's fingertips move; the hand reaches out along ``out``."""
        self._scene, self._closing, self._out, self._ground = scene, closing, out, ground
        self._timed = isinstance(action, Timed)
        self.blocked = False
        """Whether a pose was left out because of the table."""
        self._fingers = self._involved(action)
        of_links = scene.geometry.of_links
        self._tips = [
            self._outermost(list(of_links(*scene.hand.finger(name).tip_links)))
            for name in self._fingers
        ]
        middles = np.array([at.middles for at in closing.table])
        self._paths = np.stack([self._middle(middles, tips) for tips in self._tips], axis=1)
        """Middles of the fingertips ``(steps + 1, k, 3)``."""
        self._axis, self._sides = self._opposition()
        self._probe = coal.Sphere(_PROBE)
        self._shift = 0.0
        """Distance out from the fingertips' middle at which there is most room between them [m]."""
        if len(self._fingers) < SEVERAL:
            rooms = {shift: self._room(shift) for shift in _SHIFTS}
            self._shift = next(s for s in _SHIFTS if rooms[s] >= _ROOMY * max(rooms.values()))

    @property
    def several(self) -> bool:
        """Whether there are at least two fingertips."""
        return len(self._fingers) > 1

    def _involved(self, action: Action) -> tuple[str, ...]:
        """Return the fingers that close; a single one together with the nearest other finger."""
        hand, moving = self._scene.hand, self._closing.path.moving
        moved = {n for n, moves in zip(hand.actuator_names, moving, strict=True) if moves}
        there = [f for f in hand.fingers if f.tip is not None]
        chosen = [f for f in there if f.name in action.fingers] or [
            f for f in there if moved & set(f.actuators)
        ]
        # A finger alone opposes nothing: the object goes between it and its neighbour.
        if len(chosen) == 1:
            pose = self._scene.geometry.kinematics.link_pose
            u = self._closing.path.at(1.0)
            at = {f.name: pose(f.tip or "", u)[:3, 3] for f in there}
            others = [f for f in there if f is not chosen[0]]
            others.sort(key=lambda f: float(np.linalg.norm(at[f.name] - at[chosen[0].name])))
            chosen += others[:1]
        return tuple(f.name for f in chosen)

    def _outermost(self, shapes: list[int]) -> list[int]:
        """Return the outermost shapes of a fingertip's link.

        The link of a jaw may be the gripper's whole body.
        """
        reach = self._closing.table[0].middles[shapes] @ self._out
        least = reach.max(initial=-np.inf) - _TIP  # the rest is the body behind it
        return [shape for shape, far in zip(shapes, reach, strict=True) if far >= least]

    def _middle(self, middles: FloatArray, tips: list[int]) -> FloatArray:
        # Roughly by volume, so that many small shapes do not draw the middle to them.
        weight = self._scene.postures.radii[tips] ** 3
        return np.asarray(weight @ middles[:, tips] / weight.sum())

    def _opposition(self) -> tuple[FloatArray | None, FloatArray]:
        """Return the axis of closing of three or more fingertips, and which side each is on.

        ``None`` when they close from all around, or are two, or one. Sides are -1, 1, or 0 for a
        fingertip that takes no part.
        """
        count = len(self._fingers)
        if count < SEVERAL:
            return None, np.array([-1.0, 1.0] if self.several else [0.0])
        axis, sides = opposition(self._paths[-1] - self._paths[0], self._out)
        if axis is not None and (sides > 0).any() and (sides < 0).any():
            return axis, sides
        # Without an axis, or with all tips on one side of it, they close from all around; but above
        # a table it matters how a thumb and fingers oppose each other along the reach, too.
        if self._ground is not None:
            motions = self._paths[STEP_MIDDLE] - self._paths[0]
            axis, sides = opposition(motions - motions.mean(axis=0), np.zeros(3))
            if axis is not None and (sides > 0).any() and (sides < 0).any():
                return None, sides
        return None, np.zeros(count)

    def _at(self, step: int) -> tuple[FloatArray, FloatArray]:
        """Return the middle between the fingertips and the unit axis of closing at a step."""
        tips = self._paths[step]
        if self._sides.any():
            low, high = (tips[self._sides == side].mean(axis=0) for side in (-1.0, 1.0))
            middle = 0.5 * (low + high)
            closing = self._between(step) if self._axis is None else self._axis
        else:
            middle, closing = tips.mean(axis=0), tips[-1] - tips[0]
        closing = closing - (closing @ self._out) * self._out
        size = float(np.linalg.norm(closing))
        # Tips that meet have no axis between them: any one across the reach will do.
        if size < _STILL:
            closing = np.eye(3)[int(np.argmin(np.abs(self._out)))]
            size = 1.0
        return middle + self._shift * self._out, closing / size

    def _room(self, shift: float) -> float:
        """Return how wide the fingers open, at a distance from the tips' middle [m]."""
        self._shift = shift
        # Beyond the ends of open jaws there is room for anything, but an object there is not
        # between them. Hands with more fingers also compare places between other fingers, and do
        # not need this check.
        if shift and self.several and len(self._scene.hand.fingers) < SEVERAL and self._beyond():
            return 0.0
        return max(self._gap(0), self._gap(STEP_MIDDLE))

    def _beyond(self) -> bool:
        """Return whether the open jaws end short of the middle."""
        middle, _ = self._at(0)
        closing = self._between(0)
        closing = closing / max(float(np.linalg.norm(closing)), _STILL)
        at = self._closing.table[0]
        return all(
            self._met(at, tips, middle, side * closing) is None
            for tips, side in zip(self._tips, self._sides, strict=True)
        )

    def _between(self, step: int) -> FloatArray:
        """Return the vector from the fingertips of one side to those of the other ``(3,)`` [m]."""
        tips = self._paths[step]
        low, high = (tips[self._sides == side].mean(axis=0) for side in (-1.0, 1.0))
        between: FloatArray = high - low
        return between

    def _gap(self, step: int) -> float:
        """Return how far apart the fingertips' inner sides are at a step [m]."""
        middle, closing = self._at(step)
        around = not self._sides.any()
        if not around:  # the tips decide, not the object's orientation
            closing = self._between(step)
            closing = closing / max(float(np.linalg.norm(closing)), _STILL)
        inner: dict[float, float] = {}
        for number, tips in enumerate(self._tips):
            side = 1.0 if around else float(self._sides[number])
            towards = side * closing
            if around:
                radial = self._paths[step, number] - middle
                radial = radial - (radial @ self._out) * self._out
                towards = radial / max(float(np.linalg.norm(radial)), _STILL)
            if side:
                free = self._free(self._closing.table[step], tips, middle, towards)
                inner[side] = min(inner.get(side, np.inf), free)
        return 2.0 * inner[1.0] if around else sum(inner.values())

    def _free(
        self, at: HandPose, tips: list[int], middle: FloatArray, towards: FloatArray
    ) -> float:
        """Return the distance from the grasp centre at which a probe meets a fingertip [m].

        For a probe that passes the fingertip, this is the distance to the fingertip's middle.
        """
        met = self._met(at, tips, middle, towards)
        return max(0.0, self._far(at, tips, middle, towards)) if met is None else met

    def _met(
        self, at: HandPose, tips: list[int], middle: FloatArray, towards: FloatArray
    ) -> float | None:
        """Return where a probe from the grasp centre meets a fingertip [m], or ``None``."""
        far = self._far(at, tips, middle, towards)
        gone = 0.0
        # A step of the free distance cannot jump over a fingertip.
        while gone < far:
            here = coal.Transform3s(np.eye(3), middle + gone * towards)
            least = min(self._scene.distance(tip, at, self._probe, here) for tip in tips)
            if least < _PROBED:
                # The probe's radius is free, too, unless the probe itself has no room at the start.
                return max(0.0, gone + _PROBE) if gone else 0.0
            gone += least
        return None

    @staticmethod
    def _far(at: HandPose, tips: list[int], middle: FloatArray, towards: FloatArray) -> float:
        """Return the distance from the grasp centre to the fingertip's centre [m]."""
        return float(np.max((at.middles[tips] - middle) @ towards))

    @cached_property
    def gaps(self) -> FloatArray:
        """How far apart the fingertips are along the path ``(steps + 1,)`` [m]."""
        # A gap takes many distances of each fingertip: with more tips, fewer gaps are measured.
        steps = np.arange(0, len(self._closing.table), 2 if len(self._fingers) < SEVERAL else 4)
        found = [self._gap(int(step)) for step in steps]
        return np.interp(np.arange(len(self._closing.table)), steps, found)

    def candidates(self, turns: list[FloatArray], most: int) -> Iterator[PoseCandidate]:
        """Yield poses of the object, at most ``most``; see `search`."""
        for found in self.search(turns, most):
            if isinstance(found, Approach):
                bring_in(self._scene, [found])
            else:
                yield found

    def search(self, turns: list[FloatArray], most: int) -> Iterator[Found]:
        """Yield poses of the object, at most ``most``, and the approaches on which they depend.

        First those between the fingertips, narrow sides of the object first; then those in the
        palm's front, long sides across it, which several fingers may wrap. After an approach, the
        search goes on when `bring_in` has found its depth.
        """
        between = at_most(self._between_tips(turns, most), most)
        if len(self._fingers) < SEVERAL or len(self._directions()) == 1:
            yield from between
            return
        wrapped = self._in_palm(turns, most)
        yield from at_most(interleaved(between, wrapped), most)

    def _between_tips(self, turns: list[FloatArray], most: int) -> Iterator[Found]:
        opening = float(self.gaps.max())
        fitting = []
        for number, (width, _, deep) in enumerate(self._sizes(turns)):
            if width > opening - 2.0 * GAP:
                continue
            step = self._last(width + GAP)
            ways = list(self._ways(step, turns[number]))
            # Rounded, so that the last digits do not decide between turns of the same width.
            fitting += [
                (from_side, round(width, 3), round(deep, 3), number, part, step, way)
                for part, (from_side, way) in enumerate(ways)
            ]
        fitting.sort(key=lambda entry: entry[:5])
        for _, width, _, number, _, step, (frame, directions) in fitting:
            placed = self._placed(step, frame @ turns[number], width, directions)
            if len(self._fingers) < SEVERAL:
                wide = self._last(width + 2.0 * _ROOM)
                # Only with a fixed jaw: for two moving jaws both places are the same, and rounding
                # would choose between equal candidates.
                if self._aside(wide, step) > _STILL:
                    there = self._frame(wide) @ turns[number]
                    placed = interleaved(self._placed(wide, there, width, directions), placed)
            yield from at_most(placed, _share(most, len(fitting)))

    def _ways(self, step: int, turn: FloatArray) -> Iterator[tuple[bool, Way]]:
        """Yield possible approaches of the object, each with whether it is sideways above a table.

        Fingers that curl and oppose a thumb along the reach approach a standing object at a tilt.
        """
        frame, directions = self._frame(step), self._directions()
        up = None if self._ground is None else self._ground.up
        if up is None:
            yield False, (frame, directions)
            return
        ways = [(frame, [way]) for way in directions]
        closing = frame[:, 0]
        if self._sides.any():
            between = self._between(step)
            between = between / max(float(np.linalg.norm(between)), _STILL)
            if abs(float(between @ self._out)) > _SLANTED:
                closing = between
        reach = _across(self._out, closing)
        curl = sum((direction for direction, _ in directions[1:2]), np.zeros(3))
        front = _across(_across(curl, closing), reach)
        tilted = [] if closing is frame[:, 0] else [reach]
        if float(np.linalg.norm(front)) > _STILL:
            tilted.append((reach + front) / math.sqrt(2.0))
        ways += [
            (np.stack([closing, cross(axis, closing), axis], axis=1), [(axis, np.zeros(3))])
            for axis in tilted
        ]
        for turned, way in ways:
            steep = -float(way[0][0] @ turned @ turn @ up)
            if steep > -STEEP:
                yield steep <= STEEP, (turned, way)

    def _last(self, width: float) -> int:
        """Return the last step, from the widest on, at which the hand is open this far [m]."""
        open_at = int(np.argmax(self.gaps))
        narrow = np.flatnonzero(self.gaps[open_at:] < width)
        left = int(narrow[0]) - 1 if len(narrow) else len(self.gaps) - 1 - open_at
        return open_at + max(0, left)

    def _aside(self, wide: int, step: int) -> float:
        """Return the motion of the grasp centre across the reach between two steps [m].

        If one of two jaws is fixed, the centre moves away from it as the other opens.
        """
        moved = self._at(wide)[0] - self._at(step)[0]
        return float(np.linalg.norm(moved - (moved @ self._out) * self._out))

    def _in_palm(self, turns: list[FloatArray], most: int) -> Iterator[Found]:
        front = self._directions()[1:]
        frame = self._frame(STEP_MIDDLE)
        across = front[0][0] @ np.stack([frame @ turn for turn in turns])
        thick = self._scene.object.support(across) + self._scene.object.support(-across)
        sized = [
            (round(float(thick[number]) + high, 3), number, width)
            for number, (width, _, high) in enumerate(self._sizes(turns))
        ]
        step = 3 * STEP_MIDDLE // 2
        for _, number, width in sorted(sized):
            placed = self._placed(step, self._frame(step) @ turns[number], width, front)
            yield from at_most(placed, _share(most, len(sized)))

    def narrowest(self, turns: list[FloatArray]) -> float:
        """Return the object's least width between the fingers [m]."""
        return min(width for width, _, _ in self._sizes(turns))

    def _sizes(self, turns: list[FloatArray]) -> list[tuple[float, float, float]]:
        """Return the object's width, size across the axis of closing, and depth, by turn [m]."""
        # The extents are along the rows of the rotation, wherever the axes of the hand are.
        return [self._scene.sizes(turn) for turn in turns]

    def _frame(self, step: int) -> FloatArray:
        """Return axis of closing, side and reach of the hand at a step, as columns ``(3, 3)``."""
        _, closing = self._at(step)
        return np.stack([closing, cross(self._out, closing), self._out], axis=1)

    def _placed(
        self,
        step: int,
        turned: FloatArray,
        width: float,
        directions: list[tuple[FloatArray, FloatArray]],
    ) -> Iterator[Found]:
        """Yield poses of the object, turned by ``(3, 3)``, at the grasp centre, and approaches."""
        middle, _ = self._at(step)
        # The middle of its box, since a mesh may have its origin anywhere.
        pose = homogeneous(turned, middle - turned @ self._scene.object.box[0])
        opening = float(self.gaps.max())
        for direction, shift in directions:
            begin = pose.copy()
            begin[:3, 3] += shift
            stands = self._stands(begin, direction, width)
            self.blocked |= not stands
            deepest = None
            for start, least, there in stands:
                begin = there
                approach = Approach(
                    begin, direction, self._closing.frames[self._closing.tick(start)]
                )
                yield approach
                deepest = approach.depth
                if deepest is not None and deepest <= max(least, 0.0):
                    break
            if deepest is None:
                continue
            obj = self._scene.object
            out_of_reach = near_side(obj, begin, direction, obj.box[0]) - _TIPS
            # The deepest first: the turn's share of poses may be used up before the others.
            depths = [max(least, d) for d in (deepest, 0.0, 0.5 * deepest, out_of_reach)]
            if self._ground is not None and self._ground.edge:
                # Only the part beyond the edge is free.
                depths = [out_of_reach - more * _TIPS for more in (-0.5, 0.5, 1.5)]
            taken: list[float] = []
            for depth in depths:
                if depth < deepest or any(abs(depth - other) < _APART for other in taken):
                    continue
                taken.append(depth)
                there = begin.copy()
                there[:3, 3] += depth * direction
                yield PoseCandidate(there, APPROACH_LENGTH * direction, width, opening, start)

    def _stands(
        self, begin: FloatArray, direction: FloatArray, width: float
    ) -> list[tuple[int, float, FloatArray]]:
        """Return steps at which the hand may approach, in the order of trial.

        Each has the least depth at which the closing hand stays clear of the table [m], and the
        pose of the object at depth 0: a hand that comes from the side is raised as far as
        necessary. At the first step, the hand is as open as it can be with its fingertips as low as
        possible, or below the object's middle; at the others it is more open. No step is given for
        an approach from below, or too far above the object.
        """
        ground = self._ground
        if ground is None:
            return [(0, -np.inf, begin)]
        up = ground.top(begin, direction).up
        steep = -float(direction @ up)
        if steep < -STEEP:
            return []
        if ground.edge:  # where there is room is found by trying
            return [(0, -np.inf, begin)]
        steps = min(self._last(width) + 1, len(self.gaps) - 1)
        missing = ground.missing(self._closing, steps, begin, direction)
        last = 0 if self._timed else max(0, steps - 2)
        first = int(np.argmax(missing[: last + 1] <= max(0.0, float(missing[last])) + _LOW))
        starts = range(first, -1, -1)
        if steep > STEEP:
            return [(start, float(missing[start]) / steep, begin) for start in starts]
        turned, obj = up @ begin[:3, :3], self._scene.object
        high = float(obj.support(turned[None])[0] - turned @ obj.box[0])
        found = []
        for start in starts:
            more = max(0.0, float(missing[start]))
            raised = begin.copy()
            raised[:3, 3] -= more * up
            if more < high:
                found.append((start, -np.inf, raised))
        return found

    def _directions(self) -> list[tuple[FloatArray, FloatArray]]:
        """Return the directions from which the object may come, and shifts of it ``(3,)`` [m]."""
        directions = [(self._out, np.zeros(3))]
        curl = self._paths[len(self._paths) // 2].mean(axis=0) - self._paths[0].mean(axis=0)
        curl = curl - (curl @ self._out) * self._out
        # Fingers that close along an axis have no palm in front of which they all curl.
        if self._axis is not None:
            curl = curl - (curl @ self._axis) * self._axis
        size = float(np.linalg.norm(curl))
        if size > 5.0 * _STILL:
            directions.append((curl / size, np.zeros(3)))
            directions.append((curl / size, -_BACK * self._out))
        return directions


def _across(vector: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the unit vector of the component across a unit axis; about zero if there is none."""
    across = vector - (vector @ axis) * axis
    size = float(np.linalg.norm(across))
    return across / size if size > 0.1 else np.zeros(3)


def _share(most: int, turns: int) -> int:
    """Return how many poses are tried per orientation of the object."""
    return max(2, -(-most // max(1, min(turns, most // 2))))


STEP_MIDDLE: Final = 8
"""The step at which the axis of closing is evaluated first: half of the path."""
