"""Compare the pinches of the extraction with those of a slow, independent search; print Markdown.

    python benchmarks/pinch_global.py [--hands schunk_svh some/hand.urdf …] [--jobs 0]
                                      [--generations 150] [--sample 1]

The other search is differential evolution (Storn and Price, 1997) of 64 random postures or more,
the best four of which are polished. It knows no gradients, no descents and no results of the
extraction; it measures on the full convex parts. Twice per pinch: for the deepest posture, with
the tips alone, and for the deepest that is clear with a clear way. Of loose pinches, the least
distance. With `--sample 3` every third pinch is compared. Shares below 99 % of the deepest and
98 % of the deepest clear depth are in bold.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from common import HELP, Table, command_line
from extract import goals, loaded, tip_pairs

from rtee.actions.types import Primitive, PrimitiveKind
from rtee.child import processors
from rtee.extract.canonical import canonical
from rtee.extract.evidence import Inspector
from rtee.extract.extraction import extract
from rtee.extract.goals import GapGoal, GoalFunction, MultiPinchGoal, SearchGoal, TipEdge
from rtee.extract.jobs import parallel_map
from rtee.extract.polish import polish
from rtee.extract.space import Space
from rtee.sample import FloatArray

POPULATION = 64  # at least, and six per actuator
POLISHED = 4
APART = 1.0  # value of what does not touch, more than any depth [m]
HIT = 0.02  # penalty per pair of links that collides [m]
WAY = 0.05  # penalty of a way that is blocked at its beginning [m]
NOTHING = 1e-5  # depths that differ by less are the same [m]


@dataclass(frozen=True)
class Task:
    """One search: the fingers of a pinch, and whether it must be clear or is loose."""

    fingers: frozenset[str]
    clear: bool
    loose: bool = False


def evolved(
    value: Callable[[FloatArray], float], size: int, generations: int
) -> list[tuple[float, FloatArray]]:
    """Return the final population ``(k,)`` in the unit box with its values, the best first."""
    random = np.random.default_rng(size)
    count = max(POPULATION, 6 * size)
    people = random.random((count, size))
    values = np.array([value(y) for y in people])
    for _ in range(generations):
        for i in range(count):
            a, b, c = random.choice(count, 3, replace=False)
            if random.random() < 0.5:
                a = int(np.argmin(values))
            mutant = people[a] + random.uniform(0.3, 0.9) * (people[b] - people[c])
            # Reflected at the faces of the box.
            mutant = np.abs(mutant)
            mutant = np.clip(np.where(mutant > 1.0, 2.0 - mutant, mutant), 0.0, 1.0)
            chosen = random.random(size) < 0.8
            chosen[random.integers(size)] = True
            child = np.where(chosen, mutant, people[i])
            worth = value(child)
            if worth <= values[i]:
                people[i], values[i] = child, worth
        if values.max() - values.min() < NOTHING / 10.0:
            break
    order = np.argsort(values)
    return [(float(values[i]), people[i]) for i in order]


class Searches:
    """The searches of one hand."""

    def __init__(self, name: str, found: Sequence[Primitive], generations: int) -> None:
        form = canonical(loaded(name))
        self.unit = form.unit
        self._inspector = Inspector.of(form.hand, form.unit)
        self._scene = self._inspector.scene
        self._generations = generations
        self._goals = {
            names: (goal, space)
            for names, goal, space in goals(self._scene, {frozenset(p.elements) for p in found})
        }

    def run(self, task: Task) -> float:
        """Return the depth, or of a loose pinch the distance, that is found [m]."""
        goal, space = self._goals[task.fingers]
        with self._scene.fine():
            if task.loose:
                return self._closest(task, space)
            return (self._clear if task.clear else self._deepest)(task, goal, space)

    def _deepest(self, task: Task, goal: SearchGoal, space: Space) -> float:
        function = GoalFunction(self._scene, goal, space)
        ends = evolved(function.value, space.size, self._generations)[:POLISHED]
        while self._meets(function, ends):
            ends = evolved(function.value, space.size, self._generations)[:POLISHED]
        best = 0.0
        for value, y in ends:
            end = polish(function, y, evaluations=60)
            for worth, place in ((value, y), (end.value, end.y)):
                if -worth > best and function.touching(function.stored(place)):
                    best = -worth
        return best / self.unit

    @staticmethod
    def _meets(function: GoalFunction, ends: Sequence[tuple[float, FloatArray]]) -> bool:
        """Return whether tips that take no part touch, from which the goal then keeps away."""
        goal, met = function.goal, False
        for _, y in ends if isinstance(goal, MultiPinchGoal) else ():
            function.scene.place(function.space.posture(y))
            met |= goal.learn_bystanders()
        return met

    def _clear(self, task: Task, goal: SearchGoal, space: Space) -> float:
        function = GoalFunction(self._scene, goal, space)
        hand = self._scene.hand
        fingers = [finger for finger in hand.fingers if finger.name in task.fingers]
        pairs = tip_pairs(self._scene)
        edges = [
            TipEdge((i, j), pairs[frozenset((a.name, b.name))])
            for i, a in enumerate(fingers)
            for j, b in enumerate(fingers)
            if i < j and frozenset((a.name, b.name)) in pairs
        ]
        checker = self._inspector.checker(fingers, edges)

        def value(y: FloatArray) -> float:
            worth = function.value(y)
            if worth >= 0.0 or not function.overlapping(y):
                return APART + max(0.0, worth)
            u = function.stored(y)
            hits = checker.at(u)
            if hits:
                return worth + WAY + HIT * len(hits)
            blocked = checker.blocked(u)
            return worth + (0.0 if blocked is None else WAY * (1.1 - blocked.at))

        for worth, y in evolved(value, space.size, self._generations):
            u = function.stored(y)
            if checker.at(u) or checker.blocked(u) is not None or not function.touching(u):
                continue
            return -worth / self.unit
        return 0.0

    def _closest(self, task: Task, space: Space) -> float:
        tips = tip_pairs(self._scene)[task.fingers]
        gap = GoalFunction(self._scene, GapGoal(self._scene, tips), space)
        best = evolved(gap.value, space.size, self._generations)[0]
        return min(best[0], polish(gap, best[1], evaluations=60).value) / self.unit


def compare(table: Table, name: str, jobs: int, generations: int, sample: int) -> None:
    found = [p for p in extract(loaded(name), jobs=jobs).primitives if p.evidence]
    searches = Searches(name, found, generations)
    for pinch in found[::sample]:
        loose = pinch.kind is PrimitiveKind.PINCH_LOOSE
        fingers = frozenset(pinch.elements)
        tasks = [Task(fingers, clear, loose) for clear in ((False,) if loose else (False, True))]
        # Per pinch, so that rows are printed as they come.
        results = parallel_map(searches.run, tasks, jobs, lambda done, total: None)
        for task, known in zip(tasks, results, strict=True):
            report(table, name, pinch, task, known)


def report(table: Table, name: str, pinch: Primitive, task: Task, known: float) -> None:
    """Print what the extraction and the other search found."""
    evidence = [e for e in pinch.evidence if not task.clear or (e.clear and e.path_clear)]
    what, wanted = ("deepest clear", 0.98) if task.clear else ("deepest", 0.99)
    if task.loose:
        ours, what = min(e.distance for e in evidence), "least distance"
        share = known / ours if ours > NOTHING else 1.0
    else:
        ours = max((e.depth for e in evidence), default=0.0)
        share = ours / known if known > NOTHING else 1.0
    told = f"{share:.1%}" if share >= wanted else f"**{share:.1%}**"
    fingers = ", ".join(pinch.elements)
    table.row(name, fingers, what, f"{1e3 * ours:.3f}", f"{1e3 * known:.3f}", told)


def main(arguments: Sequence[str]) -> None:
    parser = command_line(__doc__, jobs=0, generations=150, sample=1)
    parser.add_argument("--hands", nargs="+", required=True, help=HELP["hands"])
    given = parser.parse_args(arguments)
    table = Table("hand", "fingers", "posture", "extraction [mm]", "evolution [mm]", "share")
    for name in given.hands:
        compare(table, name, given.jobs or processors(), given.generations, given.sample)


if __name__ == "__main__":
    main(sys.argv[1:])
