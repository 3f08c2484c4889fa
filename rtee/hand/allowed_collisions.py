"""Which pairs of links need never be checked for collision, and why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import coal
import numpy as np
import pinocchio as pin

from rtee.hand.geometry import HandGeometry
from rtee.hand.halton import halton
from rtee.hand.model import Hand
from rtee.types import FloatArray

ADJACENT: Final = "adjacent"
ALWAYS: Final = "touching at every configuration"
AT_REST: Final = "touching at rest"

_CONFIGURATIONS: Final = 64
"""Postures compared before two links count as touching at every one."""


@dataclass(frozen=True, slots=True)
class TouchingPair:
    """Two links that need not be checked for collision.

    Attributes:
        link1: The first link.
        link2: The second link.
        reason: ``adjacent``, ``touching at every configuration`` or ``touching at rest``.
    """

    link1: str
    link2: str
    reason: str


def touching_pairs(hand: Hand) -> tuple[TouchingPair, ...]:
    """Find the pairs of links whose contact says nothing about a posture.

    Adjacent links are joined by one moving joint. The others are compared on the exact geometry at
    rest, and those that touch there at configurations spread evenly over the actuators' limits.
    Two fingertips are no such pair unless they are adjacent: their contact is a pinch.

    Raises:
        ModelError: A mesh cannot be read.
    """
    checker = _Checker(hand)
    tips = {finger.tip for finger in hand.fingers}
    pairs = []
    for link1, link2 in combinations(checker.links, 2):
        relation = checker.relation(link1, link2)
        if relation == "joined":
            pairs.append(TouchingPair(link1, link2, ADJACENT))
        elif (
            relation == "apart"
            and not {link1, link2} <= tips
            and checker.at(hand.rest, link1, link2)
        ):
            always = all(checker.at(u, link1, link2) for u in _spread(hand))
            pairs.append(TouchingPair(link1, link2, ALWAYS if always else AT_REST))
    return tuple(pairs)


def touch_at_rest(hand: Hand) -> Callable[[str, str], bool]:
    """Return a function that says whether two links touch at rest, on the exact geometry.

    Raises:
        ModelError: A mesh cannot be read.
    """
    checker = _Checker(hand)
    return lambda link1, link2: checker.at(hand.rest, link1, link2)


class _Checker:
    """Exact contact of links at a posture."""

    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        self.geometry = HandGeometry(hand)
        self.kinematics = self.geometry.kinematics
        self.links = tuple(dict.fromkeys(shape.link for shape in self.geometry.shapes))
        self.request = coal.CollisionRequest()

    def relation(self, link1: str, link2: str) -> str:
        """Return whether links are ``fixed`` together, ``joined`` by one joint, or ``apart``."""
        first, second = self.kinematics.body(link1), self.kinematics.body(link2)
        if first == second:
            return "fixed"
        parents = self.kinematics.model.parents
        return "joined" if parents[first] == second or parents[second] == first else "apart"

    def at(self, u: FloatArray, link1: str, link2: str) -> bool:
        """Return whether two links touch at a posture."""
        poses = self.kinematics.placements(u)
        return any(
            self._touch(i, j, poses[link1], poses[link2])
            for i in self.geometry.of_link(link1)
            for j in self.geometry.of_link(link2)
        )

    def _touch(self, i: int, j: int, pose1: FloatArray, pose2: FloatArray) -> bool:
        first, second = self.geometry.shapes[i], self.geometry.shapes[j]
        result = coal.CollisionResult()
        coal.collide(
            first.exact,
            _transform(pin.SE3(pose1) * first.in_link),
            second.exact,
            _transform(pin.SE3(pose2) * second.in_link),
            self.request,
            result,
        )
        return bool(result.isCollision())


def _transform(pose: pin.SE3) -> coal.Transform3s:
    return coal.Transform3s(pose.rotation, pose.translation)


def _spread(hand: Hand) -> list[FloatArray]:
    """Return postures all over the limits: at the lower, at the upper, then a Halton sequence."""
    lower = np.where(np.isfinite(hand.lower), hand.lower, -np.pi)
    upper = np.where(np.isfinite(hand.upper), hand.upper, np.pi)
    corners = np.array([np.zeros_like(lower), np.ones_like(lower)])
    fractions = np.vstack([corners, halton(len(lower), _CONFIGURATIONS - len(corners))])
    return list(lower + fractions * (upper - lower))
