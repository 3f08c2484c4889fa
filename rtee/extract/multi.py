"""MultiPinchTight: three fingertips or more that touch together, linked by contacts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from rtee.actions.types import Primitive, PrimitiveKind
from rtee.extract.evidence import Inspector, posture_of
from rtee.extract.goals import Link, MultiPinch, Placed, linked, trees
from rtee.extract.postures import clear_postures, stored
from rtee.extract.ranking import Candidate, Rank, ranked
from rtee.extract.search import minima
from rtee.extract.space import Space, make_space, real_limits
from rtee.hand.model import Finger, Hand
from rtee.types import FloatArray

_TRIED: Final = 4
_STARTS: Final = 8
_MOST_TREES: Final = 8

Pinches = Mapping[frozenset[str], Primitive]
"""The tight pinches and the smaller multi-pinches found so far, by their fingers."""


@dataclass(frozen=True)
class MultiSearch:
    """Looks for the multi-pinch of some fingers.

    Attributes:
        inspector: Measures postures.
        fingers: The fingers.
        pinches: What was found before.
        rank: What makes one posture better than another.
    """

    inspector: Inspector
    fingers: tuple[Finger, ...]
    pinches: Pinches
    rank: Rank = "depth"

    def run(self) -> Primitive | None:
        """Return the multi-pinch, if there is one."""
        links = self._links()
        if not linked(len(self.fingers), [link.ends for link in links]):
            return None
        moving = frozenset().union(*(link.tips.actuators for link in links))
        space = make_space(self._hand, sorted(moving), real_limits(self._hand))
        strangers = self._strangers(moving)
        goal = MultiPinch(self.inspector.scene, len(self.fingers), links, strangers)
        function = Placed(self.inspector.scene, goal, space)
        found = [m.y for m in minima(function, self._warm(space, links), _STARTS)]
        touching = stored(self.inspector, goal, space, found[:_TRIED])
        if not touching:
            return None
        involved = {self._hand.actuator_index(n) for f in self.fingers for n in f.actuators}
        watch = self.inspector.collisions.watch(
            involved, [frozenset(link.tips.links) for link in links]
        )
        names = tuple(finger.name for finger in self.fingers)

        def candidate(u: FloatArray) -> Candidate:
            return Candidate(u, self.inspector.multi_pinch(u, names, links, watch))

        candidates = [candidate(u) for u in touching]
        if not candidates[0].usable:
            candidates += map(candidate, clear_postures(self.inspector, goal, space, watch, found))
        best = ranked(candidates, self.rank)
        actuators = {name for finger in self.fingers for name in finger.actuators}
        return Primitive(
            PrimitiveKind.MULTI_PINCH_TIGHT,
            names,
            tuple(posture_of(self._hand, c.u, actuators) for c in best),
            tuple(c.evidence for c in best),
            tips=len(names),
            fingers=names,
        )

    @property
    def _hand(self) -> Hand:
        return self.inspector.scene.hand

    def _links(self) -> list[Link]:
        scene, found = self.inspector.scene, []
        for (i, a), (j, b) in combinations(enumerate(self.fingers), 2):
            if frozenset((a.name, b.name)) in self.pinches:
                found.append(Link((i, j), scene.tips[str(a.tip), str(b.tip)]))
        return found

    def _strangers(self, moving: frozenset[int]) -> list:
        mine = {finger.tip for finger in self.fingers}
        return [
            pair
            for pair in self.inspector.scene.tips.values()
            if not set(pair.links) <= mine and pair.actuators & moving
        ]

    def _warm(self, space: Space, links: Sequence[Link]) -> list[FloatArray]:
        """Return starts combined from the pinches of pairs that link the fingers."""
        starts = []
        ends = [link.ends for link in links]
        for tree in trees(len(self.fingers), ends)[:_MOST_TREES]:
            parts = []
            for i in tree:
                a, b = (self.fingers[k].name for k in ends[i])
                parts.append(self.pinches[frozenset((a, b))].posture)
            values = {
                name: [part.position[name] for part in parts if name in part.involved]
                for name in self._hand.actuator_names
            }
            u = np.array(
                [
                    np.mean(values[spec.name]) if values[spec.name] else spec.rest
                    for spec in self._hand.actuators
                ]
            )
            starts.append(space.coordinates(u))
        return starts


def find_multi(
    inspector: Inspector, fingers: tuple[Finger, ...], pinches: Pinches, rank: Rank = "depth"
) -> Primitive | None:
    """Return the multi-pinch of some fingers, if there is one."""
    return MultiSearch(inspector, fingers, pinches, rank).run()
