"""Ranking of the postures of a pinch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from rtee.actions.types import Evidence, PrimitiveKind
from rtee.extract.space import real_limits
from rtee.hand.model import Hand
from rtee.sample import FloatArray

Rank = Literal["depth", "opposition"]

_SAME: Final = 0.02
"""Largest difference in each actuator, as a share of its range, of postures that may be equal."""

_AS_GOOD: Final = 0.01
"""Largest difference of the depths or distances of equal postures, as a share."""

_DIGITS: Final = 5
"""Decimals for comparing depths [m]: 10 µm, finer than models match real hands."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A posture with its evidence.

    Attributes:
        u: Actuator positions as stored ``(n,)`` [rad | m].
        evidence: The evidence.
        margin: Share of the margins that other links keep in the posture and on the path to it: 1,
            a quarter, or 0 if the posture or the path is not clear.
        blocking: The links that collide first on a path that is not clear, to a posture that is.
    """

    u: FloatArray
    evidence: Evidence
    margin: float
    blocking: tuple[str, str] | None = None

    @property
    def gap(self) -> float:
        """Distance between the tips, or minus their depth [m]."""
        return self.evidence.distance - self.evidence.depth

    @property
    def usable(self) -> bool:
        """Whether all other links keep their full margin, in the posture and on the path."""
        return self.margin == 1.0


@dataclass(frozen=True, slots=True)
class FoundPinch:
    """A pinch found by a search.

    Attributes:
        kind: Tight, loose, or of several tips.
        fingers: The fingers.
        candidates: The postures of the pinch, the best first.
    """

    kind: PrimitiveKind
    fingers: tuple[str, ...]
    candidates: tuple[Candidate, ...]


def ranked(hand: Hand, candidates: Sequence[Candidate], rank: Rank) -> tuple[Candidate, ...]:
    """Return distinct candidates, the best first.

    Candidates with a clear pose and path come first, those with full margins before those with
    reduced ones; then candidates with only a clear pose. Among equals, rank ``depth`` puts the
    deepest first; rank ``opposition`` puts those in force closure first, ordered by the larger of
    their two angles. Depths that agree to 10 µm are equal; the better opposed then comes first.
    """
    lower, upper = real_limits(hand)
    kept: list[Candidate] = []
    # The best first, so that of equal postures the best one is kept.
    for candidate in sorted(candidates, key=lambda c: _key(c, rank)):
        if not any(_alike(candidate, other, upper - lower) for other in kept):
            kept.append(candidate)
    return tuple(kept)


def _alike(one: Candidate, other: Candidate, extent: FloatArray) -> bool:
    near = bool((np.abs(one.u - other.u) <= _SAME * extent).all())
    a, b = one.gap, other.gap
    return near and abs(a - b) <= _AS_GOOD * max(abs(a), abs(b))


def _key(candidate: Candidate, rank: Rank) -> tuple[float, ...]:
    evidence = candidate.evidence
    # False sorts before True, and larger margins first.
    head = (-candidate.margin, not evidence.clear)
    opposed = evidence.opposition
    opposition = (
        (True, math.inf) if opposed is None else (not opposed.force_closure, max(opposed.angles))
    )
    if rank == "depth":
        return (*head, round(candidate.gap, _DIGITS), *opposition)
    return (*head, *opposition, candidate.gap)
