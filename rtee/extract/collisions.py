"""What else collides at a posture and on the straight way to it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from rtee.extract.motion import Motion, Way
from rtee.extract.scene import LinkPair, Scene
from rtee.types import FloatArray

_COARSE: Final = 16
"""Stations on the way at which every pair is looked at."""

STEP: Final = 0.001
"""Between two stations at which near links are checked exactly nothing moves farther [m]."""

_LINGER: Final = 256
"""Most exact stations on a way, whatever the bounds on the motion say."""


class Collisions:
    """Collisions between links, tips' contact aside.

    Not collisions: contact of links that one moving joint joins, of links that touch at rest, and
    of pairs that the SRDF disables.

    Attributes:
        checked: The pairs of links that remain.
        at_rest: The pairs that touch at rest.
    """

    def __init__(self, scene: Scene, motion: Motion) -> None:
        self._scene = scene
        self._motion = motion
        disabled = {frozenset((a, b)) for a, b, _ in scene.hand.disabled_collisions}
        parents = scene.kinematics.model.parents
        candidates = []
        for pair in scene.pairs.values():
            a, b = pair.bodies
            adjacent = parents[a] == b or parents[b] == a
            if not adjacent and frozenset(pair.links) not in disabled:
                candidates.append(pair)
        scene.place(scene.hand.rest)
        touching = {pair.links for pair in candidates if scene.touching(pair)}
        self.at_rest = tuple(sorted(touching))
        self.checked = tuple(pair for pair in candidates if pair.links not in touching)

    def concerned(
        self, actuators: Iterable[int], tips: Iterable[frozenset[str]]
    ) -> tuple[LinkPair, ...]:
        """Return the pairs that some actuators move against each other, pairs of tips aside.

        Args:
            actuators: The actuators that move; the others rest, where nothing collides.
            tips: Pairs of links whose contact is wanted.
        """
        moving, wanted = frozenset(actuators), set(tips)
        return tuple(
            pair
            for pair in self.checked
            if pair.actuators & moving and frozenset(pair.links) not in wanted
        )

    def at(self, u: FloatArray, pairs: Sequence[LinkPair]) -> list[LinkPair]:
        """Return which of the pairs collide at a posture."""
        self._scene.place(u)
        return [pair for pair in pairs if self._scene.touching(pair)]

    def along(self, way: Way, pairs: Sequence[LinkPair]) -> list[tuple[LinkPair, float]]:
        """Return which of the pairs collide on the way, and where first, as an intensity.

        Between the stations of the check no point moves more than 1 mm.
        """
        scene = self._scene
        gaps: list[list[float]] = []
        for i in range(_COARSE + 1):
            scene.place(way.at(i / _COARSE))
            gaps.append([scene.distance(pair) for pair in pairs])
        found = []
        for column, pair in enumerate(pairs):
            speed = self._motion.speed(pair, way)
            for i in range(_COARSE):
                here, there = gaps[i][column], gaps[i + 1][column]
                if here + there > speed / _COARSE:
                    continue
                at = self._first(pair, way, i / _COARSE, (i + 1) / _COARSE, speed)
                if at is not None:
                    found.append((pair, at))
                    break
        return sorted(found, key=lambda item: item[1])

    def _first(
        self, pair: LinkPair, way: Way, start: float, end: float, speed: float
    ) -> float | None:
        return first_contact(self._scene, pair, way, start, end, speed)


def first_contact(
    scene: Scene, pair: LinkPair, way: Way, start: float, end: float, speed: float
) -> float | None:
    """Return where two links first touch on a part of the way, ``None`` if they do not.

    Conservative advancement (Mirtich, 1996) on the convex parts; where these overlap, exact checks
    at most 1 mm of motion apart.

    Args:
        scene: The scene.
        pair: The links.
        way: The way.
        start: Where to begin, an intensity.
        end: Where to end.
        speed: Bound on the speed of the links against each other per unit of the way [m].
    """
    finest = max(STEP / speed, (end - start) / _LINGER) if speed > 0.0 else end - start
    t, before = start, start
    while True:
        scene.place(way.at(t))
        gap = scene.distance(pair)
        if gap <= 0.0 and scene.touching(pair):
            return _bisect(scene, pair, way, before, t)
        if t >= end:
            return None
        before = t
        t = min(end, t + max(gap / speed if speed > 0.0 else 0.0, finest))


def _bisect(scene: Scene, pair: LinkPair, way: Way, apart: float, touching: float) -> float:
    while touching - apart > 1e-5:
        middle = (apart + touching) / 2.0
        scene.place(way.at(middle))
        if scene.touching(pair):
            touching = middle
        else:
            apart = middle
    return touching
