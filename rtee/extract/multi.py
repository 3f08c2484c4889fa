"""Search for MultiPinchTight: three fingertips or more, linked by contacts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from rtee.actions.types import PrimitiveKind
from rtee.extract.clear_elsewhere import ClearElsewhere
from rtee.extract.collision_free import SearchBudget, clear_postures, touching_postures
from rtee.extract.evidence import Inspector
from rtee.extract.goals import GoalFunction, MultiPinchGoal, TipEdge, linked, spanning_trees
from rtee.extract.pairs import LinkPair
from rtee.extract.ranking import Candidate, FoundPinch, Rank, ranked
from rtee.extract.search import SEVERAL, Block, Minima, minima
from rtee.extract.space import Space, make_space, real_limits
from rtee.hand.model import Finger, Hand
from rtee.sample import FloatArray

_MOST_TREES: Final = 4
"""Maximum number of spanning trees from which starts are combined; the hands in ``config/`` have no
more."""

_FIRST: Final = SearchBudget(
    pool=6, kept=4, attempts=4, pushes=8, recalibrations=6, trust_steps=12, path_rounds=4,
    extra_attempts=2,
)  # fmt: skip
_FURTHER: Final = replace(_FIRST, pool=10, kept=6, attempts=6)
"""Budgets for several tips: of the first search for clear poses, and of each further one, with more
starts."""

Pinches = Mapping[frozenset[str], FloatArray]
"""The deepest posture ``(n,)`` of each pair of fingers that pinch tightly."""


@dataclass(frozen=True)
class MultiSearch:
    """Search for the multi-pinch of a group of fingers.

    Attributes:
        inspector: Measures the evidence for postures.
        fingers: The fingers.
        pinches: The known pinches of two fingers.
        rank: Criterion of the ranking.
    """

    inspector: Inspector
    fingers: tuple[Finger, ...]
    pinches: Pinches
    rank: Rank = "depth"

    def run(self) -> FoundPinch | None:
        """Return the multi-pinch, if there is one."""
        scene, edges = self.inspector.scene, self._edges()
        # Only tips that pinch in pairs can be linked by contacts.
        if not linked(len(self.fingers), [edge.ends for edge in edges]):
            return None
        moving = frozenset().union(*(edge.tips.actuators for edge in edges))
        space = make_space(self._hand, sorted(moving), real_limits(self._hand))
        goal = MultiPinchGoal(scene, len(self.fingers), edges, self._bystanders(moving))
        result = self._minima(goal, space, edges)
        function = GoalFunction(scene, goal, space)
        # The deepest first; usually, the others are never evaluated.
        touching = next(touching_postures(function, (m.y for m in result.polished)), None)
        if touching is None:
            return None
        checker = self.inspector.checker(self.fingers, edges)
        names = tuple(finger.name for finger in self.fingers)

        def candidate(u: FloatArray) -> Candidate:
            return self.inspector.multi_pinch(u, names, edges, checker)

        candidates = [candidate(touching)]
        if not candidates[0].usable:
            minima, motion = [m.y for m in result.explored], self.inspector.motion
            clear = clear_postures(function, motion, checker, minima, _FIRST)
            candidates += [candidate(u) for u in clear[:1]]
            further = ClearElsewhere(function, motion, checker, candidate, _FURTHER, (_FIRST.kept,))
            deep = [function.stored(m.y) for m in result.polished]
            candidates += further.deeper(candidates, deep, minima)
        kind = PrimitiveKind.MULTI_PINCH_TIGHT
        kept = ranked(self._hand, candidates, self.rank)
        if self.rank == "depth":
            # Keep the executed posture and the deepest one.
            deepest = max(kept, key=lambda c: c.evidence.depth)
            kept = tuple(c for c in kept if c is kept[0] or c is deepest)
        return FoundPinch(kind, names, kept)

    @property
    def _hand(self) -> Hand:
        return self.inspector.scene.hand

    def _minima(self, goal: MultiPinchGoal, space: Space, edges: Sequence[TipEdge]) -> Minima:
        """Return local minima; search again whenever a new bystander touches at one of them."""
        scene, warm, blocks = self.inspector.scene, self._warm(space, edges), self._blocks(space)
        # Few tips are ever in the way; each round penalises only those that have touched.
        while True:
            result = minima(GoalFunction(scene, goal, space), warm, SEVERAL, blocks)
            learned = False
            for minimum in (*result.explored, *result.polished):
                # Bystanders may overlap during a descent, but not at its end.
                scene.place(space.posture(minimum.y))
                learned |= goal.learn_bystanders()
            if not learned:
                return result

    def _edges(self) -> list[TipEdge]:
        scene, edges = self.inspector.scene, []
        for (i, a), (j, b) in combinations(enumerate(self.fingers), 2):
            if frozenset((a.name, b.name)) in self.pinches:
                edges.append(TipEdge((i, j), scene.tips[str(a.tip), str(b.tip)]))
        return edges

    def _bystanders(self, moving: frozenset[int]) -> list[LinkPair]:
        """Return the moving pairs of tips that are not both part of the pinch."""
        mine = {finger.tip for finger in self.fingers}
        return [
            pair
            for pair in self.inspector.scene.tips.values()
            if not set(pair.links) <= mine and pair.actuators & moving
        ]

    def _warm(self, space: Space, edges: Sequence[TipEdge]) -> list[FloatArray]:
        """Return the pinches of two fingers, and combinations of them that link all fingers."""
        ends = [edge.ends for edge in edges]
        pinches = [self.pinches[frozenset(self.fingers[k].name for k in end)] for end in ends]
        starts = []
        for tree in spanning_trees(len(self.fingers), ends)[:_MOST_TREES]:
            values: list[list[float]] = [[] for _ in self._hand.actuators]
            for i in tree:
                for actuator in edges[i].tips.actuators:
                    values[actuator].append(float(pinches[i][actuator]))
            # An actuator of several pinches gets the mean of their positions.
            u = self._hand.rest.copy()
            for actuator, chosen in enumerate(values):
                if chosen:
                    u[actuator] = np.mean(chosen)
            starts.append(u)
        return [space.coordinates(u) for u in (*starts, *pinches)]

    def _blocks(self, space: Space) -> list[Block]:
        """Return the coordinates of each finger, and the remaining ones."""
        owner = {self._hand.actuator_index(n): f.name for f in self.fingers for n in f.own}
        blocks: dict[str | None, list[int]] = {}
        for coordinate, actuator in enumerate(space.index.tolist()):
            blocks.setdefault(owner.get(actuator), []).append(coordinate)
        return [np.array(block, dtype=np.intp) for block in blocks.values()]
