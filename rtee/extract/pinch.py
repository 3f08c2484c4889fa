"""Search for PinchTight and PinchLoose: two fingertips that touch, or nearly do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.actions.types import PrimitiveKind
from rtee.extract.clear_elsewhere import ClearElsewhere
from rtee.extract.collision_free import SearchBudget, clear_postures, touching_postures
from rtee.extract.collisions import CollisionChecker
from rtee.extract.descent import Minimum, descend
from rtee.extract.distance_queries import TOUCH
from rtee.extract.evidence import Inspector
from rtee.extract.goals import GapGoal, GoalFunction, PinchGoal, SeparationGoal, TipEdge
from rtee.extract.pairs import LinkPair
from rtee.extract.polish import polish
from rtee.extract.ranking import Candidate, FoundPinch, Rank, ranked
from rtee.extract.resolution import FINE
from rtee.extract.search import PAIR, minima, nearest
from rtee.extract.space import Space, make_space, real_limits, widened_limits
from rtee.hand.halton import halton
from rtee.hand.model import Finger
from rtee.sample import FloatArray

_TRIED: Final = 4
"""Number of minima from which to search for contact of the original geometry, the deepest first."""

_EVALUATIONS: Final = 40
"""Maximum number of evaluations of such a descent, each of which measures meshes."""

_HOLLOW: Final = 24
"""Maximum number of places at which to measure the distance of hollow tips, to choose starts."""

_LEFT_OUT: Final = (4, 8)
"""Number of the deepest minima that further searches for clear postures leave out."""

_MOST: Final[dict[Rank, int]] = {"depth": 2, "opposition": 6}
"""Number of postures to measure and, if distinct, to keep, by rank: the deepest is found early, but
any of them may be the best opposed."""


@dataclass(frozen=True, slots=True)
class PinchProbe:
    """Pinch of two fingers, without regard to collisions with other links.

    Attributes:
        kind: Tight or loose.
        minima: Coordinates of the deepest poses of the convex parts before polishing, the deepest
            first.
        postures: Postures as stored in which the tips touch, the deepest first; for a loose pinch,
            the one in which they are closest.
        explored: The posture ``(n,)`` of the deepest pose before polishing, for further searches.
        best: The first of the postures with its evidence.
    """

    kind: PrimitiveKind
    minima: tuple[FloatArray, ...]
    postures: tuple[FloatArray, ...]
    explored: FloatArray
    best: Candidate

    @property
    def blocked(self) -> bool:
        """Whether other links are in the way, so that a clear posture must be searched for."""
        return self.kind is PrimitiveKind.PINCH_TIGHT and not self.best.usable


class PinchSearch:
    """Search for the pinch of two fingers."""

    def __init__(
        self, inspector: Inspector, fingers: tuple[Finger, Finger], tips: LinkPair, rank: Rank
    ) -> None:
        """Prepare a search; ``rank`` is the criterion that orders postures."""
        self._inspector = inspector
        self._scene, self._hand = inspector.scene, inspector.scene.hand
        self._fingers = fingers
        self._tips = tips
        self._rank: Rank = rank
        space = make_space(self._hand, sorted(tips.actuators), real_limits(self._hand))
        self._pinch = GoalFunction(self._scene, PinchGoal(self._scene, tips), space)

    def probe(self) -> PinchProbe | None:
        """Return the pinch without regard to other links; ``None`` if the fingers do not pinch."""
        pinch, space = self._pinch, self._pinch.space
        # Tips that always touch, such as those of one rigid part, do not pinch.
        if pinch.touching(space.posture(space.rest)) and not self._can_separate():
            return None
        found = minima(pinch)
        contacts = self._contacts(pinch, [m.y for m in found.polished if m.value <= TOUCH])
        touching = tuple(touching_postures(pinch, contacts))
        if touching:
            explored = tuple(m.y for m in found.explored if m.value <= TOUCH)
            starts = explored or (space.coordinates(touching[0]),)
            return self._probed(starts, touching, space.posture(starts[0]))
        if self._could_meet():
            closest = self._closest([m.y for m in found.polished])
            # Tips that meet only at their limits touch only there.
            for u in (closest, self._at_limits(closest)):
                if pinch.touching(u):
                    return self._probed((space.coordinates(u),), (u,), u)
            return self._probed((), (closest,), closest)
        return None

    def _probed(
        self, starts: tuple[FloatArray, ...], postures: tuple[FloatArray, ...], explored: FloatArray
    ) -> PinchProbe:
        """Return what a probe has found; without starts for a search, the pinch is loose."""
        kind = PrimitiveKind.PINCH_TIGHT if starts else PrimitiveKind.PINCH_LOOSE
        self._scene.forget()  # evidence must not depend on the search
        (best,) = self._candidates(postures[:1], self._checker())
        return PinchProbe(kind, starts, postures, explored, best)

    def _checker(self) -> CollisionChecker:
        return self._inspector.checker(self._fingers, [TipEdge((0, 1), self._tips)])

    def _candidates(
        self, postures: Sequence[FloatArray], checker: CollisionChecker
    ) -> list[Candidate]:
        return [self._inspector.pinch(u, self._tips, checker) for u in postures]

    def finish(self, probe: PinchProbe) -> FoundPinch:
        """Return the pinch with its postures, ranked, and their evidence."""
        checker, most, candidates = self._checker(), _MOST[self._rank], [probe.best]
        if probe.blocked:
            for applied in (checker, checker.reduced):
                clear = clear_postures(
                    self._pinch, self._inspector.motion, applied, probe.minima, SearchBudget()
                )
                # Keep one place for the deepest posture, clear or not.
                candidates += self._candidates(clear[: most - 1], checker)
                # Reduced margins are only for pinches without a posture of full margins.
                if any(candidate.margin for candidate in candidates):
                    break
            further = ClearElsewhere(
                self._pinch,
                self._inspector.motion,
                checker,
                lambda u: self._candidates([u], checker)[0],
                SearchBudget(),
                _LEFT_OUT,
            )
            if found := further.deeper(candidates, probe.postures[1:], probe.minima):
                candidates = [probe.best, *found, *candidates[1:]][:most]
        # Further deep postures fill the remaining places.
        candidates += self._candidates(probe.postures[1 : most + 1 - len(candidates)], checker)
        names = tuple(finger.name for finger in self._fingers)
        return FoundPinch(probe.kind, names, ranked(self._hand, candidates, self._rank))

    def _can_separate(self) -> bool:
        """Return whether the tips can separate; tips that always touch are not a pinch."""
        space = self._pinch.space
        apart = GoalFunction(self._scene, SeparationGoal(self._scene, self._tips), space)
        ends = minima(apart).polished[:_TRIED]
        return any(not apart.touching(space.posture(m.y)) for m in ends)

    def _could_meet(self) -> bool:
        """Return whether the tips would touch if the limits were wider."""
        limits = widened_limits(self._hand)
        wide = make_space(self._hand, sorted(self._tips.actuators), limits)
        function = GoalFunction(self._scene, self._pinch.goal, wide)
        # Overlap of the convex parts is necessary for contact, and cheap to measure.
        deep = [m.y for m in minima(function).polished if m.value <= TOUCH]
        return bool(self._contacts(function, deep))

    def _closest(self, starts: Sequence[FloatArray]) -> FloatArray:
        """Return the posture, as stored, with the least distance of the tips' original geometry."""
        pinch = self._pinch
        gap = self._gap(pinch.space)
        best = min((_descended(gap, y) for y in starts[:_TRIED]), key=lambda m: m.value)
        if pinch.space.size <= 1:  # whose minima are all known
            return gap.stored(best.y)
        # Hollow tips may be closest where their convex parts are not. Only places where these are
        # nearer than the best distance need the slow measurement.
        places = [(pinch.value(y), y) for y in halton(pinch.space.size, PAIR.screened)]
        hollow = sorted((p for p in places if p[0] < best.value), key=lambda place: place[0])
        further = nearest(gap, [y for _, y in hollow[:_HOLLOW]], _TRIED)
        best = min((best, *(_descended(gap, y) for y in further)), key=lambda m: m.value)
        # Distances also have kinks, where another pair of faces becomes the closest.
        end = polish(gap, best.y, evaluations=_EVALUATIONS)
        return gap.stored(min((best, end), key=lambda m: m.value).y)

    def _at_limits(self, u: FloatArray) -> FloatArray:
        """Return a posture, as stored, with actuators that are close to a limit exactly there."""
        y = self._pinch.space.coordinates(u)
        # The searches' lattice ends less than one unit before the limits.
        near = FINE.coordinate
        return self._pinch.stored(np.where(y < near, 0.0, np.where(y > 1.0 - near, 1.0, y)))

    def _contacts(self, pinch: GoalFunction, deep: Sequence[FloatArray]) -> list[FloatArray]:
        """Return coordinates at which the tips' original geometry touches, the deepest first.

        If only the convex parts overlap at the minima, minimises the exact distance from there.
        """

        def touching(places: Sequence[FloatArray]) -> list[FloatArray]:
            return [y for y in places if pinch.touching(pinch.space.posture(y))]

        gap = self._gap(pinch.space)
        return touching(deep) or touching([_descended(gap, y).y for y in deep[:_TRIED]])

    def _gap(self, space: Space) -> GoalFunction:
        """Return the goal function of the distance of the tips' original geometry."""
        return GoalFunction(self._scene, GapGoal(self._scene, self._tips), space)


def _descended(gap: GoalFunction, start: FloatArray) -> Minimum:
    return descend(gap, start, evaluations=_EVALUATIONS, resolution=FINE, enough=0.0)


def pinch_search(
    inspector: Inspector, first: Finger, second: Finger, rank: Rank
) -> PinchSearch | None:
    """Return the search for the pinch of two fingers, ``None`` if their tips cannot separate."""
    tips = inspector.scene.tips.get((str(first.tip), str(second.tip)))
    return None if tips is None else PinchSearch(inspector, (first, second), tips, rank)
