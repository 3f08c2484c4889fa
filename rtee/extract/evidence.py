"""What is recorded about a pinch, measured at the posture as it is stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.actions.types import Evidence, Posture
from rtee.extract.collisions import Collisions, first_contact
from rtee.extract.motion import Motion
from rtee.extract.opposition import opposition
from rtee.extract.scene import LinkPair, Scene
from rtee.hand.model import Hand
from rtee.types import FloatArray

DECIMALS: Final = 6
"""Postures are stored rounded to a millionth of a radian or metre."""

_DIGITS: Final = 9
"""Lengths in the evidence are rounded to a nanometre, unit vectors and angles likewise."""


@dataclass(frozen=True)
class Inspector:
    """Measures postures.

    Attributes:
        scene: The hand's links.
        motion: Bounds on their motion.
        collisions: What may not collide.
    """

    scene: Scene
    motion: Motion
    collisions: Collisions

    @classmethod
    def of(cls, hand: Hand) -> Inspector:
        """Return the inspector of a hand.

        Raises:
            ModelError: A mesh is missing or cannot be read.
        """
        scene = Scene(hand)
        motion = Motion(scene)
        return cls(scene, motion, Collisions(scene, motion))

    def pinch(self, u: FloatArray, tips: LinkPair, others: Sequence[LinkPair]) -> Evidence:
        """Return the evidence of a pinch.

        Args:
            u: The posture as stored ``(n,)``.
            tips: The two tips, the first element's first.
            others: The pairs of links that must not collide.
        """
        scene = self.scene
        way = self.motion.way(u)
        blocked = self.collisions.along(way, others)
        colliding = self.collisions.at(u, others)
        scene.place(u)
        touching = scene.touching(tips)
        witness = scene.witness(tips) if touching else scene.exact_witness(tips)
        points = [scene.origin(link) for link in tips.links]
        opposed = opposition(scene, tips, witness, u - scene.hand.rest)
        contact_at = None
        if touching:
            contact_at = first_contact(scene, tips, way, 0.0, 1.0, self.motion.speed(tips, way))
        return Evidence(
            depth=_round(max(0.0, -witness.distance)) if touching else 0.0,
            distance=0.0 if touching else _round(max(0.0, witness.distance)),
            frame_distance=_round(float(np.linalg.norm(points[1] - points[0]))),
            point=_triple((witness.first + witness.second) / 2.0),
            normal=_triple(witness.normal),
            clear=not colliding,
            path_clear=not blocked,
            colliding=tuple(pair.links for pair in colliding),
            contact_at=None if contact_at is None else _round(contact_at),
            opposition=opposed,
        )


def rounded(hand: Hand, u: FloatArray) -> FloatArray:
    """Return a posture as it is stored: rounded, but never out of the limits."""
    result = np.round(u, DECIMALS) + 0.0
    for i, spec in enumerate(hand.actuators):
        if u[i] == spec.rest:
            result[i] = spec.rest
        result[i] = min(max(result[i], spec.lower), spec.upper)
    return result


def posture_of(hand: Hand, u: FloatArray, involved: Sequence[str]) -> Posture:
    """Return actuator positions as a posture."""
    values = dict(zip(hand.actuator_names, u.tolist(), strict=True))
    return Posture(values, tuple(name for name in hand.actuator_names if name in involved))


def _round(value: float) -> float:
    return round(value, _DIGITS) + 0.0


def _triple(vector: FloatArray) -> tuple[float, float, float]:
    x, y, z = (_round(float(v)) for v in vector)
    return x, y, z
