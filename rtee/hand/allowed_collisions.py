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
"""Number of postures at which two links must touch to count as always touching: links that separate
at all do so in a large part of their range."""


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
    """Find the pairs of links whose contact is no collision.

    Adjacent links are connected by one moving joint. Other pairs are checked with the exact
    geometry at rest and, if they touch there, at postures spread evenly over the actuators' limits.
    Two fingertips are such a pair only if they are adjacent; otherwise their contact is a pinch.

    Raises:
        ModelError: A mesh cannot be read.
    """
    geometry = HandGeometry(hand)
    kinematics = geometry.kinematics
    parents, tips = kinematics.model.parents, hand.tip_links
    at_rest, spread = kinematics.placements(hand.rest), _spread(hand)
    pairs = []
    for links in combinations(dict.fromkeys(shape.link for shape in geometry.shapes), 2):
        first, second = (kinematics.body(link) for link in links)
        # Links of the same rigid body do not move relative to each other.
        if first == second:
            continue
        if parents[first] == second or parents[second] == first:
            pairs.append(AllowedCollision(*links, ADJACENT))
            continue
        if links[0] in tips and links[1] in tips:
            continue
        sides = geometry.of_links(links[0]), geometry.of_links(links[1])
        if geometry.touching(sides, at_rest):
            # Only pairs that touch at rest are checked at other postures, since each check of
            # meshes is expensive.
            always = all(geometry.touching(sides, kinematics.placements(u)) for u in spread)
            pairs.append(AllowedCollision(*links, ALWAYS if always else AT_REST))
    return tuple(pairs)


def touch_at_rest(hand: Hand) -> Callable[[str, str], bool]:
    """Return a function that checks whether two links touch at rest, with the exact geometry.

    Raises:
        ModelError: A mesh cannot be read.
    """
    geometry = HandGeometry(hand)
    poses = geometry.kinematics.placements(hand.rest)
    of_links = geometry.of_links
    return lambda link1, link2: geometry.touching((of_links(link1), of_links(link2)), poses)


def _spread(hand: Hand) -> list[FloatArray]:
    """Return postures within the limits: the lower and the upper ones, then a Halton sequence."""
    # One turn covers all postures of a joint without limits.
    lower = np.where(np.isfinite(hand.lower), hand.lower, -np.pi)
    upper = np.where(np.isfinite(hand.upper), hand.upper, np.pi)
    corners = np.array([np.zeros_like(lower), np.ones_like(lower)])
    fractions = np.vstack([corners, halton(len(lower), _CONFIGURATIONS - len(corners))])
    return list(lower + fractions * (upper - lower))
