"""PinchTight and PinchLoose: two fingertips that touch, or come as close as they can."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rtee.actions.types import PrimitiveKind
from rtee.extract.collision_free import Patience
from rtee.extract.collisions import Watch
from rtee.extract.descent import descend
from rtee.extract.evidence import Inspector
from rtee.extract.goals import Gap, Parting, Pinch, Placed
from rtee.extract.grain import FINE
from rtee.extract.pairs import LinkPair
from rtee.extract.postures import clear_postures, stored
from rtee.extract.ranking import Candidate, Found, Rank, ranked
from rtee.extract.scene import Scene
from rtee.extract.search import minima
from rtee.extract.space import Space, make_space, real_limits, rounded, widened_limits
from rtee.hand.model import Finger, Hand
from rtee.types import FloatArray

_TRIED: Final = 4
_SEEKING: Final = 40
_MOST: Final[dict[Rank, int]] = {"depth": 2, "opposition": 6}
"""How many postures are measured, and kept where they are distinct."""


@dataclass(frozen=True, slots=True)
class Sight:
    """What a first look at two fingers showed.

    Attributes:
        kind: Tight or loose.
        minima: Coordinates of the deepest poses, of their convex parts, the deepest first; as they
            were before polishing.
        postures: Postures as stored in which the tips touch, the deepest first; of a loose pinch
            the one in which they are closest.
        explored: The posture ``(n,)`` of the deepest pose before polishing, for further searches.
    """

    kind: PrimitiveKind
    minima: tuple[FloatArray, ...]
    postures: tuple[FloatArray, ...]
    explored: FloatArray


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

    def look(self) -> Sight | None:
        """Return whether the fingers pinch and how, before anything else is looked at."""
        space = self._space(real_limits(self._hand))
        if self._touch(space, space.rest) and not self._can_part(space):
            return None
        goal = Pinch(self._scene, self.tips)
        found = minima(Placed(self._scene, goal, space))
        contacts = self._contacts(space, [m.y for m in found.polished if m.value <= 0.0])
        touching = tuple(stored(self.inspector, goal, space, contacts))
        if touching:
            explored = tuple(m.y for m in found.explored if m.value <= 0.0)
            starts = explored or (space.coordinates(touching[0]),)
            return Sight(PrimitiveKind.PINCH_TIGHT, starts, touching, space.posture(starts[0]))
        if self._could_meet():
            closest = self._closest(space, [m.y for m in found.polished])
            return Sight(PrimitiveKind.PINCH_LOOSE, (), (closest,), closest)
        return None

    def finish(self, sight: Sight) -> Found:
        """Return the pinch with its postures, ranked, and their evidence."""
        watch = self._watch()
        most = _MOST[self.rank]
        best = self._candidate(sight.postures[0], watch)
        candidates = [best]
        if sight.kind is PrimitiveKind.PINCH_TIGHT and not best.usable:
            space = self._space(real_limits(self._hand))
            goal = Pinch(self._scene, self.tips)
            clear = clear_postures(self.inspector, goal, space, watch, sight.minima, Patience())
            candidates += [self._candidate(u, watch) for u in clear[: most - 1]]
            if not any(candidate.room for candidate in candidates):
                cramped, starts = watch.cramped, sight.minima
                clear = clear_postures(self.inspector, goal, space, cramped, starts, Patience())
                candidates += [self._candidate(u, watch) for u in clear[: most - 1]]
        others = sight.postures[1 : most + 1 - len(candidates)]
        candidates += [self._candidate(u, watch) for u in others]
        names = tuple(finger.name for finger in self.fingers)
        lower, upper = real_limits(self._hand)
        return Found(sight.kind, names, ranked(candidates, self.rank, upper - lower))

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
        return descend(gap, start, evaluations=_SEEKING, grain=FINE, enough=0.0).y

    def _can_part(self, space: Space) -> bool:
        """Return whether the tips are apart anywhere; contact everywhere shows no pinch."""
        parting = Placed(self._scene, Parting(self._scene, self.tips), space)
        return any(not self._touch(space, m.y) for m in minima(parting).polished[:_TRIED])

    def _could_meet(self) -> bool:
        """Return whether the tips would touch if the limits were wider."""
        wide = self._space(widened_limits(self._hand))
        found = minima(Placed(self._scene, Pinch(self._scene, self.tips), wide))
        return bool(self._contacts(wide, [m.y for m in found.polished if m.value <= 0.0]))

    def _closest(self, space: Space, found: Sequence[FloatArray]) -> FloatArray:
        """Return the posture as stored at which the tips' geometry is closest."""
        ends = [self._seek(space, y) for y in found[:_TRIED]]
        gap = Placed(self._scene, Gap(self._scene, self.tips), space)
        return rounded(self._hand, space.posture(min(ends, key=gap.value)))

    def _watch(self) -> Watch:
        moving = {self._hand.actuator_index(n) for f in self.fingers for n in f.actuators}
        return self.inspector.collisions.watch(moving, [frozenset(self.tips.links)])

    def _candidate(self, u: FloatArray, watch: Watch) -> Candidate:
        return self.inspector.pinch(u, self.tips, watch)


def pinch_search(
    inspector: Inspector, first: Finger, second: Finger, rank: Rank
) -> PinchSearch | None:
    """Return the search for the pinch of two fingers, ``None`` if their tips cannot move apart."""
    tips = inspector.scene.tips.get((str(first.tip), str(second.tip)))
    return None if tips is None else PinchSearch(inspector, (first, second), tips, rank)
