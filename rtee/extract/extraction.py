"""From a hand to all its primitive grasping actions."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

from rtee.actions.types import Primitive
from rtee.extract.evidence import Inspector
from rtee.extract.kinematic import kinematic_primitives
from rtee.extract.pinch import find_pinch
from rtee.extract.ranking import Rank
from rtee.hand.model import Hand


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
    progress: Callable[[int, int], None] | None = None,
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
    for first, second in combinations([f for f in hand.fingers if f.tip], 2):
        pinch = find_pinch(inspector, first, second, rank)
        if pinch:
            found.append(pinch)
    return Extraction(tuple(found), time.perf_counter() - begun)
