"""Constraints that a search for clear poses learns: links that have to stay apart, and how far."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.extract.collisions import Blocked, CollisionChecker, bisect
from rtee.extract.descent import Objective, Slope
from rtee.extract.goals import GoalFunction
from rtee.extract.motion import Motion, StraightPath
from rtee.extract.pairs import LinkPair
from rtee.extract.resolution import COARSE, MEDIUM
from rtee.sample import FloatArray
from rtee.types import from_rest

WEIGHT: Final = 5.0
"""What a metre beyond a constraint counts at first, in metres of depth: more than the goal gains by
it, so that the penalty is exact."""

CLOSE: Final = 5e-5
"""Values and gaps are compared to this [m]: a few units of the medium resolution."""

NEAR: Final = 5e-3
"""Links farther apart than this are out of reach of one step in the trust region [m]."""

CLOSER: Final = 1e-3
"""Between convex parts this far apart the exact gap does not matter [m]."""

_SHRINK: Final = 0.2
"""An allowance at which links still collided is lowered by this share of itself: enough to get out
within a few rounds, without giving away much depth."""

_STRENGTHEN: Final = 2.0
_STRONGEST: Final = 40.0
"""Factor by which the weight of a constraint grows when it was broken, and its upper bound: beyond,
the penalty is so steep that descents end on it."""

_COARSE: Final = 0.01
"""Precision with which the first contact on the path is sought, as an intensity: the allowance
measured there is a first guess."""

_SAFE: Final = 2e-5
"""How far before a collision an actuator's bound is put, as an intensity: more than rounding."""

_MARGIN: Final = 1e-4
"""How much less than at the first contact the convex parts may overlap at first [m]."""

_SAMPLES: Final = 16
"""At how many intensities beyond a collision on the path the overlap is measured: enough to find
where it is deepest."""

_STATIONS: Final = 4
_MOST_STATIONS: Final = 8
"""At how many of them a constraint on the path holds at first, and at most: each takes a
placement of the hand in every evaluation."""

_APART: Final = 0.02
"""Intensities that differ by less are one station."""

_POSE: Final = (1.0,)
"""The intensities of a constraint at the pose alone."""


@dataclass(slots=True)
class Constraint:
    """Two links that have to stay apart.

    Attributes:
        pair: The links.
        times: Where on the path, as intensities; 1 is the pose itself.
        allowance: How deep their convex parts may overlap there before the links are too near [m];
            negative where the parts have to stay apart.
        weight: Factor of the penalty.
    """

    pair: LinkPair
    times: tuple[float, ...]
    allowance: float
    weight: float = WEIGHT


class Constraints:
    """Learns from collisions at poses and on the paths to them, and keeps poses out of them.

    The convex parts of two links are measured in place of the links. They overlap before the links
    collide, by an allowance that is measured where the links first touch.
    """

    def __init__(self, function: GoalFunction, motion: Motion, checker: CollisionChecker) -> None:
        """Begin with none.

        Args:
            function: What to press together, over the space to search.
            motion: Bounds on the motion of the links.
            checker: The links that may not collide.
        """
        self._function = function
        self._scene, self._space = function.scene, function.space
        self._motion = motion
        self._checker = checker
        self._index = [int(i) for i in self._space.index]
        self._varying = frozenset(self._index)
        self._low, self._high = np.zeros(self._space.size), np.ones(self._space.size)
        self._known: list[Constraint] = []

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the box that is left ``(k,)``."""
        return self._low, self._high

    @property
    def learned(self) -> bool:
        """Whether anything keeps poses out of anything."""
        return bool(self._known or self._low.any() or (self._high < 1.0).any())

    def concerned(self) -> dict[tuple[str, str], LinkPair]:
        """Return the links that collided at poses, by their names."""
        return {c.pair.links: c.pair for c in self._known if c.times == _POSE}

    def calibrate(self, y: FloatArray) -> None:
        """Allow at least the overlaps at which links would touch near a clear pose."""
        self._scene.place(self._function.stored(y))
        for c in self._known:
            overlap, margin = -self._scene.distance(c.pair), self._checker.margin(c.pair)
            if c.times == _POSE and overlap > -CLOSER - margin:
                # What is free here in truth may be added to the overlap of the convex parts.
                gap = self._scene.exact_distance(c.pair) - margin
                c.allowance = max(c.allowance, COARSE.rounded_value(overlap + gap - CLOSE))
                c.weight = WEIGHT

    def learn(self, pair: LinkPair, y: FloatArray) -> None:
        """Learn from a collision at a pose."""
        if self._bound(pair, y):
            return
        known = self._of(pair)
        if known is not None:
            self._tighten(known, self._overlap(pair, self._path(y), 1.0))
            return
        path = self._path(y)
        at = bisect(self._scene, pair, path, 0.0, 1.0, self._checker.margin(pair), _COARSE)
        overlap = self._overlap(pair, path, max(0.0, at - _COARSE))
        self._known.append(Constraint(pair, _POSE, overlap))

    def learn_path(self, blocked: Blocked, y: FloatArray) -> None:
        """Learn from a collision on the path to a pose."""
        if self._bound(blocked.pair, y):
            return
        path = self._path(y)
        times = np.linspace(blocked.at, 1.0, _SAMPLES, endpoint=False).tolist()
        overlaps = [self._overlap(blocked.pair, path, t) for t in times]
        deepest = times[int(np.argmax(overlaps))]
        known = self._of(blocked.pair, on_path=True)
        if known is None:
            # The deepest place and some others: where one is kept apart, another becomes deepest.
            few = (*times[:: _SAMPLES // _STATIONS], deepest)
            self._known.append(Constraint(blocked.pair, few, overlaps[0]))
        elif all(abs(t - deepest) > _APART for t in known.times):
            known.times = (*known.times[-_MOST_STATIONS:], deepest)
        else:
            self._tighten(known, max(overlaps))

    def _of(self, pair: LinkPair, *, on_path: bool = False) -> Constraint | None:
        of_pair = (c for c in self._known if c.pair is pair)
        # At most one of each: what else is learned tightens it.
        return next((c for c in of_pair if (c.times != _POSE) is on_path), None)

    def _tighten(self, constraint: Constraint, overlap: float) -> None:
        """Allow less than an overlap at which the links do collide."""
        least = min(constraint.allowance, overlap)
        constraint.allowance = COARSE.rounded_value(least - max(CLOSE, _SHRINK * abs(least)))
        # The penalty was not enough to keep the pose out, so it gets steeper, too.
        constraint.weight = min(_STRONGEST, constraint.weight * _STRENGTHEN)

    def _bound(self, pair: LinkPair, y: FloatArray) -> bool:
        """Bound an actuator that alone moves two links, where they first collide on its path."""
        moving = pair.actuators & self._varying
        # Only then the collision depends on one coordinate, and a bound says all there is to say.
        if len(moving) != 1:
            return False
        (actuator,) = moving
        rest = self._scene.hand.rest
        goal = rest.copy()
        goal[actuator] = self._space.posture(y)[actuator]
        blocked = self._checker.first_on(self._motion.path_to(goal), [pair])
        if blocked is None:
            return False
        share = max(0.0, blocked.at - _SAFE)
        goal[actuator] = goal[actuator] * share + rest[actuator] * (1.0 - share)
        i = self._index.index(actuator)
        limit, start = MEDIUM.snap(self._space.coordinates(goal))[i], self._space.rest[i]
        # On the far side of rest the bound is an upper one, on the near side a lower one.
        if limit >= start and y[i] > start:
            self._high[i] = min(self._high[i], limit)
        else:
            self._low[i] = max(self._low[i], limit)
        return True

    def _path(self, y: FloatArray) -> StraightPath:
        return self._motion.path_to(self._space.posture(y))

    def _overlap(self, pair: LinkPair, path: StraightPath, at: float) -> float:
        self._scene.place(path.at(at))
        overlap = -self._scene.distance(pair) - _MARGIN
        return COARSE.rounded_value(max(-self._checker.margin(pair), overlap))

    def penalised(self, *, paths_only: bool = False) -> Objective:
        """Return the goal with a penalty for overlaps beyond the allowances."""
        scene, space, goal = self._scene, self._space, self._function.goal
        here = [c for c in self._known if c.times == _POSE and not paths_only]
        before = [c for c in self._known if c.times != _POSE]

        def function(y: FloatArray) -> tuple[float, Slope]:
            u = space.posture(y)
            scene.place(u)
            value, rise = goal.slope(space)
            terms = []
            for c in here:
                gap = scene.distance(c.pair)
                if gap < -c.allowance:
                    value -= c.weight * (gap + c.allowance)
                    terms.append((c.pair, -c.weight))

            def sloping() -> FloatArray:
                return rise() + scene.gradient(terms, space) if terms else rise()

            if not before:
                return value, sloping
            slope = sloping()  # now, since the links are placed elsewhere next
            for c in before:
                least, steepest = np.inf, slope
                for t in c.times:
                    scene.place(from_rest(scene.hand.rest, u, t))
                    gap = scene.distance(c.pair)
                    if gap < min(least, -c.allowance):
                        least, steepest = gap, t * scene.derivative(c.pair, space)
                if least < -c.allowance:
                    value -= c.weight * (least + c.allowance)
                    slope = slope - c.weight * steepest
            return value, lambda: slope

        return function
