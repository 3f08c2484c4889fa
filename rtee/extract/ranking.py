"""Which posture of a pinch comes first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from rtee.actions.types import Evidence, PrimitiveKind
from rtee.types import FloatArray

Rank = Literal["depth", "opposition"]

_SAME: Final = 0.01
"""Postures that differ by less in every actuator are one [rad | m]."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A posture with what was measured there.

    Attributes:
        u: Actuator positions as stored ``(n,)`` [rad | m].
        evidence: The evidence.
    """

    u: FloatArray
    evidence: Evidence

    @property
    def usable(self) -> bool:
        """Whether nothing else collides, neither there nor on the way."""
        return self.evidence.clear and self.evidence.path_clear


@dataclass(frozen=True, slots=True)
class Found:
    """A pinch that was found.

    Attributes:
        kind: Tight, loose or of several.
        fingers: The fingers.
        candidates: Its postures, the best first.
    """

    kind: PrimitiveKind
    fingers: tuple[str, ...]
    candidates: tuple[Candidate, ...]

    @property
    def best(self) -> Candidate:
        """The posture that is executed."""
        return self.candidates[0]


def ranked(candidates: Sequence[Candidate], rank: Rank) -> tuple[Candidate, ...]:
    """Return distinct candidates, the best first.

    Those with a clear pose and a clear way come first, then those with a clear pose; among them the
    deepest, or with rank ``opposition`` those in force closure and then the one whose worse angle
    is least.
    """
    kept: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda c: _key(c, rank)):
        if all(np.abs(candidate.u - other.u).max() > _SAME for other in kept):
            kept.append(candidate)
    return tuple(kept)


def _key(candidate: Candidate, rank: Rank) -> tuple[float, ...]:
    evidence = candidate.evidence
    depth = evidence.distance - evidence.depth
    head = (not candidate.usable, not evidence.clear)
    opposed = evidence.opposition
    if rank == "depth":
        return (*head, depth)
    if opposed is None:
        return (*head, True, np.inf, depth)
    return (*head, not opposed.force_closure, max(opposed.angles), depth)
