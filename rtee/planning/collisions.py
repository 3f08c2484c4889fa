"""Collisions of a hand with itself or the object, in the postures of a planner's grasp."""

from __future__ import annotations

from collections.abc import Collection
from itertools import combinations
from typing import Final

import numpy as np

from rtee.hand.geometry import HandGeometry
from rtee.hand.model import Hand
from rtee.planning.distance_bounds import DistanceBounds
from rtee.planning.grasp_solution import Collision
from rtee.planning.objects import GraspObject
from rtee.planning.scene import GraspScene
from rtee.sample import FloatArray

OBJECT: Final = "object"
"""Name of the object, instead of a link, in a collision."""

_DEPTH: Final = 1e-3
"""Depth beyond which links overlap [m]: the accuracy of models."""

_PRESSED: Final = 3e-3
"""Deepest allowed penetration of a fingertip into the object or another fingertip [m]: the error of
a contact, and the give of a soft pad."""


class GraspCollisions:
    """Checks a hand for collisions, at one posture after another.

    Links count as their convex parts first; a pair that overlaps deeper than at rest is compared on
    the geometry as given, so that what is inside of a hollow palm does not collide. Adjacent links,
    pairs that touch at rest and pairs that the SRDF disables are left out. The time is bounded:
    each pair of links is checked once per posture.

    Args:
        hand: The hand.
        geometry: Its geometry.
        obj: The object, or another obstacle, if there is one.
        pose: Its pose ``(4, 4)`` in the hand's base frame.
    """

    def __init__(
        self,
        hand: Hand,
        geometry: HandGeometry,
        obj: GraspObject | None = None,
        pose: FloatArray | None = None,
    ) -> None:
        self._hand, self._geometry = hand, geometry
        kinematics = geometry.kinematics
        parents = kinematics.model.parents
        # Sets, since an SRDF names the two links of a pair in any order.
        disabled = {frozenset((a, b)) for a, b, _ in hand.disabled_collisions}
        self._pairs = []
        for links in combinations(dict.fromkeys(shape.link for shape in geometry.shapes), 2):
            first, second = (kinematics.body(link) for link in links)
            # Links that a fixed joint connects are one body.
            adjacent = first == second or second == parents[first] or first == parents[second]
            if not adjacent and frozenset(links) not in disabled:
                self._pairs.append(links)
        self._tips = hand.tip_links
        self._at_rest = kinematics.placements(np.array(hand.rest))
        self._scene = None if obj is None else GraspScene(hand, obj, geometry)
        self._pose = np.eye(4) if pose is None else pose

    def at(
        self, u: FloatArray, fingers: Collection[str] = (), posture: str = "posture"
    ) -> tuple[Collision, ...]:
        """Return the collisions at a posture, the deepest first.

        Args:
            u: Actuator positions ``(n,)`` [rad | m].
            fingers: Fingers whose tips are to touch the object.
            posture: Name of the posture, for the result.
        """
        found = [*self._own(u, posture), *self._with_object(u, fingers, posture)]
        return tuple(sorted(found, key=lambda each: -each.depth))

    def _own(self, u: FloatArray, posture: str) -> list[Collision]:
        geometry = self._geometry
        poses, found = geometry.kinematics.placements(u), []
        for links in self._pairs:
            sides = geometry.of_links(links[0]), geometry.of_links(links[1])
            depth = -geometry.closest(sides, poses, convex=True)[0]
            if depth <= (_PRESSED if self._tips.keys() >= set(links) else _DEPTH):
                continue
            before = -geometry.closest(sides, self._at_rest, convex=True)[0]
            if depth <= before + _DEPTH or geometry.touching(sides, self._at_rest):
                continue
            if geometry.touching(sides, poses):
                found.append(Collision(links, depth, posture))
        return found

    def _with_object(
        self, u: FloatArray, fingers: Collection[str], posture: str
    ) -> list[Collision]:
        scene = self._scene
        if scene is None:
            return []
        at = scene.posed(u)
        depths: dict[str, float] = {}
        for touch in DistanceBounds(scene, [at], self._pose[None]).touching(at)[0]:
            link, depth = self._geometry.shapes[touch.shape].link, -touch.distance
            if depth > (_PRESSED if self._tips.get(link) in fingers else _DEPTH):
                depths[link] = max(depth, depths.get(link, 0.0))
        return [Collision((link, OBJECT), depth, posture) for link, depth in depths.items()]
