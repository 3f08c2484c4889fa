"""From a hand to all its primitive grasping actions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Final

from rtee.actions.types import Primitive, PrimitiveKind
from rtee.extract.evidence import Inspector, posture_of
from rtee.extract.jobs import processors, workers
from rtee.extract.kinematic import kinematic_primitives
from rtee.extract.multi import Pinches, find_multi
from rtee.extract.pinch import find_pinch
from rtee.extract.ranking import Found, Rank
from rtee.hand.model import Finger, Hand

Progress = Callable[[int, int], None]

_WORTH_FORKING: Final = 4
"""Fewer searches than these are done in one process."""


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
        jobs: Processes to use; 0 for one per processor.
        rank: Which posture of a pinch comes first among the clear ones.
        progress: Called with the number of searches done and their total.

    Raises:
        ModelError: A mesh is missing or cannot be read.
    """
    begun = time.perf_counter()
    primitives = kinematic_primitives(hand)
    inspector = Inspector.of(hand)
    found = _pinches(inspector, jobs or processors(), rank, progress or (lambda done, total: None))
    primitives += [_primitive(hand, pinch) for pinch in found]
    order = list(PrimitiveKind)
    primitives.sort(key=lambda p: (order.index(p.kind), p.tips))
    return Extraction(tuple(primitives), time.perf_counter() - begun, _notes(inspector))


_PairTask = tuple[int, int, Rank]
_MultiTask = tuple[tuple[int, ...], Pinches, Rank]


def _pinches(inspector: Inspector, jobs: int, rank: Rank, progress: Progress) -> list[Found]:
    fingers = inspector.scene.hand.fingers
    tipped = [i for i, finger in enumerate(fingers) if finger.tip]
    pairs = [(i, j, rank) for i, j in combinations(tipped, 2)]
    alone = len(pairs) < _WORTH_FORKING or len(inspector.scene.hand.actuators) == 1
    with workers(inspector, 1 if alone else jobs) as mapped:
        pinches = []
        for found in mapped(_find_pair, pairs):
            pinches.append(found)
            progress(len(pinches), len(pairs))
        result = [found for found in pinches if found is not None]
        tight = {
            frozenset(found.fingers): found
            for found in result
            if found.kind is PrimitiveKind.PINCH_TIGHT
        }
        sizes = range(len(tipped), 2, -1)  # those that take longest first
        groups = [(g, tight, rank) for size in sizes for g in combinations(tipped, size)]
        several = []
        for found in mapped(_find_group, groups):
            several.append(found)
            progress(len(pairs) + len(several), len(pairs) + len(groups))
    return result + [found for found in several if found is not None]


def _find_pair(inspector: Inspector, task: _PairTask) -> Found | None:
    i, j, rank = task
    fingers = inspector.scene.hand.fingers
    return find_pinch(inspector, fingers[i], fingers[j], rank)


def _find_group(inspector: Inspector, task: _MultiTask) -> Found | None:
    group, pinches, rank = task
    fingers: Iterator[Finger] = (inspector.scene.hand.fingers[i] for i in group)
    return find_multi(inspector, tuple(fingers), pinches, rank)


def _primitive(hand: Hand, found: Found) -> Primitive:
    involved = {name for finger in found.fingers for name in hand.finger(finger).actuators}
    return Primitive(
        found.kind,
        found.fingers,
        tuple(posture_of(hand, candidate.u, involved) for candidate in found.candidates),
        tuple(candidate.evidence for candidate in found.candidates),
        tips=len(found.fingers),
        fingers=found.fingers,
    )


def _notes(inspector: Inspector) -> tuple[str, ...]:
    pairs = inspector.collisions.at_rest
    if not pairs:
        return ()
    named = ", ".join(f"{a} and {b}" for a, b in pairs)
    return (f"these links touch at rest and are not checked against each other: {named}",)
