"""Extraction of all primitive grasping actions of a hand."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, compress
from operator import not_
from typing import Final

import numpy as np

from rtee.actions.naming import label
from rtee.actions.types import Primitive, PrimitiveKind
from rtee.child import processors
from rtee.extract.canonical import Canonical, canonical
from rtee.extract.evidence import Inspector, as_posture
from rtee.extract.jobs import ForkedProcesses, Progress
from rtee.extract.kinematic import kinematic_primitives
from rtee.extract.multi import MultiSearch, Pinches
from rtee.extract.pinch import PinchProbe, pinch_search
from rtee.extract.ranking import FoundPinch, Rank
from rtee.hand.geometry import HandGeometry
from rtee.hand.model import Finger, Hand
from rtee.hand.resting import NEAR, closed_rest
from rtee.hand.urdf import LARGE

_MOST_WAYS: Final = 3
"""Most notes about ways that are not clear: each is a long sentence."""


@dataclass(frozen=True)
class Extraction:
    """The result of an extraction.

    Attributes:
        primitives: The primitives, sorted by kind.
        seconds: Duration of the extraction [s].
        notes: Sentences about unusual properties of the model.
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

    The same hand gives the same result with any number of jobs.

    Args:
        hand: The hand.
        jobs: Number of processes; 0 for one per processor.
        rank: Criterion that orders the clear postures of a pinch.
        progress: Called with the number of finished searches and the total.

    Raises:
        ModelError: A mesh is missing or cannot be read.
    """
    begun = time.perf_counter()
    primitives = kinematic_primitives(hand)
    form = canonical(hand)
    inspector = Inspector.of(form.hand, form.unit)
    # Before the searches, whose processes inherit the shapes that are simplified here.
    notes = _notes(inspector, form)
    pinches = _pinches(
        inspector, jobs or processors(), rank, progress or (lambda done, total: None)
    )
    primitives += [_primitive(form, pinch) for pinch in pinches]
    # Pinches are in the order of tasks; files and reports list them by kind.
    order, names = list(PrimitiveKind), [*hand.finger_names, *hand.actuator_names]
    primitives.sort(
        key=lambda p: (order.index(p.kind), p.tips, [names.index(e) for e in p.elements])
    )
    notes += _blocked_paths(form, pinches)
    return Extraction(tuple(primitives), time.perf_counter() - begun, notes)


def _pinches(inspector: Inspector, jobs: int, rank: Rank, progress: Progress) -> list[FoundPinch]:
    """Return all pinches, of two fingers and of more."""
    tipped = [finger for finger in inspector.scene.hand.fingers if finger.tip]
    pairs = list(combinations(tipped, 2))
    # The longest searches first, so that all processes end at about the same time.
    groups = [g for size in range(len(tipped), 2, -1) for g in combinations(tipped, size)]
    most, before = len(groups) + len(pairs), len(pairs)
    with ForkedProcesses(inspector, min(jobs, most)) as workers:
        found = workers.map([partial(_probed, pair, rank) for pair in pairs], progress)
        probes = {pair: probe for pair, probe in zip(pairs, found, strict=True) if probe}
        # Searches for several tips start from the pinches of two fingers.
        tight = {
            frozenset(finger.name for finger in pair): probe.explored
            for pair, probe in probes.items()
            if probe.kind is PrimitiveKind.PINCH_TIGHT
        }
        several = [partial(_of_several, group, tight, rank) for group in groups]
        of_two = [partial(_of_two, pair, probe, rank) for pair, probe in probes.items()]
        blocked = [probe.blocked for probe in probes.values()]
        # A search of two tips for a clear posture takes about as long as one of three tips.
        large = sum(len(group) > 3 for group in groups)
        tasks: list[Callable[[Inspector], FoundPinch | None]]
        tasks = [*several[:large], *compress(of_two, blocked), *several[large:]]
        tasks += compress(of_two, map(not_, blocked))
        pinches = workers.map(tasks, lambda done, total: progress(before + done, before + total))
    return [pinch for pinch in pinches if pinch is not None]


def _probed(pair: tuple[Finger, Finger], rank: Rank, inspector: Inspector) -> PinchProbe | None:
    inspector.scene.forget()  # so that results do not depend on the distribution of tasks
    search = pinch_search(inspector, *pair, rank)
    return None if search is None else search.probe()


def _of_two(
    pair: tuple[Finger, Finger], probe: PinchProbe, rank: Rank, inspector: Inspector
) -> FoundPinch | None:
    inspector.scene.forget()
    search = pinch_search(inspector, *pair, rank)
    return None if search is None else search.finish(probe)


def _of_several(
    group: tuple[Finger, ...], tight: Pinches, rank: Rank, inspector: Inspector
) -> FoundPinch | None:
    inspector.scene.forget()
    return MultiSearch(inspector, group, tight, rank).run()


def _primitive(form: Canonical, pinch: FoundPinch) -> Primitive:
    hand, fingers = form.source, form.fingers(pinch.fingers)
    involved = {name for finger in fingers for name in hand.finger(finger).actuators}
    return Primitive(
        pinch.kind,
        fingers,
        tuple(as_posture(hand, form.posture(c.u), involved) for c in pinch.candidates),
        tuple(form.evidence(c.evidence, pinch.fingers) for c in pinch.candidates),
        tips=len(fingers),
        fingers=fingers,
    )


def _notes(inspector: Inspector, form: Canonical) -> tuple[str, ...]:
    notes = list(inspector.scene.geometry.notes)
    extents = {
        s.link: float(np.ptp(s.box, axis=0).max()) / form.unit for s in inspector.scene.shapes
    }
    largest = max(extents, key=extents.__getitem__, default="")
    if largest and extents[largest] > LARGE:
        meshes = any(shape.mesh for shape in form.source.urdf.links[largest].collisions)
        notes.append(
            f"link '{largest}' is {extents[largest]:.3g} m large; "
            + (
                'meshes drawn in millimetres need scale="0.001 0.001 0.001" in the URDF'
                if meshes
                else "are its sizes in millimetres? URDFs have metres"
            )
        )
    pairs = inspector.collisions.at_rest
    if pairs:
        named = ", ".join(f"{a} and {b}" for a, b in sorted(map(sorted, pairs)))
        notes.append(f"these links touch at rest and are not checked against each other: {named}")
    # `closed_rest` reads the original meshes, so call it only if tips are near each other.
    closed = closed_rest(HandGeometry(form.source)) if _near_at_rest(inspector) else None
    if closed is not None:
        notes.append(closed.text)
    return tuple(notes)


def _blocked_paths(form: Canonical, pinches: Sequence[FoundPinch]) -> tuple[str, ...]:
    """Return notes about links in the way of executed postures, each pair of links once."""
    notes = []
    ways = {c.blocking: p for p in reversed(pinches) if (c := p.candidates[0]).blocking}
    for blocking, pinch in list(ways.items())[:_MOST_WAYS]:
        first, second = sorted(blocking)
        what = label(pinch.kind, form.fingers(pinch.fingers))
        notes.append(
            f"the way to {what} is not clear: {first} and {second} come too near each other; if "
            "they cannot do so on the real hand, write into its SRDF: "
            f'<disable_collisions link1="{first}" link2="{second}" reason="Never"/>'
        )
    return tuple(notes)


def _near_at_rest(inspector: Inspector) -> bool:
    """Return whether any two fingertips nearly touch at rest."""
    scene = inspector.scene
    scene.place(scene.hand.rest)
    tips = [finger.tip for finger in scene.hand.fingers if finger.tip]
    pairs = (scene.pair(*both) for both in combinations(tips, 2))
    # Twice the distance, since the exact test uses another unit of length.
    return any(pair and scene.at_least(pair) <= 2.0 * NEAR * scene.unit for pair in pairs)
