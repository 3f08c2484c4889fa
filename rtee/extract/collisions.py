"""Checks for unwanted collisions at a posture and on the straight path to it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from rtee.actions.types import FARTHEST_CLEARANCE
from rtee.extract.distance_queries import TOUCH
from rtee.extract.envelopes import Envelopes
from rtee.extract.goals import TipEdge, linked
from rtee.extract.motion import LinkDistanceBounds, MotionBounds, StraightPath
from rtee.extract.pairs import LinkPair
from rtee.extract.resolution import COARSE
from rtee.extract.scene import Scene
from rtee.hand.linalg import cross, dot, matvec, norm
from rtee.hand.pairs import Pairs
from rtee.sample import FloatArray
from rtee.types import JointKind

STEP: Final = 0.001
"""Largest relative motion of near links between two exact checks on a path [m]."""

_FINE: Final = 0.0005
"""Step of the search for the first contact of tips whose convex parts overlap [m]."""

_MOST: Final = 4096
"""Maximum number of steps on a path, so that no path takes longer than a few seconds."""

_COARSE_PARTS: Final = 16
_PARTS: Final = 32
"""Number of parts into which halving divides a path before exact checks: for links whose convex
parts overlap, where halving decides nothing, and for other links."""

_PLACE: Final = 2.0**-16
"""Unit of the intensities checked on a path, which makes them independent of last digits; in one
unit, a fingertip moves a few micrometres."""

_FEW: Final = 12
"""Largest number of pairs measured without comparing envelopes first, which would cost as much."""

_FEW_ON_PATH: Final = 3
"""The same on a path, where the bounds of all pairs are computed at once, which takes as long as
measuring one pair at 300 places."""

_SHARE: Final = 0.8
"""Share of their distance at rest that near links must keep: the remainder exceeds the rounding of
stored postures."""

REDUCED: Final = 0.25
"""Share of the margins for pinches without a posture of full margins: still clear, but only if the
model is exact."""

_PLACES: Final = np.linspace(0.0, 1.0, 65)
"""Intensities at which the clearance on a path is measured, between which a fingertip moves a few
millimetres. The number of intervals is a multiple of `_PARTS`."""

_CAUTIOUS: Final = 2.0
"""Safety factor on the motion of links between two checks on a path, which is measured at some
points and assumed to be even between them."""

_PARALLEL: Final = 1e-3
"""Sine of the angle between two axes below which they are parallel."""

_SURE: Final = 1e-5
"""Distance beyond which links do not touch, despite rounding errors [m]."""


@dataclass(frozen=True, slots=True)
class Blocked:
    """A collision on a path.

    Attributes:
        pair: The links that collide.
        at: Intensity of their first collision.
        until: Intensity up to which they must stay apart.
    """

    pair: LinkPair
    at: float
    until: float = 1.0


@dataclass(frozen=True, slots=True)
class PinchClosing:
    """The fingers of a pinch, which close on each other until contacts link their tips.

    The fingers never reach set-points beyond the contact: from there on, they hold each other, or
    an object, and do not come nearer. Their links therefore must stay apart only until then.

    Attributes:
        bodies: The bodies of the tips, finger by finger.
        edges: The pairs of tips that can touch.
        bars: The bodies of each finger outside the chain of its tip.
    """

    bodies: tuple[int, ...]
    edges: tuple[TipEdge, ...]
    bars: tuple[frozenset[int], ...]


class Collisions:
    """The pairs of links to check for collisions.

    Excludes links joined by a moving joint, or by joints with crossing axes and no geometry between
    them, links that touch at rest, and pairs that the SRDF disables.

    Attributes:
        checked: The remaining pairs of links.
        at_rest: The pairs that touch at rest.
        narrow: The pairs whose distance at rest is too small for the hand's clearance, with this
            distance [m].
    """

    def __init__(self, scene: Scene, motion: MotionBounds) -> None:
        self._scene = scene
        self._motion = motion
        self._envelopes = Envelopes(scene)
        disabled = {frozenset((a, b)) for a, b, _ in scene.hand.disabled_collisions}
        parents, moves = scene.kinematics.model.parents, scene.hand.transmission.moves

        def rigid(body: int) -> int:
            # A joint that no actuator moves, such as a passive one, counts as fixed.
            while body and moves(body - 1) is None:
                body = int(parents[body])
            return body

        solid = {rigid(shape.body) for shape in scene.shapes}

        def next_to(body: int) -> int:
            above = rigid(int(parents[body]))
            # Two crossing axes, as at a finger's base, have a link without geometry between them.
            while above and above not in solid and _crossing(scene, above, body):
                body, above = above, rigid(int(parents[above]))
            return above

        candidates = []
        for pair in scene.pairs.values():
            a, b = map(rigid, pair.bodies)
            adjacent = next_to(a) == b or next_to(b) == a
            # In nearly every model, links overlap at the joint between them.
            if not adjacent and frozenset(pair.links) not in disabled:
                candidates.append(pair)
        scene.place(scene.hand.rest)
        close = np.flatnonzero(self._gaps_at_rest(candidates) <= 0.0)
        near = [candidates[c] for c in close]
        touching = {pair.links for pair in near if scene.touching(pair)}
        self.at_rest = tuple(sorted(touching))
        remaining = [pair for pair in candidates if pair.links not in touching]
        # Nested links cost most to check and rarely collide.
        overlapping = {pair.links for pair in near if scene.at_least(pair) <= 0.0}
        self._nested = overlapping - touching
        self.checked = tuple(sorted(remaining, key=lambda pair: pair.links in self._nested))
        self.narrow = self._narrow()

    def _narrow(self) -> Pairs[str, float]:
        scene, wanted = self._scene, self._scene.hand.clearance / _SHARE
        scene.place(scene.hand.rest)
        gaps = self._gaps_at_rest(self.checked)
        near = [self.checked[c] for c in np.flatnonzero(gaps < wanted)]
        return Pairs(
            (pair.links, COARSE.rounded_value(scene.exact_distance(pair)))
            for pair in near
            if scene.nearer(pair, wanted)
        )

    def _gaps_at_rest(self, pairs: Sequence[LinkPair]) -> FloatArray:
        """Return lower bounds on the distances of pairs at rest ``(p,)`` [m]."""
        bounds: FloatArray = self._envelopes.gaps(
            [self._scene.hand.rest],
            self._envelopes.ends(pairs),
            self._scene.hand.clearance / _SHARE,
        )[0]
        return bounds

    def margin(self, pair: LinkPair) -> float:
        """Return the distance that two links must keep in a clear pose [m].

        It is the hand's clearance, or four fifths of their distance at rest if that is less.
        """
        least = self._scene.hand.clearance
        gap = self.narrow.get(pair.links)
        return max(TOUCH, least if gap is None else min(least, _SHARE * gap))

    def checker(
        self,
        actuators: Iterable[int],
        tips: Iterable[frozenset[str]],
        closing: PinchClosing | None = None,
    ) -> CollisionChecker:
        """Return a checker of the links that the actuators move, except tips that should touch.

        Some links stand still once the tips of the pinch meet: those of two fingers that close on
        each other, and those moved only by actuators that the contact stops. They must stay apart
        only until the tips are within the hand's clearance of each other.
        """
        moving, wanted = frozenset(actuators), set(tips)
        pairs = [
            pair
            for pair in self.checked
            if pair.actuators & moving and frozenset(pair.links) not in wanted
        ]
        groups: dict[tuple[int, int] | None, list[LinkPair]] = {}
        if closing is not None:
            fingers, stopped, kept = self._fingers(closing), self._stopped(closing), []
            for pair in pairs:
                ends = _of_two(fingers, pair.bodies)
                if ends is None and not pair.actuators <= stopped:
                    kept.append(pair)
                else:
                    groups.setdefault(ends, []).append(pair)
            pairs = kept
        carrying = [pair for group in groups.values() for pair in group]
        # `checked` is sorted, so the nested pairs are the last in any selection.
        nested = sum(pair.links in self._nested for pair in pairs)
        margins = {pair.number: self.margin(pair) for pair in (*pairs, *carrying)}
        if closing is not None:
            near = self._near_tips(closing)
            # Links beside the tips may touch: they carry the pinch as well as the tips do.
            beside = [pair for pair in carrying if near.issuperset(pair.bodies)]
            margins |= {pair.number: TOUCH for pair in beside}
        clearance = self._scene.hand.clearance
        carried = Carried(closing, groups, clearance) if closing and carrying else None
        measures = Measures(self._scene, self._motion, self._envelopes)
        return CollisionChecker(measures, pairs, margins, nested, carried)

    def meetings(self, u: FloatArray) -> dict[int, float]:
        """Return where the empty hand touches itself on the straight path from rest to a posture.

        Links touch where they are nearer than their margin.

        Args:
            u: The posture ``(n,)``.

        Returns:
            By actuator index, the intensity of the first contact of links that the actuator moves
            relative to each other; actuators without such a contact are missing.
        """
        scene, path = self._scene, self._motion.path_to(u)
        moving = np.flatnonzero(u != scene.hand.rest).tolist()
        checker, found = self.checker(moving, ()), dict[int, float]()
        for i in moving:
            first = checker.first_on(path, [pair for pair in checker.pairs if i in pair.actuators])
            if first is not None:
                found[i] = first.at
        whole = {pair.number for pair in self.checked}
        for pair in scene.tips.values():
            # Joined tips, such as a claw's, and tips of several links are not among the checked.
            if pair.number not in whole and (concerned := pair.actuators.intersection(moving)):
                at = first_contact(scene, pair, path, self._motion.speed(pair, path))
                if at is not None:
                    found |= {i: min(at, found.get(i, at)) for i in concerned}
        return found

    def _fingers(self, closing: PinchClosing) -> list[frozenset[int]]:
        """Return the bodies that belong to a single finger: its bars, and the chain of its tip."""
        supports = [
            frozenset(self._scene.kinematics.model.supports[body]) | bars
            for body, bars in zip(closing.bodies, closing.bars, strict=True)
        ]
        return [
            support.difference(*(o for k, o in enumerate(supports) if k != i))
            for i, support in enumerate(supports)
        ]

    def _stopped(self, closing: PinchClosing) -> frozenset[int]:
        """Return the actuators that the contact of a closed pinch stops.

        Each is the only actuator that moves its finger's tip relative to the others. A finger with
        more such actuators may still bend or swing while its tip is held.
        """
        moves, stopped = self._scene.hand.transmission.moves, set[int]()
        for number, body in enumerate(closing.bodies):
            support = self._scene.kinematics.model.supports[body]
            mine = {moves(joint - 1) for joint in support if joint}
            edges = [edge.tips.actuators for edge in closing.edges if number in edge.ends]
            closes = {a for actuators in edges for a in actuators if a in mine}
            if len(closes) == 1:
                stopped |= closes
        return frozenset(stopped)

    def _near_tips(self, closing: PinchClosing) -> set[int]:
        """Return the bodies of the tips and of the links next to them."""
        parents = self._scene.kinematics.model.parents
        return {*closing.bodies, *(parents[body] for body in closing.bodies)}


def _crossing(scene: Scene, first: int, second: int) -> bool:
    """Return whether two consecutive joints turn about crossing axes."""
    joints = [scene.hand.joints[body - 1] for body in (first, second)]
    if any(joint.kind is JointKind.PRISMATIC for joint in joints):
        return False
    placement = scene.kinematics.model.jointPlacements[second]
    axes = [np.array(scene.hand.urdf.joints[joint.name].axis) for joint in joints]
    across = cross(axes[0], matvec(placement.rotation, axes[1]))
    length = norm(across)
    # The distance between the two axes, along their common perpendicular.
    return length > _PARALLEL and (
        abs(dot(across, np.array(placement.translation))) <= scene.hand.clearance * length
    )


def _of_two(fingers: Sequence[frozenset[int]], bodies: tuple[int, int]) -> tuple[int, int] | None:
    """Return the numbers of the two fingers that two bodies belong to.

    Return ``None`` if the bodies do not belong to two different fingers.
    """
    a, b = (next((i for i, own in enumerate(fingers) if body in own), None) for body in bodies)
    return None if a is None or b is None or a == b else (min(a, b), max(a, b))


@dataclass(frozen=True, slots=True)
class Carried:
    """The links that carry a pinch, which must stay apart until it closes.

    Attributes:
        closing: The pinch.
        groups: Pairs of links, other than the tips that should touch, by the numbers of the two
            fingers to which they belong. These pairs must stay apart until contacts link the two
            fingers; those under ``None``, until contacts link all fingers.
        near: Distance at which tips count as touching [m].
    """

    closing: PinchClosing
    groups: Mapping[tuple[int, int] | None, Sequence[LinkPair]]
    near: float


@dataclass(frozen=True, slots=True)
class Measures:
    """Objects that measure links: the scene, and bounds on their motion and distances."""

    scene: Scene
    motion: MotionBounds
    envelopes: Envelopes


class CollisionChecker:
    """Checks the links that must stay apart in one search.

    Two links collide if their distance is less than their margin.

    Attributes:
        pairs: The pairs of links.
    """

    def __init__(
        self,
        measures: Measures,
        pairs: Sequence[LinkPair],
        margins: Mapping[int, float],
        nested: int,
        carried: Carried | None = None,
    ) -> None:
        """Prepare checks of some pairs of links.

        Args:
            measures: Objects that measure the links.
            pairs: The pairs.
            margins: The distances that the links must keep, by number of the pair [m].
            nested: Number of nested pairs, which are the last in ``pairs``.
            carried: Further pairs, which must stay apart only until a pinch closes.
        """
        self._measures = measures
        self._scene, self._motion = measures.scene, measures.motion
        self.pairs = tuple(pairs)
        self._margin_of = dict(margins)
        self._margins = np.array([self._margin_of[pair.number] for pair in pairs])
        self._nested = nested
        self._carried = carried
        self._known = LinkDistanceBounds(self._motion, self.pairs)
        self._paths: dict[bytes, Blocked | None] = {}
        # All pairs that a check may need, and the bounds on their distances on the last path.
        groups = carried.groups.values() if carried else ()
        every = (*self.pairs, *(pair for group in groups for pair in group))
        self._ends = measures.envelopes.ends(every)
        self._column = {pair.number: c for c, pair in enumerate(every)}
        levers = np.array([self._motion.levers(pair) for pair in every])
        self._levers = levers.reshape(-1, self._motion.joints)
        self._every = np.array([self._margin_of[pair.number] for pair in every])
        self._along: tuple[bytes, FloatArray] | None = None

    def margin(self, pair: LinkPair) -> float:
        """Return the distance that two links must keep [m]."""
        return self._margin_of[pair.number]

    @cached_property
    def reduced(self) -> CollisionChecker:
        """A checker of the same links with a quarter of the margins."""
        margins = {n: max(TOUCH, margin * REDUCED) for n, margin in self._margin_of.items()}
        return CollisionChecker(self._measures, self.pairs, margins, self._nested, self._carried)

    def _bounds(self, path: StraightPath) -> FloatArray:
        """Return bounds on the distances of all pairs at `_PLACES` of a path ``(t, p)`` [m]."""
        key = path.goal.tobytes()
        if self._along is None or self._along[0] != key:
            postures = [path.at(t) for t in _PLACES.tolist()]
            # Distance from which pairs are free on the smallest part of a path.
            apart = self._speeds(path) / (2.0 * _PARTS) + self._every
            apart = np.maximum(apart, FARTHEST_CLEARANCE * self._scene.unit)
            self._along = key, self._measures.envelopes.gaps(postures, self._ends, apart)
        return self._along[1]

    def _speeds(self, path: StraightPath) -> FloatArray:
        """Return bounds on the speeds of all pairs per unit of a path ``(p,)`` [m]."""
        return matvec(self._levers, path.travel)

    def clearance(self, u: FloatArray, *, path: bool) -> float:
        """Return the least distance of the links at a posture [m], 5 mm at most.

        Args:
            u: The posture ``(n,)``.
            path: Whether to measure on the straight path from rest, too, at 65 points.
        """
        scene = self._scene
        least = FARTHEST_CLEARANCE * scene.unit
        straight = self._motion.path_to(u)
        count = len(self.pairs)
        places = _PLACES if path else _PLACES[-1:]
        bounds = self._bounds(straight)[-len(places) :, :count].copy()
        if not bounds.size:
            return least
        speeds = self._speeds(straight)
        # Measure the least bound first, until no pair can be nearer than the nearest so far.
        while True:
            k, c = divmod(int(np.argmin(bounds)), count)
            if bounds[k, c] >= least:
                return least
            pair, t = self.pairs[c], places[k]
            scene.place(straight.at(float(t)))
            gap = scene.at_least(pair)
            # A proximity test of meshes is faster than their distance.
            if gap < least and scene.nearer(pair, least):
                least = min(least, scene.exact_distance(pair))
            # The pair cannot be much nearer at the neighbouring points, either.
            bounds[:, c] = np.maximum(bounds[:, c], gap - speeds[c] * np.abs(places - t))
            bounds[k, c] = np.inf

    def at(self, u: FloatArray) -> list[LinkPair]:
        """Return the pairs of links that collide at a posture ``(n,)``."""
        return self._colliding(u, 0, len(self.pairs))

    def unnested(self, u: FloatArray) -> list[LinkPair]:
        """Return the pairs that collide, without those of links that are nested at rest."""
        return self._colliding(u, 0, len(self.pairs) - self._nested)

    def nested(self, u: FloatArray) -> list[LinkPair]:
        """Return the pairs that collide among those of links that are nested at rest."""
        return self._colliding(u, len(self.pairs) - self._nested, len(self.pairs))

    def _colliding(self, u: FloatArray, begin: int, end: int) -> list[LinkPair]:
        scene = self._scene
        scene.place(u)
        margins = self._margins + _SURE
        near = begin + np.flatnonzero((self._known.least(scene.joints) <= margins)[begin:end])
        if len(near) > _FEW:
            bounds = self._measures.envelopes.gaps([u], self._ends[:, near], margins[near])[0]
            near = near[bounds <= margins[near]]
        self._known.learn(near, [scene.at_least(self.pairs[c]) for c in near], scene.joints)
        return [self.pairs[c] for c in near if scene.nearer(self.pairs[c], float(self._margins[c]))]

    def blocked(self, u: FloatArray) -> Blocked | None:
        """Return the first collision on the straight path from rest to a posture, or ``None``.

        Links whose convex parts are farther apart than they can move are free. For the others, the
        search halves the path repeatedly, and checks the remaining parts exactly, in steps in which
        near links move at most 1 mm relative to each other.
        """
        key = u.tobytes()
        # Cached, since measuring the evidence checks the same posture again.
        if key not in self._paths:
            self._paths[key] = self.first_blocked(self._motion.path_to(u))
        return self._paths[key]

    def first_blocked(self, path: StraightPath) -> Blocked | None:
        """Return the first collision on a path, or ``None``.

        For links that carry the pinch, only collisions before it closes count.
        """
        first, carried = self.first_on(path, self.pairs), self._carried
        if carried is None:
            return first
        contacts, tips = self._contacts(path, carried), len(carried.closing.bodies)
        for ends, pairs in carried.groups.items():
            at = linked_at(tips, contacts, ends)
            closed = 1.0 if at is None else at
            until = closed if first is None else min(first.at, closed)
            early = self.first_on(path, pairs, until)
            if early is not None and early.at < until:
                first = Blocked(early.pair, early.at, closed)
        return first

    def _contacts(
        self, path: StraightPath, carried: Carried
    ) -> list[tuple[tuple[int, int], float | None]]:
        """Return the intensities at which the tips come within `Carried.near` of each other."""
        scene, motion, near = self._scene, self._motion, carried.near
        return [
            (e.ends, first_contact(scene, e.tips, path, motion.speed(e.tips, path), near))
            for e in carried.closing.edges
        ]

    def first_on(
        self, path: StraightPath, pairs: Sequence[LinkPair], until: float = np.inf
    ) -> Blocked | None:
        """Return the first collision of these links on a path, or ``None``.

        The search may miss collisions at or beyond the intensity ``until``.
        """
        first: Blocked | None = None
        # In the order of their starts: runs beyond the first collision need no exact checks.
        for pair, ends in sorted(self._near_runs(path, pairs, until), key=lambda run: run[1][0]):
            if first is not None:
                if ends[0] >= first.at:
                    break
                ends = [*(t for t in ends if t < first.at), first.at]
            at = self._first_in(pair, path, ends, until)
            if at is not None and (first is None or at < first.at):
                first = Blocked(pair, at)
        return first

    def _near_runs(
        self, path: StraightPath, pairs: Sequence[LinkPair], until: float
    ) -> list[tuple[LinkPair, list[float]]]:
        """Return the runs of the path on which each pair may touch, as the ends of their parts.

        Runs that start at the intensity ``until`` or later are left out.
        """
        columns_of = [self._column[pair.number] for pair in pairs]
        speeds, margins = self._speeds(path)[columns_of].tolist(), self._every[columns_of].tolist()
        apart = np.full((_PARTS + 1, len(pairs)), -np.inf)
        if len(pairs) > _FEW_ON_PATH:
            apart = self._bounds(path)[:: (len(_PLACES) - 1) // _PARTS, columns_of]
        # The same test as below, of all pairs on all parts at once.
        reach = np.array(speeds) / _PARTS + 2.0 * np.array(margins)
        alive = apart[:-1] + apart[1:] <= reach
        # Bounds on overlaps decide nothing.
        alive |= np.minimum(apart[:-1], apart[1:]) <= np.array(margins)

        def live(part: tuple[float, float], columns: Iterable[int]) -> list[int]:
            begin, end = (int(t * _PARTS) for t in part)
            within = set(np.flatnonzero(alive[begin:end].any(axis=0)).tolist())
            return [c for c in columns if c in within]

        gaps: list[dict[float, float]] = [{} for _ in pairs]
        left: list[list[tuple[float, float]]] = [[] for _ in pairs]
        whole = (0.0, 1.0)
        parts = {whole: live(whole, range(len(pairs)))}
        while parts:
            asked: dict[float, set[int]] = {}
            for ends, columns in parts.items():
                for t in ends:
                    asked.setdefault(t, set()).update(columns)
            # Grouped by intensity, since placing the hand costs more than measuring a pair.
            for t, concerned in asked.items():
                new = [c for c in concerned if t not in gaps[c]]
                if new:
                    self._scene.place(path.at(t))
                for c in new:
                    gaps[c][t] = self._scene.at_least(pairs[c])
            halves: dict[tuple[float, float], list[int]] = {}
            for (start, end), columns in parts.items():
                middle, halved = (start + end) / 2.0, []
                for c in columns:
                    here, there = gaps[c][start] - margins[c], gaps[c][end] - margins[c]
                    # To touch in between, links would have to cover both gaps.
                    if here + there > speeds[c] * (end - start):
                        continue
                    overlap = here <= 0.0 and there <= 0.0
                    if (end - start) * (_COARSE_PARTS if overlap else _PARTS) <= 1.0:
                        left[c].append((start, end))
                    else:
                        halved.append(c)
                for half in ((start, middle), (middle, end)) if halved else ():
                    if half[0] < until and (near := live(half, halved)):
                        halves[half] = near
            parts = halves
        return [(pair, run) for pair, ends in zip(pairs, left, strict=True) for run in _runs(ends)]

    def _first_in(
        self, pair: LinkPair, path: StraightPath, ends: Sequence[float], until: float
    ) -> float | None:
        """Return the intensity of a pair's first contact on a run of the path, or ``None``.

        Looks no farther than the first point at or beyond the intensity ``until``.
        """
        travelled = self._motion.travelled(pair, path, ends)
        # Take equal steps of motion, not of intensity: links move unevenly along the path.
        steps = min(max(1, int(np.ceil(travelled[-1] / STEP))), _MOST)
        margin, places = self._margin_of[pair.number], [ends[0]]
        for goal in np.linspace(0.0, travelled[-1], steps + 1)[1:]:
            t = float(np.interp(goal, travelled, ends)) if travelled[-1] > 0.0 else ends[-1]
            # Round to a lattice, which is independent of a processor's last digits.
            places.append(min(ends[-1], round(t / _PLACE) * _PLACE))
        number = 1
        while number <= steps and places[number - 1] < until:
            t = places[number]
            self._scene.place(path.at(t))
            if self._scene.nearer(pair, margin):
                return bisect(self._scene, pair, path, places[number - 1], t, margin)
            # Skip points at which the links cannot be near yet: a step moves them by `STEP`.
            gap = self._scene.at_least(pair) - margin
            number += 1 + max(0, int(gap / (_CAUTIOUS * STEP)))
        return None


def _runs(parts: list[tuple[float, float]]) -> list[list[float]]:
    """Return runs of consecutive parts of a path, each as the ends of its parts."""
    runs: list[list[float]] = []
    for start, end in sorted(parts):
        if runs and runs[-1][-1] == start:
            runs[-1].append(end)
        else:
            runs.append([start, end])
    return runs


def linked_at(
    size: int,
    firsts: Sequence[tuple[tuple[int, int], float | None]],
    ends: tuple[int, int] | None = None,
) -> float | None:
    """Return the intensity from which contacts link all tips, or two of them; ``None`` if never.

    Args:
        size: Number of tips.
        firsts: Pairs of tips, with the intensities at which they first touch.
        ends: The two tips; all tips unless given.
    """
    # Add contacts in the order in which they occur on the path, until the tips are linked.
    known = sorted((at, edge) for edge, at in firsts if at is not None)
    for i, (at, _) in enumerate(known):
        edges = [edge for _, edge in known[: i + 1]]
        if linked(size, edges) or (ends is not None and _joined(edges, ends)):
            return at
    return None


def _joined(edges: Sequence[tuple[int, int]], ends: tuple[int, int]) -> bool:
    """Return whether the edges connect two nodes, directly or through others."""
    reached, before = {ends[0]}, 0
    while len(reached) > before:
        before = len(reached)
        reached |= {node for edge in edges if reached & set(edge) for node in edge}
    return ends[1] in reached


def first_contact(
    scene: Scene, pair: LinkPair, path: StraightPath, speed: float, margin: float = TOUCH
) -> float | None:
    """Return the intensity of two links' first contact on the path, or ``None``.

    Uses conservative advancement (Mirtich, 1996) on the convex parts and, if these overlap, exact
    checks at most half a millimetre of motion apart.

    Args:
        scene: The scene.
        pair: The links.
        path: The path.
        speed: Bound on the relative speed of the links per unit of the path [m].
        margin: Distance at which the links count as touching [m].
    """
    # If the parts overlap, the gap gives no step; use the finest one.
    finest = max(_FINE / speed, 1.0 / _MOST) if speed > 0.0 else 1.0
    t = before = 0.0
    while True:
        scene.place(path.at(t))
        gap = scene.at_least(pair)
        if gap <= margin and scene.nearer(pair, margin):
            return bisect(scene, pair, path, before, t, margin)
        if t >= 1.0:
            return None
        before = t
        t = min(1.0, t + max((gap - margin) / speed if speed > 0.0 else 0.0, finest))


def bisect(
    scene: Scene,
    pair: LinkPair,
    path: StraightPath,
    apart: float,
    touching: float,
    margin: float,
    precision: float = _PLACE,
) -> float:
    """Return an intensity at which two links begin to be nearer than a margin.

    Args:
        scene: The scene.
        pair: The links.
        path: The path.
        apart: An intensity at which they are farther apart; may equal ``touching``.
        touching: A larger intensity at which they are nearer.
        margin: The margin [m].
        precision: Largest error of the result.
    """
    while touching - apart > precision:
        middle = (apart + touching) / 2.0
        scene.place(path.at(middle))
        if scene.nearer(pair, margin):
            touching = middle
        else:
            apart = middle
    return touching
