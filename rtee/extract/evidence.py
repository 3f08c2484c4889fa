"""What is recorded about a pinch, measured at the posture as it is stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.actions.types import Evidence, Posture
from rtee.extract.collisions import Collisions, Watch, first_contact
from rtee.extract.motion import Motion
from rtee.extract.opposition import opposition
from rtee.extract.scene import LinkPair, Scene
from rtee.hand.model import Hand
from rtee.types import FloatArray

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

    def pinch(self, u: FloatArray, tips: LinkPair, watch: Watch) -> Evidence:
        """Return the evidence of a pinch.

        Args:
            u: The posture as stored ``(n,)``.
            tips: The two tips, the first element's first.
            watch: The links that must not collide.
        """
        scene = self.scene
        way = self.motion.way(u)
        colliding = watch.at(u)
        free = not colliding and watch.along(u) is None
        scene.place(u)
        touching = scene.touching(tips)
        witness = scene.witness(tips) if touching else scene.exact_witness(tips)
        points = [scene.origin(link) for link in tips.links]
        contact_at = None
        meeting = witness
        if touching:
            contact_at = first_contact(scene, tips, way, self.motion.speed(tips, way))
            scene.place(way.at(1.0 if contact_at is None else contact_at))
            meeting = scene.witness(tips)
        opposed = opposition(scene, tips, meeting, u - scene.hand.rest)
        return Evidence(
            depth=_round(max(0.0, -witness.distance)) if touching else 0.0,
            distance=0.0 if touching else _round(max(0.0, witness.distance)),
            frame_distance=_round(float(np.linalg.norm(points[1] - points[0]))),
            point=_triple((witness.first + witness.second) / 2.0),
            normal=_triple(witness.normal),
            clear=not colliding,
            path_clear=free,
            colliding=tuple(pair.links for pair in colliding),
            contact_at=None if contact_at is None else _round(contact_at),
            opposition=opposed,
        )


def posture_of(hand: Hand, u: FloatArray, involved: Sequence[str]) -> Posture:
    """Return actuator positions as a posture."""
    values = dict(zip(hand.actuator_names, u.tolist(), strict=True))
    return Posture(values, tuple(name for name in hand.actuator_names if name in involved))


def _round(value: float) -> float:
    return round(value, _DIGITS) + 0.0


def _triple(vector: FloatArray) -> tuple[float, float, float]:
    x, y, z = (_round(float(v)) for v in vector)
    return x, y, z
