"""Measurement of the evidence for a pinch, at the posture rounded as stored."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np

from rtee.actions.types import Evidence, Opposition, Posture
from rtee.extract.collisions import (
    REDUCED,
    CollisionChecker,
    Collisions,
    PinchClosing,
    first_contact,
    linked_at,
)
from rtee.extract.goals import TipEdge
from rtee.extract.motion import MotionBounds
from rtee.extract.opposition import opposition
from rtee.extract.pairs import LinkPair
from rtee.extract.ranking import Candidate
from rtee.extract.scene import Scene
from rtee.hand.linalg import norm
from rtee.hand.model import Finger, Hand
from rtee.sample import FloatArray

_DIGITS: Final = 9
"""Decimals of the evidence: lengths to a nanometre, far below the accuracy of models."""


def _surroundings(scene: Scene, u: FloatArray, checker: CollisionChecker) -> Candidate:
    """Return a posture with the evidence about other links there and on the straight path to it."""
    pose = path = 0.0
    near: list[LinkPair] = []
    for share, applied in ((1.0, checker), (REDUCED, checker.reduced)):
        near = applied.at(u)
        # Try the full margin before the reduced one.
        pose = pose or (0.0 if near else share)
        blocked = None if near else applied.blocked(u)
        if not near and blocked is None:
            path = share
            break
    scene.place(u)
    colliding = tuple(pair.links for pair in near if scene.touching(pair))
    clearance = _round(checker.clearance(u, path=path > 0.0)) if pose else None
    clear, path_clear = pose > 0.0, path > 0.0
    return Candidate(
        u,
        Evidence(clear=clear, path_clear=path_clear, clearance=clearance, colliding=colliding),
        path,
        None if blocked is None else blocked.pair.links,
    )


@dataclass(frozen=True)
class Inspector:
    """Measures the evidence for postures."""

    scene: Scene
    motion: MotionBounds
    collisions: Collisions

    @classmethod
    def of(cls, hand: Hand, unit: float = 1.0) -> Inspector:
        """Return the inspector of a hand.

        Args:
            hand: The hand.
            unit: Length in this hand that represents one metre of the original hand [m].

        Raises:
            ModelError: A mesh is missing or cannot be read.
        """
        scene = Scene(hand, unit)
        motion = MotionBounds(scene)
        return cls(scene, motion, Collisions(scene, motion))

    def checker(self, fingers: Sequence[Finger], edges: Sequence[TipEdge]) -> CollisionChecker:
        """Return a checker of the links that fingers move, except tips that should touch."""
        hand = self.scene.hand
        # Include actuators shared with other fingers, which move in the pinch, too.
        moving = {hand.actuator_index(n) for finger in fingers for n in finger.actuators}
        kinematics = self.scene.kinematics
        links = [
            [hand.finger(hand.tip_links[tip]).tip_links for tip in edge.tips.links]
            for edge in edges
        ]
        closing = PinchClosing(
            tuple(kinematics.body(str(finger.tip)) for finger in fingers),
            tuple(edges),
            tuple(frozenset(map(kinematics.body, finger.bars)) for finger in fingers),
        )
        meeting = (frozenset(pair) for both in links for pair in product(*both))
        return self.collisions.checker(moving, meeting, closing)

    def pinch(self, u: FloatArray, tips: LinkPair, checker: CollisionChecker) -> Candidate:
        """Return a pinch with its evidence.

        Args:
            u: The posture as stored ``(n,)``.
            tips: The two tips, in the order of the pinch's elements.
            checker: The links that must not collide.
        """
        scene = self.scene
        path = self.motion.path_to(u)
        around = _surroundings(scene, u, checker)
        scene.place(u)
        touching = scene.touching(tips)
        # The depth of touching tips is defined only between their convex parts.
        witness = scene.witness(tips) if touching else scene.exact_witness(tips)
        points = [scene.origin(link) for link in tips.links]
        contact_at = None
        meeting = witness
        if touching:
            contact_at = first_contact(scene, tips, path, self.motion.speed(tips, path))
            scene.place(path.at(1.0 if contact_at is None else contact_at))
            meeting = scene.witness(tips)
        opposed = opposition(scene, tips, meeting, u - scene.hand.rest)
        evidence = replace(
            around.evidence,
            depth=_round(max(0.0, -witness.distance)) if touching else 0.0,
            distance=0.0 if touching else _round(max(0.0, witness.distance)),
            frame_distance=_round(norm(points[1] - points[0])),
            point=_triple((witness.first + witness.second) / 2.0),
            normal=_triple(witness.normal),
            contact_at=None if contact_at is None else _round(contact_at),
            opposition=None if opposed is None else _as_stored(opposed),
        )
        return replace(around, evidence=evidence)

    def multi_pinch(
        self,
        u: FloatArray,
        names: Sequence[str],
        edges: Sequence[TipEdge],
        checker: CollisionChecker,
    ) -> Candidate:
        """Return a pinch of several tips with its evidence, at a posture as stored ``(n,)``."""
        scene = self.scene
        path = self.motion.path_to(u)
        around = _surroundings(scene, u, checker)
        scene.place(u)
        touching = [edge for edge in edges if scene.touching(edge.tips)]
        witnesses = [scene.witness(edge.tips) for edge in touching]
        depths = [max(0.0, -witness.distance) for witness in witnesses]
        middles = [(witness.first + witness.second) / 2.0 for witness in witnesses]
        firsts = [
            (edge.ends, first_contact(scene, edge.tips, path, self.motion.speed(edge.tips, path)))
            for edge in touching
        ]
        contact_at = linked_at(len(names), firsts)
        evidence = replace(
            around.evidence,
            depth=_round(sum(depths)),
            point=_triple(np.mean(middles, axis=0)) if middles else None,
            contact_at=None if contact_at is None else _round(contact_at),
            pairs=tuple(
                (names[edge.ends[0]], names[edge.ends[1]], _round(depth))
                for edge, depth in zip(touching, depths, strict=True)
            ),
        )
        return replace(around, evidence=evidence)


def as_posture(hand: Hand, u: FloatArray, involved: Collection[str]) -> Posture:
    """Return actuator positions ``(n,)`` [rad | m] as a posture."""
    values = dict(zip(hand.actuator_names, u.tolist(), strict=True))
    return Posture(values, tuple(name for name in hand.actuator_names if name in involved))


def _round(value: float) -> float:
    # Adding 0 turns -0.0 into 0.0, which reads better in files.
    return round(value, _DIGITS) + 0.0


def _as_stored(opposition: Opposition) -> Opposition:
    one, other = opposition.angles
    return replace(opposition, angles=(_round(one), _round(other)))


def _triple(vector: FloatArray) -> tuple[float, float, float]:
    x, y, z = (_round(float(v)) for v in vector)
    return x, y, z
