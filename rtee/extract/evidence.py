"""What is recorded about a pinch, measured at the posture as it is stored."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.actions.types import Evidence, Posture
from rtee.extract.collisions import Collisions, Watch, first_contact
from rtee.extract.goals import Link, linked
from rtee.extract.motion import Motion
from rtee.extract.opposition import opposition
from rtee.extract.pairs import LinkPair
from rtee.extract.scene import Scene
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

    def multi_pinch(
        self, u: FloatArray, names: Sequence[str], links: Sequence[Link], watch: Watch
    ) -> Evidence:
        """Return the evidence of a multi-pinch.

        Args:
            u: The posture as stored ``(n,)``.
            names: The fingers.
            links: The pairs of tips that may touch.
            watch: The links that must not collide.
        """
        scene = self.scene
        way = self.motion.way(u)
        colliding = watch.at(u)
        free = not colliding and watch.along(u) is None
        scene.place(u)
        touching = [link for link in links if scene.touching(link.tips)]
        found = [(link, scene.witness(link.tips)) for link in touching]
        depths = [max(0.0, -witness.distance) for _, witness in found]
        middles = [(witness.first + witness.second) / 2.0 for _, witness in found]
        firsts = [
            (link.ends, first_contact(scene, link.tips, way, self.motion.speed(link.tips, way)))
            for link in touching
        ]
        contact_at = _linked_at(len(names), firsts)
        return Evidence(
            depth=_round(sum(depths)),
            point=_triple(np.mean(middles, axis=0)) if middles else None,
            clear=not colliding,
            path_clear=free,
            colliding=tuple(pair.links for pair in colliding),
            contact_at=None if contact_at is None else _round(contact_at),
            pairs=tuple(
                (names[link.ends[0]], names[link.ends[1]], _round(depth))
                for (link, _), depth in zip(found, depths, strict=True)
            ),
        )


def _linked_at(size: int, firsts: Sequence[tuple[tuple[int, int], float | None]]) -> float | None:
    """Return the least intensity up to which contacts have linked all tips."""
    known = sorted((at, edge) for edge, at in firsts if at is not None)
    for i, (at, _) in enumerate(known):
        if linked(size, [edge for _, edge in known[: i + 1]]):
            return at
    return None


def posture_of(hand: Hand, u: FloatArray, involved: Collection[str]) -> Posture:
    """Return actuator positions as a posture."""
    values = dict(zip(hand.actuator_names, u.tolist(), strict=True))
    return Posture(values, tuple(name for name in hand.actuator_names if name in involved))


def _round(value: float) -> float:
    return round(value, _DIGITS) + 0.0


def _triple(vector: FloatArray) -> tuple[float, float, float]:
    x, y, z = (_round(float(v)) for v in vector)
    return x, y, z
