"""Find the pairs of links that need never be checked for collision, and why."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np

from rtee.hand.geometry import HandGeometry
from rtee.hand.halton import halton
from rtee.hand.model import Hand
from rtee.sample import FloatArray

ADJACENT: Final = "adjacent"
ALWAYS: Final = "touching at every configuration"
AT_REST: Final = "touching at rest"

_CONFIGURATIONS: Final = 64
"""Postures compared before two links count as touching at every one: a link pair that comes apart
anywhere does so in a good part of its range."""


class AllowedCollision(NamedTuple):
    """Two links that need not be checked for collision.

    Attributes:
        link1: The first link.
        link2: The second link.
        reason: ``adjacent``, ``touching at every configuration`` or ``touching at rest``.
    """

    link1: str
    link2: str
    reason: str


def allowed_collisions(hand: Hand) -> tuple[AllowedCollision, ...]:
    """Find the pairs of links whose contact says nothing about a posture.

    Adjacent links are joined by one moving joint. The others are compared on the exact geometry at
    rest, and those that touch there at configurations spread evenly over the actuators' limits.
    Two fingertips are such a pair only if they are adjacent: otherwise their contact is a pinch.

    Raises:
        ModelError: A mesh cannot be read.
    """
    geometry = HandGeometry(hand)
    kinematics = geometry.kinematics
    parents, tips = kinematics.model.parents, {finger.tip for finger in hand.fingers}
    at_rest, spread = kinematics.placements(hand.rest), _spread(hand)
    pairs = []
    for links in combinations(dict.fromkeys(shape.link for shape in geometry.shapes), 2):
        first, second = (kinematics.body(link) for link in links)
        # Links of one rigid body never move against each other.
        if first == second:
            continue
        if parents[first] == second or parents[second] == first:
            pairs.append(AllowedCollision(*links, ADJACENT))
        elif not tips.issuperset(links) and geometry.touching(links, at_rest):
            # Only those that touch at rest are compared further: each posture costs a query of
            # meshes.
            always = all(geometry.touching(links, kinematics.placements(u)) for u in spread)
            pairs.append(AllowedCollision(*links, ALWAYS if always else AT_REST))
    return tuple(pairs)


def touch_at_rest(hand: Hand) -> Callable[[str, str], bool]:
    """Return a function that says whether two links touch at rest, on the exact geometry.

    Raises:
        ModelError: A mesh cannot be read.
    """
    geometry = HandGeometry(hand)
    poses = geometry.kinematics.placements(hand.rest)
    return lambda link1, link2: geometry.touching((link1, link2), poses)


def _spread(hand: Hand) -> list[FloatArray]:
    """Return postures all over the limits: at the lower, at the upper, then a Halton sequence."""
    # A joint without limits: one turn has all of its postures.
    lower = np.where(np.isfinite(hand.lower), hand.lower, -np.pi)
    upper = np.where(np.isfinite(hand.upper), hand.upper, np.pi)
    corners = np.array([np.zeros_like(lower), np.ones_like(lower)])
    fractions = np.vstack([corners, halton(len(lower), _CONFIGURATIONS - len(corners))])
    return list(lower + fractions * (upper - lower))
