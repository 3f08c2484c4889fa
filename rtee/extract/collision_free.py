"""The best pose at which nothing else collides, nor on the way there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.extract.collisions import Blocked, Watch
from rtee.extract.constraints import CLOSE, CLOSER, NEAR, WEIGHT, Constraints
from rtee.extract.descent import Minimum, Objective, Slope, descend
from rtee.extract.goals import Goal
from rtee.extract.grain import COARSE, MEDIUM
from rtee.extract.motion import Motion
from rtee.extract.pairs import LinkPair
from rtee.extract.polish import polish
from rtee.extract.scene import Scene
from rtee.extract.search import distinct
from rtee.extract.space import Space, rounded
from rtee.hand.linalg import dot
from rtee.types import FloatArray

_LITTLE: Final = 0.03
"""A leap that gains less than this part of the value is the last one."""

_RADIUS: Final = 0.08
"""How far a creep first goes in each coordinate, as a part of an actuator's range: about as far as
the gaps of near links stay linear."""

_TIGHTER: Final = 0.4
_WIDER: Final = 1.6
"""Factors of that radius after a step that failed, and after one that did not."""

_SMALLEST: Final = 0.002
"""Radius at which a creep ends; a fingertip then moves by a fraction of a millimetre."""

_EVALUATIONS: Final = 40
"""Most evaluations of a descent out of a collision."""

_QUICK: Final = 25
"""Most evaluations of a descent that only keeps a start at a minimum."""

_POLISH: Final = 11
"""Evaluations of one step of a creep: its model is linear, and soon exhausted."""

_SAME: Final = 0.05
"""Starts that differ by less in every coordinate lead out of the same collisions."""

_GOOD: Final = 0.85
"""A clear pose of this part of the greatest depth ends the search for other ones."""

_POOL: Final = 4
"""Starts that are kept at minima while constraints are learned."""

_SHORT: Final = 2e-3
"""How far before a collision a pose goes back, as a part of the way: some 0.1 mm."""

_FOLLOWED: Final = 1
"""How many clear poses' ways are looked at in each round."""

_TOIL: Final = 300
"""What one search may ask of meshes as given, in units of a question whether two touch."""

_IMPROVED: Final = 2
"""How many of the clear poses that were found are improved."""


@dataclass(frozen=True, slots=True)
class Patience:
    """How much a search for clear poses tries.

    Attributes:
        pool: How many good poses are kept in mind.
        tries: How many poses are pushed out of their collisions.
        rounds: How often one is pushed.
        leaps: How often it is improved by its allowances.
        creeps: How often it is improved within its walls.
        ways: How often blocked ways are learned from.
        more: How many poses more are pushed where none of them comes out.
        settle: Whether poses are brought to minima of the goal before anything is learned.
    """

    pool: int = 10
    tries: int = 2
    rounds: int = 8
    leaps: int = 8
    creeps: int = 12
    ways: int = 3
    more: int = 0
    settle: bool = True


class ClearSearch:
    """Pushes poses out of the collisions that are not wanted.

    The convex parts of two links stand in for the links: they overlap before the links collide, by
    an allowance that is measured where the links first touch. Poses are improved under the
    constraints known so far, with an exact penalty; then the pose is checked exactly, and what
    collides there becomes a constraint, or a tighter one. A pose that is clear is refined: the
    allowances are measured there, and it moves on as long as it gets better and stays clear.
    """

    def __init__(
        self,
        scene: Scene,
        motion: Motion,
        goal: Goal,
        space: Space,
        watch: Watch,
        patience: Patience,
    ) -> None:
        """Prepare a search.

        Args:
            scene: The hand's links.
            motion: Bounds on their motion.
            goal: What to press together.
            space: Where to search.
            watch: The links that may not collide.
            patience: How much to try.
        """
        self._scene = scene
        self._motion = motion
        self._goal = goal
        self._space = space
        self._watch = watch
        self._patience = patience
        self._constraints = Constraints(scene, motion, goal, space, watch)
        self._fresh: list[FloatArray] = []
        self._limit = 0

    @property
    def _tired(self) -> bool:
        """Whether meshes as given were asked so much that the search is to end."""
        return self._scene.toil >= self._limit

    def run(self, starts: Sequence[FloatArray]) -> list[FloatArray]:
        """Return clear poses, the best one whose way is clear first, if there is any.

        Args:
            starts: Coordinates ``(k,)`` of good poses, the best first.

        Returns:
            Coordinates ``(k,)`` of clear poses; if no clear way was found, of poses behind
            collisions on the way.
        """
        free: list[FloatArray] = []
        behind: list[FloatArray] = []
        self._limit = self._scene.toil + _TOIL
        for _ in range(self._patience.ways):
            if self._tired:
                break
            found = self._explore(
                starts, min(self._patience.tries, _FOLLOWED) if behind else self._patience.tries
            )
            for y in found[:_FOLLOWED]:
                blocked = self._blocked(y)
                if blocked is None:
                    free.append(y)
                    break
                behind.append(y)
                self._constraints.learn_way(blocked, y)
                nearer = self._go_back(y, blocked)
                if nearer is not None:
                    free.append(nearer)
            if not found or any(y is found[0] for y in free):
                break
        return [*sorted(free, key=self._value), *behind]

    def _go_back(self, y: FloatArray, blocked: Blocked) -> FloatArray | None:
        """Return a pose with a clear way, from before a collision on the way to another one."""
        for _ in range(self._patience.ways):
            if self._tired:
                break
            y = self._creep(self._before(y, blocked))
            again = self._blocked(y)
            if again is None:
                return y if self._touches(y) else None
            self._constraints.learn_way(again, y)
            blocked = again
        return None

    def _explore(self, starts: Sequence[FloatArray], tries: int) -> list[FloatArray]:
        """Return clear poses, the best first.

        All starts are kept at minima of the goal under the constraints learned so far. The best of
        them is pushed out of its collisions, which teaches new constraints; and so on, until what
        was reached comes near the best of the starts.
        """
        pool = list(starts[: self._patience.pool])
        tried: list[FloatArray] = []
        found: list[FloatArray] = []
        best, enough = np.inf, _GOOD * min(map(self._value, pool), default=0.0)
        for number in range(tries + self._patience.more):
            if (found and number >= tries) or self._tired:
                break
            while self._fresh:
                self._constraints.calibrate(self._fresh.pop())
            minima = self._settled(pool)
            pool = [minimum.y for minimum in sorted(minima, key=lambda m: m.value)[:_POOL]]
            new = [
                minimum
                for minimum in distinct(minima)
                if all(np.abs(minimum.y - y).max() > _SAME for y in tried)
            ]
            if not new or best <= enough:
                break
            tried.append(new[0].y)
            pose = self._push_out(new[0].y)
            if pose is not None and self._touches(pose):
                found.append(pose)
                best = min(best, self._value(pose))
                self._fresh.append(pose)
        found.sort(key=self._value)
        better = [self._improved(y) for y in found[:_IMPROVED]]
        return sorted([*better, *found[_IMPROVED:]], key=self._value)

    def _improved(self, y: FloatArray) -> FloatArray:
        """Return a better clear pose near a clear one in which the tips touch."""
        better = self._creep(self._leap(y))
        if better is y or self._watch.nested(self._posture(better)) or not self._touches(better):
            return y
        return better

    def _settled(self, pool: Sequence[FloatArray]) -> list[Minimum]:
        """Return minima of the goal under the constraints that are reached from some poses."""
        if not self._constraints.learned:
            if not self._patience.settle:
                return [Minimum(y, self._value(y), 1) for y in pool]
            pool = pool[:_POOL]
        return [self._descend(COARSE.point(y), _QUICK) for y in pool]

    def _push_out(self, start: FloatArray) -> FloatArray | None:
        """Return a clear pose reached from a good one.

        Where the convex parts push a pose the wrong way out, the way to it is gone back to before
        the links first touch that collide in it, and on from there, unless the tips are apart there
        and stay apart.
        """
        y, collided = start, list[LinkPair]()
        for _ in range(self._patience.rounds):
            hits = self._watch.near(self._posture(y)) or self._watch.nested(self._posture(y))
            collided = collided or hits
            if not hits:
                return y
            for pair in hits:
                self._constraints.learn(pair, y)
            y = self._descend(y, _EVALUATIONS).y
            if not self._reached(y):
                break
        blocked = self._watch.first(self._motion.way(self._posture(start)), collided)
        if blocked is None:
            return None
        before = self._before(start, blocked)
        return before if self._reached(before) else self._leap(before)

    def _before(self, y: FloatArray, blocked: Blocked) -> FloatArray:
        """Return the pose on the way just before a collision."""
        share = max(0.0, blocked.at - _SHORT)
        return MEDIUM.point(self._space.rest + share * (y - self._space.rest))

    def _leap(self, y: FloatArray) -> FloatArray:
        """Return a better clear pose, some way from a clear one.

        The gaps at the pose tell how much more the convex parts may overlap; with these allowances
        the goal is improved, and the pose moves on as far as it stays clear.
        """
        best = self._value(y)
        for _ in range(0 if self._tired else self._patience.leaps):
            self._constraints.calibrate(y)
            step = self._descend(y, _EVALUATIONS).y - y
            for share in (1.0, 0.5, 0.25, 0.125):
                trial = y + share * step
                value = self._value(trial)
                if value < best - CLOSE and not self._watch.near(self._posture(trial)):
                    break
            else:
                return y
            gain, y, best = best - value, trial, value
            if gain < _LITTLE * abs(best):
                return y
        return y

    def _creep(self, y: FloatArray) -> FloatArray:
        """Return a better clear pose near a clear one.

        Near the pose the exact gaps of near links are linear functions of the coordinates. The goal
        is improved within these walls and a radius that shrinks when the pose found is not clear.
        """
        best, radius = self._value(y), _RADIUS
        concerned = self._constraints.concerned()
        walls = self._walls(y, concerned)
        low, high = self._constraints.bounds
        for _ in range(self._patience.creeps):
            if self._tired:
                break
            bounds = (np.maximum(low, y - radius), np.minimum(high, y + radius))
            function = self._walled(y, walls)
            trial = polish(function, y, evaluations=_POLISH, bounds=bounds, grain=MEDIUM).y
            value = self._value(trial)
            if value >= best - CLOSE:
                radius *= _TIGHTER
            else:
                hits = self._watch.near(self._posture(trial))
                if hits:
                    radius *= _TIGHTER
                    new = {pair.links: pair for pair in hits if pair.links not in concerned}
                    concerned |= new
                    walls += self._walls(y, new) if new else []
                else:
                    y, best, radius = trial, value, radius * _WIDER
                    walls = self._walls(y, concerned)
            if radius < _SMALLEST:
                break
        return y

    def _walls(
        self, y: FloatArray, concerned: dict[tuple[str, str], LinkPair]
    ) -> list[tuple[float, FloatArray]]:
        """Return lower bounds on the gaps of near links at a clear pose, with their derivatives.

        A gap is what is left of a distance beyond the links' room. Where the convex parts are close
        or overlap, the bounds are the exact gaps.
        """
        self._scene.place(self._posture(y))
        walls = []
        for pair in concerned.values():
            room = self._watch.room(pair)
            gap = self._scene.distance(pair) - room
            if gap < CLOSER:
                gap, rise = self._scene.exact_slope(pair, self._space)
                walls.append((gap - room, rise))
            elif gap < NEAR:
                walls.append((gap, self._scene.derivative(pair, self._space)))
        return [(MEDIUM.value(gap), MEDIUM.derivative(rise) + 0.0) for gap, rise in walls]

    def _walled(self, at: FloatArray, walls: Sequence[tuple[float, FloatArray]]) -> Objective:
        goal = self._constraints.penalised(ways_only=True)

        def function(y: FloatArray) -> tuple[float, Slope]:
            value, rise_of_goal = goal(y)
            slope = rise_of_goal()
            step = y - at
            for gap, rise in walls:
                left = gap + dot(rise, step) - CLOSE
                if left < 0.0:
                    value -= WEIGHT * left
                    slope = slope - WEIGHT * rise
            return value, lambda: slope

        return function

    def _posture(self, y: FloatArray) -> FloatArray:
        return rounded(self._scene.hand, self._space.posture(y))

    def _blocked(self, y: FloatArray) -> Blocked | None:
        return self._watch.along(self._posture(y))

    def _touches(self, y: FloatArray) -> bool:
        self._scene.place(self._posture(y))
        return self._goal.touching()

    def _value(self, y: FloatArray) -> float:
        self._scene.place(self._space.posture(y))
        return self._goal.value()

    def _reached(self, y: FloatArray) -> bool:
        self._scene.place(self._space.posture(y))
        return self._goal.reached()

    def _descend(self, y: FloatArray, evaluations: int) -> Minimum:
        function, bounds = self._constraints.penalised(), self._constraints.bounds
        return descend(function, y, evaluations=evaluations, bounds=bounds, grain=MEDIUM)
