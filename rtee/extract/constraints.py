"""What a search for clear poses has learned: links that are to stay apart, and how far."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.extract.collisions import Blocked, Watch, bisect
from rtee.extract.descent import Objective, Slope
from rtee.extract.goals import Goal
from rtee.extract.grain import COARSE, MEDIUM
from rtee.extract.motion import Motion, Way
from rtee.extract.pairs import LinkPair
from rtee.extract.scene import Scene
from rtee.extract.space import Space, rounded
from rtee.types import FloatArray

WEIGHT: Final = 5.0
CLOSE: Final = 5e-5
NEAR: Final = 5e-3
CLOSER: Final = 1e-3
"""Between convex parts this far apart the exact gap does not matter [m]."""

_SHRINK: Final = 0.2
_STRENGTHEN: Final = 2.0
_STRONGEST: Final = 40.0
_COARSE: Final = 0.01
_SAFE: Final = 2e-5
_MARGIN: Final = 1e-4
_SAMPLES: Final = 16
_STATIONS: Final = 4
_MOST_STATIONS: Final = 8
_APART: Final = 0.02
_POSE: Final = (1.0,)


@dataclass(slots=True)
class Constraint:
    """Two links that are to stay apart.

    Attributes:
        pair: The links.
        times: Where on the way, as intensities; 1 is the pose itself.
        allowance: How deep their convex parts may overlap there before the links are too near [m];
            negative where the parts are to stay apart.
        weight: Factor of the penalty.
    """

    pair: LinkPair
    times: tuple[float, ...]
    allowance: float
    weight: float = WEIGHT


class Constraints:
    """Learns from collisions at poses and on the ways to them, and keeps poses out of them.

    The convex parts of two links stand in for the links: they overlap before the links collide, by
    an allowance that is measured where the links first touch.
    """

    def __init__(
        self, scene: Scene, motion: Motion, goal: Goal, space: Space, watch: Watch
    ) -> None:
        """Begin with none.

        Args:
            scene: The hand's links.
            motion: Bounds on their motion.
            goal: What to press together.
            space: Where to search.
            watch: The links that may not collide.
        """
        self._scene = scene
        self._motion = motion
        self._goal = goal
        self._space = space
        self._watch = watch
        self._index = [int(i) for i in space.index]
        self._varying = frozenset(self._index)
        self._low, self._high = np.zeros(space.size), np.ones(space.size)
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
        self._scene.place(rounded(self._scene.hand, self._space.posture(y)))
        for c in self._known:
            overlap, room = -self._scene.distance(c.pair), self._watch.room(c.pair)
            if c.times == _POSE and overlap > -CLOSER - room:
                gap = self._scene.exact_distance(c.pair) - room
                c.allowance = max(c.allowance, COARSE.value(overlap + gap - CLOSE))
                c.weight = WEIGHT

    def learn(self, pair: LinkPair, y: FloatArray) -> None:
        """Learn from a collision at a pose."""
        if self._bound(pair, y):
            return
        known = self._of(pair)
        if known is not None:
            self._tighten(known, self._overlap(pair, self._way(y), 1.0))
            return
        way = self._way(y)
        at = bisect(self._scene, pair, way, 0.0, 1.0, self._watch.room(pair), _COARSE)
        overlap = self._overlap(pair, way, max(0.0, at - _COARSE))
        self._known.append(Constraint(pair, _POSE, overlap))

    def learn_way(self, blocked: Blocked, y: FloatArray) -> None:
        """Learn from a collision on the way to a pose."""
        if self._bound(blocked.pair, y):
            return
        way = self._way(y)
        times = np.linspace(blocked.at, 1.0, _SAMPLES, endpoint=False).tolist()
        overlaps = [self._overlap(blocked.pair, way, t) for t in times]
        deepest = times[int(np.argmax(overlaps))]
        known = self._of(blocked.pair, on_way=True)
        if known is None:
            few = (*times[:: _SAMPLES // _STATIONS], deepest)
            self._known.append(Constraint(blocked.pair, few, overlaps[0]))
        elif all(abs(t - deepest) > _APART for t in known.times):
            known.times = (*known.times[-_MOST_STATIONS:], deepest)
        else:
            self._tighten(known, max(overlaps))

    def _of(self, pair: LinkPair, *, on_way: bool = False) -> Constraint | None:
        of_pair = (c for c in self._known if c.pair is pair)
        return next((c for c in of_pair if (c.times != _POSE) is on_way), None)

    def _tighten(self, constraint: Constraint, overlap: float) -> None:
        """Allow less than an overlap at which the links do collide."""
        least = min(constraint.allowance, overlap)
        constraint.allowance = COARSE.value(least - max(CLOSE, _SHRINK * abs(least)))
        constraint.weight = min(_STRONGEST, constraint.weight * _STRENGTHEN)

    def _bound(self, pair: LinkPair, y: FloatArray) -> bool:
        """Bound an actuator that alone moves two links, where they first collide on its way."""
        moving = pair.actuators & self._varying
        if len(moving) != 1:
            return False
        (actuator,) = moving
        goal = self._scene.hand.rest.copy()
        goal[actuator] = self._space.posture(y)[actuator]
        blocked = self._watch.first(self._motion.way(goal), [pair])
        if blocked is None:
            return False
        share = max(0.0, blocked.at - _SAFE)
        goal[actuator] = goal[actuator] * share + self._scene.hand.rest[actuator] * (1.0 - share)
        i = self._index.index(actuator)
        limit, rest = MEDIUM.point(self._space.coordinates(goal))[i], self._space.rest[i]
        if limit >= rest and y[i] > rest:
            self._high[i] = min(self._high[i], limit)
        else:
            self._low[i] = max(self._low[i], limit)
        return True

    def _way(self, y: FloatArray) -> Way:
        return self._motion.way(self._space.posture(y))

    def _overlap(self, pair: LinkPair, way: Way, at: float) -> float:
        self._scene.place(way.at(at))
        overlap = -self._scene.distance(pair) - _MARGIN
        return COARSE.value(max(-self._watch.room(pair), overlap))

    def penalised(self, *, ways_only: bool = False) -> Objective:
        """Return the goal with a penalty for overlaps beyond the allowances."""
        scene, space, goal, rest = self._scene, self._space, self._goal, self._scene.hand.rest
        here = [c for c in self._known if c.times == _POSE and not ways_only]
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
            slope = sloping()  # now: the links are placed elsewhere next
            for c in before:
                least, steepest = np.inf, slope
                for t in c.times:
                    scene.place(rest + t * (u - rest))
                    gap = scene.distance(c.pair)
                    if gap < min(least, -c.allowance):
                        least, steepest = gap, t * scene.derivative(c.pair, space)
                if least < -c.allowance:
                    value -= c.weight * (least + c.allowance)
                    slope = slope - c.weight * steepest
            return value, lambda: slope

        return function
