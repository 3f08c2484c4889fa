"""Search for poses that are free of unwanted collisions, and so are the straight paths to them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.extract.collisions import Blocked, CollisionChecker
from rtee.extract.constraints import CLOSE, CLOSER, NEAR, WEIGHT, Constraints
from rtee.extract.descent import Minimum, Objective, Slope, descend
from rtee.extract.goals import GoalFunction
from rtee.extract.motion import MotionBounds
from rtee.extract.pairs import LinkPair
from rtee.extract.polish import polish
from rtee.extract.resolution import COARSE, MEDIUM
from rtee.extract.search import distinct, minima_on_line
from rtee.hand.linalg import dot
from rtee.sample import FloatArray
from rtee.types import from_rest

_LITTLE: Final = 0.03
"""Share of the value that a recalibrated step must gain before another step follows."""

_RADIUS: Final = 0.08
"""Initial radius of the trust region in each coordinate, as a share of an actuator's range: about
the range in which the gaps of near links are linear."""

_TIGHTER: Final = 0.4
_WIDER: Final = 1.6
"""Factors of the radius after a step that failed, and after one that succeeded."""

_SMALLEST: Final = 0.002
"""Smallest radius of the trust region, in which a fingertip moves a fraction of a millimetre."""

_EVALUATIONS: Final = 40
"""Maximum number of evaluations of a descent out of a collision."""

_QUICK: Final = 25
"""Maximum number of evaluations of a descent that only keeps a start at a minimum."""

_TRUST_EVALUATIONS: Final = 11
"""Maximum number of evaluations of a step in the trust region: its linear model needs few."""

_SAME: Final = 0.05
"""Difference in every coordinate below which starts count as equal."""

GOOD: Final = 0.98
"""Share of the greatest depth from which a clear pose ends the search for others."""

_SHORT: Final = 2e-3
"""Distance by which a pose moves back before a collision, as a share of the path: about 0.1 mm."""

_BEFORE: Final = 1e-4
"""Distance by which a single actuator moves back: its bounds are exact except for rounding."""

_FOLLOWED: Final = 2
"""Number of clear poses whose paths are checked per round: a path costs more than a pose."""

_QUERY_BUDGET: Final = 300
"""Budget of one search for queries on original meshes, in units of a collision query of 2 ms: less
than a second."""

_IMPROVED: Final = 2
"""Number of clear poses to improve: the others seldom become better than these."""


@dataclass(frozen=True, slots=True)
class SearchBudget:
    """Limits of a search for clear poses.

    Attributes:
        pool: Maximum number of starts.
        kept: Maximum number of starts kept at minima while the search learns constraints; each
            costs a descent per round.
        attempts: Maximum number of poses pushed out of their collisions.
        pushes: Maximum number of descents to push a pose out.
        recalibrations: Maximum number of steps to improve a pose with newly measured allowances.
        trust_steps: Maximum number of steps to improve a pose in its trust region.
        path_rounds: Maximum number of rounds that learn from blocked paths.
        extra_attempts: Number of further attempts if none has succeeded.
        settle: Whether to move poses to minima of the goal before constraints are learned.
    """

    pool: int = 12
    kept: int = 4
    attempts: int = 5
    pushes: int = 10
    recalibrations: int = 8
    trust_steps: int = 12
    path_rounds: int = 5
    extra_attempts: int = 3
    settle: bool = True


class ClearSearch:
    """Pushes poses out of unwanted collisions.

    The search improves a pose under the constraints known so far, with an exact penalty, and then
    checks it exactly; collisions add or tighten constraints (see `Constraints`). It refines a clear
    pose by measuring the allowances there and moving it while it improves and stays clear.
    """

    def __init__(
        self,
        function: GoalFunction,
        motion: MotionBounds,
        checker: CollisionChecker,
        budget: SearchBudget,
    ) -> None:
        """Prepare a search for clear poses in the space of a goal."""
        self._function = function
        self._scene, self._space = function.scene, function.space
        self._motion = motion
        self._checker = checker
        self._budget = budget
        self._constraints = Constraints(function, motion, checker)
        self._uncalibrated: list[FloatArray] = []
        self._settled_at: dict[bytes, Minimum] = {}
        self._cost_limit, self._floor = 0, np.inf

    @property
    def _out_of_budget(self) -> bool:
        """Whether the search has used up its budget for queries on original meshes."""
        return self._scene.query_cost >= self._cost_limit

    def run(self, starts: Sequence[FloatArray], floor: float = np.inf) -> list[FloatArray]:
        """Return clear poses reached from good starts, those with a clear path first.

        Args:
            starts: Coordinates ``(k,)`` of good poses, the best first.
            floor: Value [m] above which starts and clear poses are not followed.

        Returns:
            Coordinates ``(k,)`` of clear poses with a clear path, the best first, and then of clear
            poses beyond a collision on the path.
        """
        free: list[FloatArray] = []
        behind: list[FloatArray] = []
        self._cost_limit = self._scene.query_cost + _QUERY_BUDGET
        self._floor = floor
        for _ in range(self._budget.path_rounds):
            if self._out_of_budget:
                break
            attempts = self._budget.attempts
            clear = self._explore(starts, min(attempts, _FOLLOWED) if behind else attempts)
            # A clear path only makes them shallower.
            clear = [y for y in clear if self._function.value(y) <= self._floor]
            for y in clear[:_FOLLOWED]:
                blocked = self._blocked(y)
                if blocked is None:
                    free.append(y)
                    break
                behind.append(y)
                # Add a constraint for the next round; the pose before the collision is a fallback.
                self._constraints.learn_path(blocked, y)
                nearer = self._go_back(y, blocked)
                if nearer is not None:
                    free.append(nearer)
            # If the best pose has a clear path, further rounds could only find worse ones.
            if not clear or any(y is clear[0] for y in free):
                break
        return [*sorted(free, key=self._function.value), *behind]

    def _go_back(self, y: FloatArray, blocked: Blocked) -> FloatArray | None:
        """Return a pose with a clear path from before a collision, or ``None``."""
        for _ in range(self._budget.path_rounds):
            if self._out_of_budget:
                break
            y = self._improve_in_trust_region(self._before(y, blocked))
            again = self._blocked(y)
            if again is None:
                return y if self._touches(y) else None
            self._constraints.learn_path(again, y)
            blocked = again
        return None

    def _explore(self, starts: Sequence[FloatArray], attempts: int) -> list[FloatArray]:
        """Return clear poses, the best first.

        Keeps all starts at minima of the goal under the constraints learned so far. Pushes the best
        of them out of its collisions, which adds constraints, and repeats this until the clear pose
        is nearly as good as the best start.
        """
        value = self._function.value
        pool = list(starts[: self._budget.pool])
        tried: list[FloatArray] = []
        clear: list[FloatArray] = []
        best, enough = np.inf, GOOD * min(map(value, pool), default=0.0)
        for number in range(attempts + self._budget.extra_attempts):
            # Extra attempts are only for searches that have found no clear pose so far.
            if (clear and number >= attempts) or self._out_of_budget:
                break
            while self._uncalibrated:
                # Delayed until here: after the last attempt, calibration would be useless.
                self._constraints.calibrate(self._uncalibrated.pop())
            minima = self._settled(pool)
            pool = [
                minimum.y for minimum in sorted(minima, key=lambda m: m.value)[: self._budget.kept]
            ]
            new = [
                minimum
                for minimum in distinct(minima)
                if minimum.value <= self._floor
                and all(np.abs(minimum.y - y).max() > _SAME for y in tried)
            ]
            if not new or best <= enough:
                break
            tried.append(new[0].y)
            pose = self._push_out(new[0].y)
            if pose is not None and self._touches(pose):
                clear.append(pose)
                best = min(best, value(pose))
                self._uncalibrated.append(pose)
        clear.sort(key=value)
        better = [self._improved(y) for y in clear[:_IMPROVED]]
        return sorted([*better, *clear[_IMPROVED:]], key=value)

    def _improved(self, y: FloatArray) -> FloatArray:
        """Return a better clear pose near a clear one in which the tips touch."""
        better = self._improve_in_trust_region(self._improve_recalibrated(y))
        # The improvement ignores nested links, which are slow to check.
        if better is y or self._checker.nested(self._function.stored(better)):
            return y
        return better if self._touches(better) else y

    def _settled(self, pool: Sequence[FloatArray]) -> list[Minimum]:
        """Return the minima of the goal under the constraints, reached from these poses."""
        if not self._constraints.learned:
            if not self._budget.settle:
                return [Minimum(y, self._function.value(y), 1) for y in pool]
            pool = pool[: self._budget.kept]
        penalised = self._constraints.penalised()
        return [self._still(y, penalised) or self._settle(y) for y in pool]

    def _still(self, y: FloatArray, penalised: Objective) -> Minimum | None:
        """Return a known minimum if no constraint has changed its value since."""
        known = self._settled_at.get(y.tobytes())
        if known is None or MEDIUM.rounded_value(penalised(y)[0]) != known.value:
            return None
        return known

    def _settle(self, y: FloatArray) -> Minimum:
        found = self._descend(COARSE.snap(y), _QUICK)
        self._settled_at[found.y.tobytes()] = found
        return found

    def _push_out(self, start: FloatArray) -> FloatArray | None:
        """Return a clear pose reached from a good one, or ``None``.

        If descents do not lead out of the collisions, moves the start back on its path until
        nothing collides. Improves the pose from there if its tips do not touch.
        """
        y, collided = start, list[LinkPair]()
        for _ in range(self._budget.pushes):
            hits = self._hits(y)
            collided = collided or hits
            if not hits:
                return y
            for pair in hits:
                self._constraints.learn(pair, y)
            y = self._descend(y, _EVALUATIONS).y
            if not self._function.overlapping(y):
                break
        y = start
        while collided:
            path = self._motion.path_to(self._function.stored(y))
            blocked = self._checker.first_on(path, collided)
            if blocked is None or blocked.at <= _SHORT:
                return None
            y = self._before(y, blocked)
            # Beyond other links there, the path may lead through them.
            collided = self._hits(y)
        return y if self._function.overlapping(y) else self._improve_recalibrated(y)

    def _hits(self, y: FloatArray) -> list[LinkPair]:
        """Return pairs of links that collide at a pose; empty if it is clear."""
        # Round as in storage: the checked posture must be the stored one.
        u = self._function.stored(y)
        # Check nested links, which are costly, only if the others are clear.
        return self._checker.unnested(u) or self._checker.nested(u)

    def _before(self, y: FloatArray, blocked: Blocked) -> FloatArray:
        """Return the pose on the path just before a collision."""
        share = max(0.0, blocked.at - _SHORT)
        return MEDIUM.snap(from_rest(self._space.rest, y, share))

    def _improve_recalibrated(self, y: FloatArray) -> FloatArray:
        """Return a better clear pose, which may be far from the given one.

        The gaps at the pose give larger allowances for the overlaps of convex parts. Improves the
        goal with these, and moves the pose as far as it stays clear.
        """
        best = self._function.value(y)
        for _ in range(0 if self._out_of_budget else self._budget.recalibrations):
            self._constraints.calibrate(y)
            step = self._descend(y, _EVALUATIONS).y - y
            # The allowances hold only near the pose, which a long step may leave.
            for share in (1.0, 0.5, 0.25, 0.125):
                trial = y + share * step
                value = self._function.value(trial)
                if value < best - CLOSE and not self._collides(trial):
                    break
            else:
                return y
            gain, y, best = best - value, trial, value
            if gain < _LITTLE * abs(best):
                return y
        return y

    def _improve_in_trust_region(self, y: FloatArray) -> FloatArray:
        """Return a better clear pose near the given one.

        Near the pose, the exact gaps of near links are almost linear in the coordinates. Improves
        the goal under these linear constraints, within a radius that shrinks after each failure.
        """
        best, radius = self._function.value(y), _RADIUS
        concerned = self._constraints.concerned()
        gaps = self._linear_gaps(y, concerned.values())
        low, high = self._constraints.bounds
        for _ in range(self._budget.trust_steps):
            if self._out_of_budget:
                break
            # Linear gaps meet in kinks, which `polish` handles.
            trial = polish(
                self._above(gaps, y),
                y,
                evaluations=_TRUST_EVALUATIONS,
                bounds=(np.maximum(low, y - radius), np.minimum(high, y + radius)),
                resolution=MEDIUM,
            ).y
            value = self._function.value(trial)
            # Nothing better within the radius: search closer in the next step.
            if value >= best - CLOSE:
                radius *= _TIGHTER
            elif hits := self._collides(trial):
                radius *= _TIGHTER
                new = {pair.links: pair for pair in hits if pair.links not in concerned}
                # Only links that have collided before have constraints; add the new ones.
                concerned |= new
                gaps += self._linear_gaps(y, new.values()) if new else []
            else:
                # The model was right: grow the radius, and measure the gaps at the new pose.
                y, best, radius = trial, value, radius * _WIDER
                gaps = self._linear_gaps(y, concerned.values())
            if radius < _SMALLEST:
                break
        return y

    def _linear_gaps(
        self, y: FloatArray, pairs: Iterable[LinkPair]
    ) -> list[tuple[float, FloatArray]]:
        """Return the gaps of near links at a clear pose, with their derivatives.

        A gap is the distance minus the links' margin. If the convex parts are close or overlap, it
        is that of the original geometry.
        """
        self._scene.place(self._function.stored(y))
        gaps = []
        for pair in pairs:
            margin = self._checker.margin(pair)
            gap = self._scene.distance(pair) - margin
            if gap < CLOSER:
                gap, rise = self._scene.exact_slope(pair, self._space)
                gaps.append((gap - margin, rise))
            elif gap < NEAR:
                gaps.append((gap, self._scene.derivative(pair, self._space)))
        # Adding 0 turns -0.0 into 0.0.
        return [(MEDIUM.rounded_value(g), MEDIUM.rounded_slope(rise) + 0.0) for g, rise in gaps]

    def _above(self, gaps: Sequence[tuple[float, FloatArray]], at: FloatArray) -> Objective:
        """Return the goal with a penalty for negative linear gaps."""
        goal = self._constraints.penalised(paths_only=True)

        def function(y: FloatArray) -> tuple[float, Slope]:
            value, rise_of_goal = goal(y)
            slope = rise_of_goal()
            step = y - at
            for gap, rise in gaps:
                left = gap + dot(rise, step) - CLOSE
                if left < 0.0:
                    value -= WEIGHT * left
                    slope = slope - WEIGHT * rise
            return value, lambda: slope

        return function

    def _collides(self, y: FloatArray) -> list[LinkPair]:
        return self._checker.unnested(self._function.stored(y))

    def _blocked(self, y: FloatArray) -> Blocked | None:
        return self._checker.blocked(self._function.stored(y))

    def _touches(self, y: FloatArray) -> bool:
        return self._function.touching(self._function.stored(y))

    def _descend(self, y: FloatArray, evaluations: int) -> Minimum:
        function, bounds = self._constraints.penalised(), self._constraints.bounds
        return descend(function, y, evaluations=evaluations, bounds=bounds, resolution=MEDIUM)


def touching_postures(function: GoalFunction, poses: Iterable[FloatArray]) -> Iterator[FloatArray]:
    """Yield the postures, rounded as stored, in which the tips touch as the goal requires.

    Args:
        function: The goal, over the space of the search.
        poses: Coordinates ``(k,)`` in this space.
    """
    return (u for u in map(function.stored, poses) if function.touching(u))


def clear_postures(
    function: GoalFunction,
    motion: MotionBounds,
    checker: CollisionChecker,
    starts: Sequence[FloatArray],
    budget: SearchBudget,
    *,
    floor: float = np.inf,
) -> list[FloatArray]:
    """Return postures, rounded as stored, in which the tips touch and nothing else collides.

    ``starts`` and ``floor`` as in `ClearSearch.run`.
    """
    if function.space.size > 1:
        poses = ClearSearch(function, motion, checker, budget).run(starts, floor)
        return list(touching_postures(function, poses))
    low, high = _free_interval(function, motion, checker)
    if high <= low:
        return []
    poses = [minimum.y for minimum in minima_on_line(function, low, high)]
    return list(touching_postures(function, poses))


def _free_interval(
    function: GoalFunction, motion: MotionBounds, checker: CollisionChecker
) -> tuple[float, float]:
    """Return the interval around rest up to the first collisions, in a space of one actuator."""
    space, ends = function.space, []
    rest = float(space.rest[0])
    for bound in (0.0, 1.0):
        path = motion.path_to(space.posture(np.array([bound])))
        blocked = checker.first_blocked(path)
        share = 1.0 if blocked is None else max(0.0, blocked.at - _BEFORE)
        ends.append(from_rest(rest, bound, share))
    return ends[0], ends[1]
