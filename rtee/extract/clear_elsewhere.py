"""Search for a clear posture of a pinch that is deeper than the one near its deepest minima."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from rtee.extract.collision_free import GOOD, SearchBudget, clear_postures
from rtee.extract.collisions import CollisionChecker
from rtee.extract.goals import GoalFunction
from rtee.extract.motion import MotionBounds
from rtee.extract.ranking import Candidate
from rtee.extract.search import fresh_minima
from rtee.sample import FloatArray

_LOOKED: Final = 8
"""Maximum number of deep postures that are checked for being clear as they are."""

_GAIN: Final = 0.001
_GAIN_OF_NEW: Final = 0.01
"""Shares by which a clear posture must be deeper than the known one to take its place: one from
known minima, and one from new points."""

_PROMISING: Final = 0.98
"""Share of the depth of a known clear posture that a start must have: pushed out of its collisions
and improved, it seldom gains more."""

_FAR: Final = 0.9
"""Share of the greatest depth up to which a clear posture is worth a search from new points."""


@dataclass(frozen=True, slots=True)
class ClearElsewhere:
    """Further searches for clear postures, after the one that starts from the deepest minima.

    That one takes the constraints of the deepest minima along; other minima may need none, or lead
    to deeper postures. All minima may lie in a few valleys with other links in the way of each, so
    that the last search starts from new points.

    Attributes:
        function: The goal over the space of the search.
        motion: Bounds on the motion of links.
        checker: The links that must not collide.
        measure: Returns a posture as stored ``(n,)`` with its evidence.
        budget: Limits of each search.
        left_out: Numbers of the deepest minima that searches leave out, one after the other.
    """

    function: GoalFunction
    motion: MotionBounds
    checker: CollisionChecker
    measure: Callable[[FloatArray], Candidate]
    budget: SearchBudget
    left_out: Sequence[int]

    def deeper(
        self,
        known: Sequence[Candidate],
        postures: Sequence[FloatArray],
        minima: Sequence[FloatArray],
    ) -> list[Candidate]:
        """Return the deepest clear posture, if it is deeper than the known ones.

        Ends as soon as a clear posture is nearly the deepest.

        Args:
            known: The deepest posture, clear or not, and those that were found so far.
            postures: Deep postures, as stored, to check as they are, the deepest first.
            minima: Coordinates ``(k,)`` of the minima, the deepest first.
        """
        found, good = list[Candidate](), GOOD * known[0].gap
        least = min((c.gap for c in known if c.usable), default=math.inf)
        # Over a single coordinate, the first search has found all clear postures.
        if self.function.space.size <= 1:
            return found

        def improve(gain: float, places: Iterable[FloatArray]) -> None:
            nonlocal found, least
            for candidate in map(self.measure, places):
                if candidate.usable and candidate.gap < (1.0 + gain) * least:
                    found, least = [candidate], candidate.gap
                    break

        if least > good:
            deep = postures[:_LOOKED]
            improve(_GAIN, (u for u in deep if self._value(u) < least and self._clear(u)))
        for left_out in self.left_out:
            if least > good:
                improve(_GAIN, self._search(minima[left_out:], _PROMISING * least))
        if least > _FAR * known[0].gap:
            floor = (1.0 + _GAIN_OF_NEW) * least
            starts = fresh_minima(self.function)
            improve(_GAIN_OF_NEW, self._search(starts, floor))
        return found

    def _search(self, starts: Sequence[FloatArray], floor: float) -> list[FloatArray]:
        function, motion, checker, budget = self.function, self.motion, self.checker, self.budget
        return clear_postures(function, motion, checker, starts, budget, floor=floor)[:1]

    def _value(self, u: FloatArray) -> float:
        return self.function.value(self.function.space.coordinates(u))

    def _clear(self, u: FloatArray) -> bool:
        checker = self.checker
        return not checker.at(u) and checker.blocked(u) is None and self.function.touching(u)
