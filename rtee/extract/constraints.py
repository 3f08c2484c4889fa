"""Constraints learned in a search for clear poses: links that must stay apart, and how far."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.extract.collisions import Blocked, CollisionChecker, bisect
from rtee.extract.descent import Objective, Slope
from rtee.extract.goals import GoalFunction
from rtee.extract.motion import MotionBounds, StraightPath
from rtee.extract.pairs import LinkPair
from rtee.extract.resolution import COARSE, MEDIUM
from rtee.sample import FloatArray
from rtee.types import from_rest

WEIGHT: Final = 5.0
"""Initial weight of a violated constraint, in metres of depth per metre: more than the goal gains
by a violation, so that the penalty is exact."""

CLOSE: Final = 5e-5
"""Tolerance in comparisons of values and gaps [m]: a few units of the medium resolution."""

NEAR: Final = 5e-3
"""Distance beyond which links cannot collide within one step in the trust region [m]."""

CLOSER: Final = 1e-3
"""Distance of convex parts beyond which the exact gap does not matter [m]."""

_SHRINK: Final = 0.2
"""Share by which an allowance shrinks if links still collide: enough to end the collision in a few
rounds, without losing much depth."""

_STRENGTHEN: Final = 2.0
_STRONGEST: Final = 40.0
"""Factor by which the weight of a violated constraint grows, and the weight's upper bound: descents
would stall on a steeper penalty."""

_COARSE: Final = 0.01
"""Precision of the first contact on the path, as an intensity: the allowance measured there is only
a first guess."""

_SAFE: Final = 2e-5
"""Distance of an actuator's bound from a collision, as an intensity: more than rounding errors."""

_MARGIN: Final = 1e-4
"""Difference between the overlap at the first contact and the first allowance [m]."""

_SAMPLES: Final = 16
"""Number of intensities beyond a collision on the path at which the overlap is measured: enough to
find the deepest one."""

_STATIONS: Final = 4
_MOST_STATIONS: Final = 8
"""Number of intensities of a constraint on the path, at first and at most: each costs a placement
of the hand per evaluation."""

_APART: Final = 0.02
"""Largest difference of intensities that count as one station."""

_POSE: Final = (1.0,)
"""The intensities of a constraint at the pose alone."""


@dataclass(slots=True)
class Constraint:
    """Two links that must stay apart.

    Attributes:
        pair: The links.
        times: Intensities on the path at which they are measured; 1 is the pose itself.
        allowance: Largest allowed overlap of their convex parts [m]; negative if the parts must
            stay apart.
        weight: Factor of the penalty.
    """

    pair: LinkPair
    times: tuple[float, ...]
    allowance: float
    weight: float = WEIGHT


class Constraints:
    """Learns constraints from collisions at poses and on the paths to them.

    Constraints measure the convex parts of two links instead of the links themselves. The parts may
    overlap before the links collide; the allowance is their overlap at the links' first contact.
    """

    def __init__(
        self, function: GoalFunction, motion: MotionBounds, checker: CollisionChecker
    ) -> None:
        """Start without constraints, for a goal over the space to search."""
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
        """Lower and upper corner of the remaining box ``(k,)``."""
        return self._low, self._high

    @property
    def learned(self) -> bool:
        """Whether there are any constraints or bounds."""
        return bool(self._known or self._low.any() or (self._high < 1.0).any())

    def concerned(self) -> dict[tuple[str, str], LinkPair]:
        """Return the pairs of links that collided at poses, by the names of the links."""
        return {c.pair.links: c.pair for c in self._known if c.times == _POSE}

    def calibrate(self, y: FloatArray) -> None:
        """Raise allowances to the overlaps at which links would touch near a clear pose."""
        self._scene.place(self._function.stored(y))
        for c in self._known:
            overlap, margin = -self._scene.distance(c.pair), self._checker.margin(c.pair)
            if c.times == _POSE and overlap > -CLOSER - margin:
                # The exact gap may be added to the overlap of the convex parts.
                gap = self._scene.exact_distance(c.pair) - margin
                c.allowance = max(c.allowance, COARSE.rounded_value(overlap + gap - CLOSE))
                # The weight was raised for the old allowance; the new one may need less.
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
        # Slightly before the contact, whose intensity is known only to `_COARSE`.
        overlap = self._overlap(pair, path, max(0.0, at - _COARSE))
        self._known.append(Constraint(pair, _POSE, overlap))

    def learn_path(self, blocked: Blocked, y: FloatArray) -> None:
        """Learn from a collision on the path to a pose."""
        if self._bound(blocked.pair, y):
            return
        path = self._path(y)
        times = np.linspace(blocked.at, blocked.until, _SAMPLES, endpoint=False).tolist()
        overlaps = [self._overlap(blocked.pair, path, t) for t in times]
        deepest = times[int(np.argmax(overlaps))]
        known = self._of(blocked.pair, on_path=True)
        if known is None:
            # The deepest intensity and some others, one of which may become the deepest.
            few = (*times[:: _SAMPLES // _STATIONS], deepest)
            self._known.append(Constraint(blocked.pair, few, overlaps[0]))
        elif all(abs(t - deepest) > _APART for t in known.times):
            known.times = (*known.times[-_MOST_STATIONS:], deepest)
        else:
            self._tighten(known, max(overlaps))

    def _of(self, pair: LinkPair, *, on_path: bool = False) -> Constraint | None:
        of_pair = (c for c in self._known if c.pair is pair)
        # At most one of each kind, which later collisions tighten.
        return next((c for c in of_pair if (c.times != _POSE) is on_path), None)

    def _tighten(self, constraint: Constraint, overlap: float) -> None:
        """Lower the allowance below an overlap at which the links collide."""
        least = min(constraint.allowance, overlap)
        constraint.allowance = COARSE.rounded_value(least - max(CLOSE, _SHRINK * abs(least)))
        # The penalty was too weak to prevent the collision; make it steeper, too.
        constraint.weight = min(_STRONGEST, constraint.weight * _STRENGTHEN)

    def _bound(self, pair: LinkPair, y: FloatArray) -> bool:
        """Bound the actuator at the first collision of two links, if only one moves them.

        Return whether a bound was set.
        """
        moving = pair.actuators & self._varying
        # A collision that depends on a single coordinate is described completely by a bound.
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
        # An upper bound on the far side of rest, a lower one on the near side.
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
            slope = sloping()  # now, since the stations below move the links
            for c in before:
                # Only the least gap of all stations counts, that is the largest overlap.
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
