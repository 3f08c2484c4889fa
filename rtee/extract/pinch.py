"""PinchTight and PinchLoose: two fingertips that touch, or come as close as they can."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rtee.actions.types import Primitive, PrimitiveKind
from rtee.extract.clear import ClearSearch
from rtee.extract.collisions import Watch
from rtee.extract.descent import descend
from rtee.extract.evidence import Inspector, posture_of
from rtee.extract.ranking import Candidate, Rank, ranked
from rtee.extract.scene import LinkPair
from rtee.extract.search import SignedDistance, minima
from rtee.extract.space import Space, make_space, real_limits, rounded, widened_limits
from rtee.hand.model import Finger, Hand
from rtee.types import FloatArray

_SHOWN: Final = 4
_STARTS: Final = 10
_SEEKING: Final = 40


@dataclass(frozen=True)
class PinchSearch:
    """Looks for the pinch of two fingers.

    Attributes:
        inspector: Measures postures.
        fingers: The two fingers.
        tips: Their fingertips, in the same order.
        rank: What makes one posture better than another.
    """

    inspector: Inspector
    fingers: tuple[Finger, Finger]
    tips: LinkPair
    rank: Rank

    def run(self) -> Primitive | None:
        """Return the pinch, tight or loose, if there is one."""
        space = self._space(real_limits(self._hand))
        found = [m.y for m in minima(SignedDistance(self.inspector.scene, self.tips, space))]
        overlapping = [y for y in found if self._distance(space, y) <= 0.0]
        touching = self._touching(space, overlapping)
        if touching:
            return self._tight(space, touching, overlapping)
        if self._could_meet():
            return self._loose(space, found)
        return None

    @property
    def _hand(self) -> Hand:
        return self.inspector.scene.hand

    def _space(self, bounds: tuple[FloatArray, FloatArray]) -> Space:
        return make_space(self._hand, sorted(self.tips.actuators), bounds)

    def _distance(self, space: Space, y: FloatArray) -> float:
        self.inspector.scene.place(space.posture(y))
        return self.inspector.scene.distance(self.tips)

    def _touches(self, u: FloatArray) -> bool:
        self.inspector.scene.place(u)
        return self.inspector.scene.touching(self.tips)

    def _touching(self, space: Space, found: Sequence[FloatArray]) -> list[FloatArray]:
        """Return postures as stored in which the tips touch exactly, the deepest first."""
        postures = [rounded(self._hand, space.posture(y)) for y in found[:_SHOWN]]
        touching = [u for u in postures if self._touches(u)]
        if touching or not found:
            return touching
        sought = (self._seek(space, y) for y in found[:_SHOWN])
        return [u for u in sought if u is not None]

    def _seek(self, space: Space, start: FloatArray) -> FloatArray | None:
        """Return a posture in which the tips touch exactly, near one where only hulls overlap."""
        end = descend(
            SignedDistance(self.inspector.scene, self.tips, space, exact=True),
            start,
            evaluations=_SEEKING,
            enough=0.0,
        )
        u = rounded(self._hand, space.posture(end.y))
        return u if self._touches(u) else None

    def _could_meet(self) -> bool:
        """Return whether the tips would touch if the limits were wider."""
        wide = self._space(widened_limits(self._hand))
        found = minima(SignedDistance(self.inspector.scene, self.tips, wide))
        for minimum in found[:_SHOWN]:
            if minimum.value > 0.0:
                return False
            if self._touches(wide.posture(minimum.y)) or self._seek(wide, minimum.y) is not None:
                return True
        return False

    def _watch(self) -> Watch:
        moving = {self._hand.actuator_index(n) for f in self.fingers for n in f.actuators}
        return self.inspector.collisions.watch(moving, [frozenset(self.tips.links)])

    def _tight(
        self, space: Space, touching: Sequence[FloatArray], starts: Sequence[FloatArray]
    ) -> Primitive:
        watch = self._watch()
        candidates = [self._candidate(touching[0], watch)]
        if not candidates[0].usable:
            search = ClearSearch(
                self.inspector.scene, self.inspector.motion, self.tips, space, watch
            )
            poses = [rounded(self._hand, space.posture(y)) for y in search.run(starts[:_STARTS])]
            clear = [u for u in poses if self._touches(u)]
            candidates += [self._candidate(u, watch) for u in clear[:_SHOWN]]
        candidates += [self._candidate(u, watch) for u in touching[1:]]
        return self._primitive(PrimitiveKind.PINCH_TIGHT, candidates)

    def _loose(self, space: Space, found: Sequence[FloatArray]) -> Primitive:
        watch = self._watch()
        exact = SignedDistance(self.inspector.scene, self.tips, space, exact=True)
        ends = [descend(exact, y, evaluations=_SEEKING) for y in found[:_SHOWN]]
        closest = min(ends, key=lambda end: end.value)
        u = rounded(self._hand, space.posture(closest.y))
        return self._primitive(PrimitiveKind.PINCH_LOOSE, [self._candidate(u, watch)])

    def _candidate(self, u: FloatArray, watch: Watch) -> Candidate:
        return Candidate(u, self.inspector.pinch(u, self.tips, watch))

    def _primitive(self, kind: PrimitiveKind, candidates: Sequence[Candidate]) -> Primitive:
        best = ranked(candidates, self.rank)[:_SHOWN]
        involved = {name for finger in self.fingers for name in finger.actuators}
        names = tuple(finger.name for finger in self.fingers)
        return Primitive(
            kind,
            names,
            tuple(posture_of(self._hand, c.u, involved) for c in best),
            tuple(c.evidence for c in best),
            tips=2,
            fingers=names,
        )


def tips_of(inspector: Inspector, first: Finger, second: Finger) -> LinkPair | None:
    """Return the tips of two fingers; ``None`` if they cannot move against each other."""
    if first.tip is None or second.tip is None:
        return None
    pair = inspector.scene.pair(first.tip, second.tip)
    return pair if pair is not None and pair.actuators else None


def find_pinch(
    inspector: Inspector, first: Finger, second: Finger, rank: Rank = "depth"
) -> Primitive | None:
    """Return the pinch of two fingers, tight or loose, if there is one."""
    tips = tips_of(inspector, first, second)
    if tips is None:
        return None
    return PinchSearch(inspector, (first, second), tips, rank).run()
