"""What is recorded about a pinch, measured at the posture as it is stored."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.actions.types import Evidence, Posture
from rtee.extract.collisions import CRAMPED, Collisions, Watch, first_contact
from rtee.extract.goals import Link, linked
from rtee.extract.motion import Motion
from rtee.extract.opposition import opposition
from rtee.extract.pairs import LinkPair
from rtee.extract.ranking import Candidate
from rtee.extract.scene import Scene
from rtee.hand.linalg import norm
from rtee.hand.model import Hand
from rtee.types import FloatArray

_DIGITS: Final = 9
"""Lengths in the evidence are rounded to a nanometre, unit vectors and angles likewise."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What else is near a posture and its way.

    Attributes:
        pose: Part of their room that all other links keep in the posture: 1, a quarter, or 0.
        way: The same of the posture and the straight way to it.
        colliding: Pairs of links that touch in the posture.
        clearance: The least distance of other links [m], on the way, too, where that is clear;
            ``None`` where the posture is not clear.
    """

    pose: float
    way: float
    colliding: tuple[tuple[str, str], ...]
    clearance: float | None


def surroundings(scene: Scene, u: FloatArray, watch: Watch) -> Surroundings:
    """Return what else is near a posture.

    Args:
        scene: The hand's links.
        u: The posture as stored ``(n,)``.
        watch: The links that must not come near each other.
    """
    pose = way = 0.0
    near: list[LinkPair] = []
    for share, watched in ((1.0, watch), (CRAMPED, watch.cramped)):
        near = watched.at(u)
        pose = pose or (0.0 if near else share)
        if not near and watched.along(u) is None:
            way = share
            break
    scene.place(u)
    colliding = tuple(pair.links for pair in near if scene.touching(pair))
    clearance = _round(watch.clearance(u, way=way > 0.0)) if pose else None
    return Surroundings(pose, way, colliding, clearance)


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

    def pinch(self, u: FloatArray, tips: LinkPair, watch: Watch) -> Candidate:
        """Return a pinch with its evidence.

        Args:
            u: The posture as stored ``(n,)``.
            tips: The two tips, the first element's first.
            watch: The links that must not collide.
        """
        scene = self.scene
        way = self.motion.way(u)
        around = surroundings(scene, u, watch)
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
        found = Evidence(
            depth=_round(max(0.0, -witness.distance)) if touching else 0.0,
            distance=0.0 if touching else _round(max(0.0, witness.distance)),
            frame_distance=_round(norm(points[1] - points[0])),
            point=_triple((witness.first + witness.second) / 2.0),
            normal=_triple(witness.normal),
            clear=around.pose > 0.0,
            path_clear=around.way > 0.0,
            clearance=around.clearance,
            colliding=around.colliding,
            contact_at=None if contact_at is None else _round(contact_at),
            opposition=opposed,
        )
        return Candidate(u, found, around.way)

    def multi_pinch(
        self, u: FloatArray, names: Sequence[str], links: Sequence[Link], watch: Watch
    ) -> Candidate:
        """Return a multi-pinch with its evidence.

        Args:
            u: The posture as stored ``(n,)``.
            names: The fingers.
            links: The pairs of tips that may touch.
            watch: The links that must not collide.
        """
        scene = self.scene
        way = self.motion.way(u)
        around = surroundings(scene, u, watch)
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
        evidence = Evidence(
            depth=_round(sum(depths)),
            point=_triple(np.mean(middles, axis=0)) if middles else None,
            clear=around.pose > 0.0,
            path_clear=around.way > 0.0,
            clearance=around.clearance,
            colliding=around.colliding,
            contact_at=None if contact_at is None else _round(contact_at),
            pairs=tuple(
                (names[link.ends[0]], names[link.ends[1]], _round(depth))
                for (link, _), depth in zip(found, depths, strict=True)
            ),
        )
        return Candidate(u, evidence, around.way)


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
