"""PinchTight and PinchLoose: two fingertips that touch, or come as close as they can."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rtee.actions.types import PrimitiveKind
from rtee.extract.clear import Patience
from rtee.extract.collisions import Watch
from rtee.extract.descent import descend
from rtee.extract.evidence import Inspector
from rtee.extract.goals import Gap, Parting, Pinch, Placed
from rtee.extract.postures import clear_postures, stored
from rtee.extract.ranking import Candidate, Found, Rank, ranked
from rtee.extract.scene import LinkPair, Scene
from rtee.extract.search import minima
from rtee.extract.space import Space, make_space, real_limits, rounded, widened_limits
from rtee.hand.model import Finger, Hand
from rtee.types import FloatArray

_TRIED: Final = 4
_SEEKING: Final = 40
_MOST: Final[dict[Rank, int]] = {"depth": 2, "opposition": 6}
"""How many postures are measured, and kept where they are distinct."""


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
    rank: Rank = "depth"

    def run(self) -> Found | None:
        """Return the pinch, tight or loose, if there is one."""
        space = self._space(real_limits(self._hand))
        if self._touch(space, space.rest) and not self._can_part(space):
            return None
        found = minima(Placed(self._scene, Pinch(self._scene, self.tips), space))
        deep = [m.y for m in found if m.value <= 0.0]
        goal = Pinch(self._scene, self.tips)
        touching = stored(self.inspector, goal, space, self._contacts(space, deep))
        if touching:
            return self._tight(space, touching, deep)
        if self._could_meet():
            return self._loose(space, [m.y for m in found])
        return None

    @property
    def _scene(self) -> Scene:
        return self.inspector.scene

    @property
    def _hand(self) -> Hand:
        return self.inspector.scene.hand

    def _space(self, bounds: tuple[FloatArray, FloatArray]) -> Space:
        return make_space(self._hand, sorted(self.tips.actuators), bounds)

    def _contacts(self, space: Space, deep: Sequence[FloatArray]) -> list[FloatArray]:
        """Return coordinates at which the tips touch exactly, the deepest first.

        Where only the convex parts overlap at the minima, the exact distance leads to a contact.
        """
        found = [y for y in deep if self._touch(space, y)]
        if found:
            return found
        sought = [self._seek(space, y) for y in deep[:_TRIED]]
        return [y for y in sought if self._touch(space, y)]

    def _touch(self, space: Space, y: FloatArray) -> bool:
        self._scene.place(space.posture(y))
        return self._scene.touching(self.tips)

    def _seek(self, space: Space, start: FloatArray) -> FloatArray:
        """Return where a descent of the exact distance ends."""
        gap = Placed(self._scene, Gap(self._scene, self.tips), space)
        return descend(gap, start, evaluations=_SEEKING, enough=0.0).y

    def _can_part(self, space: Space) -> bool:
        """Return whether the tips are apart anywhere; contact everywhere shows no pinch."""
        parting = Placed(self._scene, Parting(self._scene, self.tips), space)
        return any(not self._touch(space, m.y) for m in minima(parting)[:_TRIED])

    def _could_meet(self) -> bool:
        """Return whether the tips would touch if the limits were wider."""
        wide = self._space(widened_limits(self._hand))
        found = minima(Placed(self._scene, Pinch(self._scene, self.tips), wide))
        return bool(self._contacts(wide, [m.y for m in found if m.value <= 0.0]))

    def _tight(
        self, space: Space, touching: Sequence[FloatArray], deep: Sequence[FloatArray]
    ) -> Found:
        watch = self._watch()
        most = _MOST[self.rank]
        candidates = [self._candidate(touching[0], watch)]
        if not candidates[0].usable:
            goal = Pinch(self._scene, self.tips)
            clear = clear_postures(self.inspector, goal, space, watch, deep, Patience())
            candidates += [self._candidate(u, watch) for u in clear[: most - 1]]
        candidates += [self._candidate(u, watch) for u in touching[1 : most + 1 - len(candidates)]]
        return self._found(PrimitiveKind.PINCH_TIGHT, candidates)

    def _loose(self, space: Space, found: Sequence[FloatArray]) -> Found:
        ends = [self._seek(space, y) for y in found[:_TRIED]]
        gap = Placed(self._scene, Gap(self._scene, self.tips), space)
        closest = min(ends, key=gap.value)
        u = rounded(self._hand, space.posture(closest))
        return self._found(PrimitiveKind.PINCH_LOOSE, [self._candidate(u, self._watch())])

    def _watch(self) -> Watch:
        moving = {self._hand.actuator_index(n) for f in self.fingers for n in f.actuators}
        return self.inspector.collisions.watch(moving, [frozenset(self.tips.links)])

    def _candidate(self, u: FloatArray, watch: Watch) -> Candidate:
        return Candidate(u, self.inspector.pinch(u, self.tips, watch))

    def _found(self, kind: PrimitiveKind, candidates: Sequence[Candidate]) -> Found:
        names = tuple(finger.name for finger in self.fingers)
        lower, upper = real_limits(self._hand)
        extent = upper - lower
        return Found(kind, names, ranked(candidates, self.rank, extent))


def find_pinch(
    inspector: Inspector, first: Finger, second: Finger, rank: Rank = "depth"
) -> Found | None:
    """Return the pinch of two fingers, tight or loose, if there is one."""
    tips = inspector.scene.tips.get((str(first.tip), str(second.tip)))
    if tips is None:
        return None
    return PinchSearch(inspector, (first, second), tips, rank).run()
