"""From a hand to all its primitive grasping actions."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

from rtee.actions.types import Primitive, PrimitiveKind
from rtee.extract.evidence import Inspector
from rtee.extract.kinematic import kinematic_primitives
from rtee.extract.multi import find_multi
from rtee.extract.pinch import find_pinch
from rtee.extract.ranking import Rank
from rtee.hand.model import Hand

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Extraction:
    """What was extracted from a hand.

    Attributes:
        primitives: The primitives, kind by kind.
        seconds: How long it took [s].
        notes: What was noticed, one sentence each.
    """

    primitives: tuple[Primitive, ...]
    seconds: float
    notes: tuple[str, ...] = ()


def extract(
    hand: Hand,
    *,
    jobs: int = 1,
    rank: Rank = "depth",
    progress: Progress | None = None,
) -> Extraction:
    """Find all primitive grasping actions of a hand.

    The same hand gives the same result, whatever the number of jobs.

    Args:
        hand: The hand.
        jobs: Processes to use.
        rank: Which posture of a pinch comes first among the clear ones.
        progress: Called with the number of searches done and their total.

    Raises:
        ModelError: A mesh is missing or cannot be read.
    """
    begun = time.perf_counter()
    found = kinematic_primitives(hand)
    inspector = Inspector.of(hand)
    fingers = [finger for finger in hand.fingers if finger.tip]
    pinches = [find_pinch(inspector, a, b, rank) for a, b in combinations(fingers, 2)]
    found += [pinch for pinch in pinches if pinch is not None]
    tight = {frozenset(p.elements): p for p in found if p.kind is PrimitiveKind.PINCH_TIGHT}
    for size in range(3, len(fingers) + 1):
        for group in combinations(fingers, size):
            multi = find_multi(inspector, group, tight, rank)
            if multi is not None:
                found.append(multi)
    order = list(PrimitiveKind)
    found.sort(key=lambda p: (order.index(p.kind), p.tips))
    return Extraction(tuple(found), time.perf_counter() - begun)
