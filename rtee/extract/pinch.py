"""PinchTight and PinchLoose: two fingertips that touch, or come as close as they can."""

from __future__ import annotations

from dataclasses import dataclass

from rtee.actions.types import Evidence, Primitive, PrimitiveKind
from rtee.extract.evidence import Inspector, posture_of, rounded
from rtee.extract.scene import LinkPair
from rtee.extract.search import minima
from rtee.extract.space import Space, make_space, real_limits, widened_limits
from rtee.hand.model import Finger, Hand
from rtee.types import FloatArray

KEPT = 3


@dataclass(frozen=True)
class Candidate:
    """A posture with its evidence."""

    u: FloatArray
    evidence: Evidence


def tips_of(inspector: Inspector, first: Finger, second: Finger) -> LinkPair | None:
    """Return the tips of two fingers, ``None`` if they cannot pinch."""
    if first.tip is None or second.tip is None:
        return None
    pair = inspector.scene.pair(first.tip, second.tip)
    if pair is None or not pair.actuators:
        return None
    return pair


def find_pinch(inspector: Inspector, first: Finger, second: Finger) -> Primitive | None:
    """Return the pinch of two fingers, tight or loose, if there is one."""
    hand, scene = inspector.scene.hand, inspector.scene
    tips = tips_of(inspector, first, second)
    if tips is None:
        return None
    space = make_space(hand, sorted(tips.actuators), real_limits(hand))
    found = _search(inspector, tips, space)
    involved = {*first.actuators, *second.actuators}
    moving = [hand.actuator_index(a) for a in involved]
    others = inspector.collisions.concerned(moving, [frozenset(tips.links)])
    touching = []
    for m in found:
        if m.value > 0.0:
            continue
        u = rounded(hand, space.posture(m.y))
        scene.place(u)
        if scene.touching(tips):
            touching.append(u)
    if touching:
        candidates = [Candidate(u, inspector.pinch(u, tips, others)) for u in touching[:4]]
        candidates.sort(
            key=lambda c: (
                not (c.evidence.clear and c.evidence.path_clear),
                not c.evidence.clear,
                -c.evidence.depth,
            )
        )
        return _primitive(hand, PrimitiveKind.PINCH_TIGHT, first, second, candidates)
    wide = make_space(hand, sorted(tips.actuators), widened_limits(hand))
    meets = False
    for m in _search(inspector, tips, wide):
        if m.value > 0.0:
            break
        scene.place(wide.posture(m.y))
        if scene.touching(tips):
            meets = True
            break
    if not meets:
        return None
    u = rounded(hand, space.posture(found[0].y))
    return _primitive(
        hand,
        PrimitiveKind.PINCH_LOOSE,
        first,
        second,
        [Candidate(u, inspector.pinch(u, tips, others))],
    )


def _search(inspector: Inspector, tips: LinkPair, space: Space):
    scene = inspector.scene

    def value(y: FloatArray) -> float:
        scene.place(space.posture(y))
        return scene.distance(tips)

    def objective(y: FloatArray) -> tuple[float, FloatArray]:
        scene.place(space.posture(y))
        return scene.slope(tips, space)

    return minima(value, objective, space)


def _primitive(
    hand: Hand, kind: PrimitiveKind, first: Finger, second: Finger, candidates: list[Candidate]
) -> Primitive:
    involved = {*first.actuators, *second.actuators}
    return Primitive(
        kind,
        (first.name, second.name),
        tuple(posture_of(hand, c.u, sorted(involved)) for c in candidates),
        tuple(c.evidence for c in candidates),
        tips=2,
        fingers=(first.name, second.name),
    )
