"""MultiPinchTight: three fingertips or more that touch together, linked by contacts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from rtee.actions.types import PrimitiveKind
from rtee.extract.collision_free import Patience
from rtee.extract.evidence import Inspector
from rtee.extract.goals import Link, MultiPinch, Placed, linked, trees
from rtee.extract.pairs import LinkPair
from rtee.extract.postures import clear_postures, stored
from rtee.extract.ranking import Candidate, Found, Rank, ranked
from rtee.extract.recombination import Block
from rtee.extract.search import FEW, MANY, SEVERAL, Minima, minima
from rtee.extract.space import Space, make_space, real_limits
from rtee.hand.model import Finger, Hand
from rtee.types import FloatArray

_MOST_TREES: Final = 4

_PATIENCE: Final = Patience(
    pool=3, tries=2, rounds=4, leaps=2, creeps=5, ways=2, more=0, settle=False
)
"""Of several tips; they leave rest so far that more starts find nothing better."""

Pinches = Mapping[frozenset[str], FloatArray]
"""Of the fingers that pinch tightly, two by two, the deepest posture ``(n,)``."""


@dataclass(frozen=True)
class MultiSearch:
    """Looks for the multi-pinch of some fingers.

    Attributes:
        inspector: Measures postures.
        fingers: The fingers.
        pinches: The pinches of two fingers that were found.
        rank: What makes one posture better than another.
    """

    inspector: Inspector
    fingers: tuple[Finger, ...]
    pinches: Pinches
    rank: Rank = "depth"

    def run(self) -> Found | None:
        """Return the multi-pinch, if there is one."""
        links = self._links()
        if not linked(len(self.fingers), [link.ends for link in links]):
            return None
        moving = frozenset().union(*(link.tips.actuators for link in links))
        space = make_space(self._hand, sorted(moving), real_limits(self._hand))
        strangers = self._strangers(moving)
        goal = MultiPinch(self.inspector.scene, len(self.fingers), links, strangers)
        found = self._minima(goal, space, links)
        polished = [m.y for m in found.polished]
        touching = next(stored(self.inspector, goal, space, polished), None)
        if touching is None:
            return None
        involved = {self._hand.actuator_index(n) for f in self.fingers for n in f.actuators}
        watch = self.inspector.collisions.watch(
            involved, [frozenset(link.tips.links) for link in links]
        )
        names = tuple(finger.name for finger in self.fingers)

        def candidate(u: FloatArray) -> Candidate:
            return self.inspector.multi_pinch(u, names, links, watch)

        candidates = [candidate(touching)]
        if not candidates[0].usable:
            explored = [m.y for m in found.explored]
            clear = clear_postures(self.inspector, goal, space, watch, explored, _PATIENCE)
            candidates += [candidate(u) for u in clear[:1]]
        lower, upper = real_limits(self._hand)
        extent = upper - lower
        return Found(PrimitiveKind.MULTI_PINCH_TIGHT, names, ranked(candidates, self.rank, extent))

    @property
    def _hand(self) -> Hand:
        return self.inspector.scene.hand

    def _minima(self, goal: MultiPinch, space: Space, links: Sequence[Link]) -> Minima:
        """Return local minima; again where strangers are met."""
        scene, warm, blocks = self.inspector.scene, self._warm(space, links), self._blocks(space)
        effort = SEVERAL if space.size <= FEW else MANY
        while True:
            found = minima(Placed(scene, goal, space), warm, effort, blocks)
            met = False
            for minimum in (*found.explored, *found.polished):
                scene.place(space.posture(minimum.y))
                met |= goal.meet()
            if not met:
                return found

    def _links(self) -> list[Link]:
        scene, found = self.inspector.scene, []
        for (i, a), (j, b) in combinations(enumerate(self.fingers), 2):
            if frozenset((a.name, b.name)) in self.pinches:
                found.append(Link((i, j), scene.tips[str(a.tip), str(b.tip)]))
        return found

    def _strangers(self, moving: frozenset[int]) -> list[LinkPair]:
        mine = {finger.tip for finger in self.fingers}
        return [
            pair
            for pair in self.inspector.scene.tips.values()
            if not set(pair.links) <= mine and pair.actuators & moving
        ]

    def _warm(self, space: Space, links: Sequence[Link]) -> list[FloatArray]:
        """Return the pinches of pairs, and starts combined from those that link the fingers."""
        starts = []
        ends = [link.ends for link in links]
        for tree in trees(len(self.fingers), ends)[:_MOST_TREES]:
            values: list[list[float]] = [[] for _ in self._hand.actuators]
            for i in tree:
                names = frozenset(self.fingers[k].name for k in ends[i])
                for actuator in links[i].tips.actuators:
                    values[actuator].append(float(self.pinches[names][actuator]))
            u = self._hand.rest.copy()
            for actuator, chosen in enumerate(values):
                if chosen:
                    u[actuator] = np.mean(chosen)
            starts.append(space.coordinates(u))
        pinches = [self.pinches[frozenset(self.fingers[k].name for k in end)] for end in ends]
        return [*starts, *(space.coordinates(u) for u in pinches)]

    def _blocks(self, space: Space) -> list[Block]:
        """Return the coordinates that belong to each finger, and those that belong to none."""
        owner = {self._hand.actuator_index(n): f.name for f in self.fingers for n in f.own}
        blocks: dict[str | None, list[int]] = {}
        for coordinate, actuator in enumerate(space.index.tolist()):
            blocks.setdefault(owner.get(actuator), []).append(coordinate)
        return [np.array(block, dtype=np.intp) for block in blocks.values()]


def find_multi(
    inspector: Inspector, fingers: tuple[Finger, ...], pinches: Pinches, rank: Rank = "depth"
) -> Found | None:
    """Return the multi-pinch of some fingers, if there is one."""
    return MultiSearch(inspector, fingers, pinches, rank).run()
