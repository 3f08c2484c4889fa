"""From a hand to all its primitive grasping actions."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Final

import numpy as np

from rtee.actions.types import Primitive, PrimitiveKind
from rtee.extract.evidence import Inspector, posture_of
from rtee.extract.jobs import Progress, processors, spread
from rtee.extract.kinematic import kinematic_primitives
from rtee.extract.multi import Pinches, find_multi
from rtee.extract.pinch import Sight, pinch_search
from rtee.extract.ranking import Found, Rank
from rtee.hand.model import Hand
from rtee.hand.resting import closed_rest

_LARGE: Final = 5.0
"""Links of hands are smaller than this [m]."""


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


_Look = tuple[int, int, Rank]
_Finish = tuple[int, int, Rank, Sight]
_Group = tuple[tuple[int, ...], Pinches, Rank]


def _pinches(inspector: Inspector, jobs: int, rank: Rank, progress: Progress) -> list[Found]:
    """Return all pinches: first who pinches at all, then how, and who else joins."""
    fingers = inspector.scene.hand.fingers
    tipped = [i for i, finger in enumerate(fingers) if finger.tip]
    looks: list[_Look] = [(i, j, rank) for i, j in combinations(tipped, 2)]
    groups = [
        group for size in range(len(tipped), 2, -1) for group in combinations(tipped, size)
    ]  # those that take longest first
    found = spread(partial(_look, inspector), looks, jobs, progress)
    seen = [(i, j, sight) for (i, j, _), sight in zip(looks, found, strict=True) if sight]
    tight = {
        frozenset((fingers[i].name, fingers[j].name)): sight.explored
        for i, j, sight in seen
        if sight.kind is PrimitiveKind.PINCH_TIGHT
    }
    tasks: list[_Finish | _Group] = [(group, tight, rank) for group in groups]
    tasks += [(i, j, rank, sight) for i, j, sight in seen]  # short ones last: all end together
    before = len(looks)
    finished = spread(
        partial(_finish, inspector),
        tasks,
        jobs,
        lambda done, total: progress(before + done, before + total),
    )
    return [one for one in finished if one is not None]


def _look(inspector: Inspector, task: _Look) -> Sight | None:
    inspector.scene.forget()  # which process does what does not matter
    i, j, rank = task
    fingers = inspector.scene.hand.fingers
    search = pinch_search(inspector, fingers[i], fingers[j], rank)
    return None if search is None else search.look()


def _finish(inspector: Inspector, task: _Finish | _Group) -> Found | None:
    inspector.scene.forget()
    fingers = inspector.scene.hand.fingers
    if len(task) == 4:
        i, j, rank, sight = task
        search = pinch_search(inspector, fingers[i], fingers[j], rank)
        return None if search is None else search.finish(sight)
    group, pinches, rank = task
    return find_multi(inspector, tuple(fingers[i] for i in group), pinches, rank)


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
    notes = []
    extents = {s.link: float(np.ptp(s.box, axis=0).max()) for s in inspector.scene.shapes}
    largest = max(extents, key=extents.__getitem__, default="")
    if largest and extents[largest] > _LARGE:
        notes.append(
            f"link '{largest}' is {extents[largest]:.3g} m large; meshes drawn in millimetres need "
            'scale="0.001 0.001 0.001" in the URDF'
        )
    pairs = inspector.collisions.at_rest
    if pairs:
        named = ", ".join(f"{a} and {b}" for a, b in pairs)
        notes.append(f"these links touch at rest and are not checked against each other: {named}")
    closed = closed_rest(inspector.scene.geometry)
    if closed is not None:
        notes.append(closed.text)
    return tuple(notes)
