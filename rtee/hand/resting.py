"""Rest postures that are a pinch, as of grippers whose zero is closed, and the way out."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Final

import numpy as np

from rtee.hand.model import Hand
from rtee.hand.yamlwrite import rest_line
from rtee.types import FloatArray

if TYPE_CHECKING:
    from rtee.hand.geometry import HandGeometry

NEAR: Final = 0.002
"""Tips nearer than this nearly touch [m]: each may be a millimetre off its model."""

_STEP: Final = 0.05
"""Share of the way to a limit by which is tried whether an actuator moves the tips apart."""

APART: Final = 0.5
"""Least part of the motion of one tip past the other that widens the gap where they are opposed;
tips side by side slide along each other instead."""

OWN: Final = 0.25
"""An actuator that moves one finger only decides about it if it carries the tip at least this share
of the way that any actuator does; less is an adjustment."""

_PASSES: Final = 2
"""How often every actuator's limits are compared: the second time with the others' chosen."""


@dataclass(frozen=True)
class ClosedRest:
    """A rest posture that is a pinch, and a better one.

    Attributes:
        fingers: The fingers whose tips touch or nearly do, two by two.
        gap: The widest of the gaps between them at rest [m]; 0 where they touch.
        opened: Rest positions for hand.yaml [rad | m]: at the limits where the tips are farthest
            apart for the actuators that open them, as they are where a rest is given already.
        opening: The narrowest of their gaps there [m].
    """

    fingers: tuple[tuple[str, str], ...]
    gap: float
    opened: Mapping[str, float]
    opening: float

    @property
    def line(self) -> str:
        """The line for hand.yaml."""
        return rest_line(self.opened)

    @property
    def found(self) -> str:
        """What was found, in words."""
        pairs = ", ".join(f"'{a}' and '{b}'" for a, b in self.fingers)
        how = f"are only {self.gap * 1e3:.1f} mm apart" if self.gap > 0.0 else "touch"
        return f"the tips of {pairs} {how}"

    @property
    def text(self) -> str:
        """What is wrong and what to type, in one sentence."""
        return (
            f"the rest posture is a pinch: {self.found} there, so `rtee open` closes the hand; "
            f"type into hand.yaml: {self.line} (then they are {self.opening * 1e3:.1f} mm apart) "
            "and extract again"
        )


def closed_rest(geometry: HandGeometry) -> ClosedRest | None:
    """Return that the rest posture of a hand is a pinch, if it is one and the hand can open.

    Two tips pinch at rest where they touch or nearly do, and the motion by which they move farthest
    past each other parts them. Tips side by side, which bend beside each other, do not.

    Args:
        geometry: The hand's geometry.

    Raises:
        ModelError: A mesh cannot be read.
    """
    search = _Search(geometry)
    pairs = search.pinching()
    if not pairs:
        return None
    u = search.opened(pairs)
    hand = geometry.hand
    gaps = search.gaps(hand.rest, pairs)
    openings = search.gaps(u, pairs)
    if min(openings) <= NEAR or sum(openings) <= sum(gaps):
        return None
    rest = {
        spec.name: float(value)
        for spec, value in zip(hand.actuators, u, strict=True)
        if value != spec.rest or spec.rest != min(max(0.0, spec.lower), spec.upper)
    }
    names = tuple((hand.fingers[i].name, hand.fingers[j].name) for i, j in pairs)
    return ClosedRest(names, max(gaps), rest, min(openings))


Pair = tuple[int, int]


class _Search:
    """Gaps between fingertips, and what widens them."""

    def __init__(self, geometry: HandGeometry) -> None:
        import coal

        self._coal = coal
        self._geometry = geometry
        self._hand = geometry.hand
        self._request = coal.DistanceRequest()
        self._request.enable_signed_distance = True

    def pinching(self) -> list[Pair]:
        """Return the fingers, two by two, whose tips pinch at rest."""
        hand = self._hand
        tipped = [i for i, finger in enumerate(hand.fingers) if finger.tip]
        return [
            pair
            for pair in combinations(tipped, 2)
            if self._apart(pair) and self._near(pair) and self._opposed(pair)
        ]

    def gaps(self, u: FloatArray, pairs: Iterable[Pair]) -> list[float]:
        """Return the gap between the tips of some fingers at a posture [m]; 0 where they touch."""
        poses = self._geometry.kinematics.placements(u)
        return [max(0.0, self._distance(pair, poses, convex=False)) for pair in pairs]

    def opened(self, pairs: Sequence[Pair]) -> FloatArray:
        """Return rest with the actuators that part the tips at their best limits ``(n,)``."""
        u = np.array(self._hand.rest)
        helpful = {
            a for pair in pairs for a, bound in self._ways(pair) if self._parts(pair, a, bound)
        }
        for _ in range(_PASSES):
            for a in sorted(helpful):
                spec = self._hand.actuators[a]
                tried = []
                for value in (float(u[a]), spec.lower, spec.upper):
                    v = u.copy()
                    v[a] = value
                    tried.append((sum(self.gaps(v, pairs)), value))
                # Where limits are equally good, the first one: what is there already stays.
                u[a] = max(tried, key=lambda found: found[0])[1]
        return u

    def _apart(self, pair: Pair) -> bool:
        """Return whether the tips are on different bodies."""
        first, second = (str(self._hand.fingers[i].tip) for i in pair)
        kinematics = self._geometry.kinematics
        return kinematics.body(first) != kinematics.body(second)

    def _near(self, pair: Pair) -> bool:
        poses = self._geometry.kinematics.placements(self._hand.rest)
        boxes = [self._ball(i, poses) for i in pair]
        between = float(np.linalg.norm(boxes[0][0] - boxes[1][0])) - boxes[0][1] - boxes[1][1]
        return between <= NEAR and self._distance(pair, poses, convex=False) <= NEAR

    def _ball(self, finger: int, poses: Mapping[str, FloatArray]) -> tuple[FloatArray, float]:
        """Return a ball around a fingertip: its centre and radius [m]."""
        tip = str(self._hand.fingers[finger].tip)
        shapes = [self._geometry.shapes[i] for i in self._geometry.of_link(tip)]
        centres = [s.in_link.rotation @ s.ball[0] + s.in_link.translation for s in shapes]
        middle = np.mean(centres, axis=0)
        radius = max(
            float(np.linalg.norm(c - middle)) + s.ball[1]
            for c, s in zip(centres, shapes, strict=True)
        )
        pose = poses[tip]
        return pose[:3, :3] @ middle + pose[:3, 3], radius

    def _ways(self, pair: Pair) -> list[tuple[int, float]]:
        """Return what moves the tips against each other: actuators, each with a limit to go to."""
        hand = self._hand
        moving = {a for i in pair for a in hand.fingers[i].actuators}
        return [
            (a, bound)
            for a, spec in enumerate(hand.actuators)
            if spec.name in moving
            for bound in (spec.lower, spec.upper)
            if math.isfinite(bound) and abs(bound - spec.rest) > _STEP * (spec.upper - spec.lower)
        ]

    def _opposed(self, pair: Pair) -> bool:
        """Return whether the motion that carries the tips farthest past each other parts them.

        A motion of one of them only comes first: spreading moves several that stand side by side.
        """
        hand = self._hand
        own = {name for i in pair for name in hand.fingers[i].own}
        tried = [(*self._moved(pair, a, b), hand.actuators[a].name) for a, b in self._ways(pair)]
        farthest = max((moved for moved, *_ in tried), default=0.0)
        first = [way for way in tried if way[2] in own and way[0] >= OWN * farthest]
        moved, widened, _ = max(first or tried, default=(0.0, 0.0, ""), key=lambda way: way[0])
        return moved > 0.0 and widened >= APART * moved

    def _parts(self, pair: Pair, actuator: int, bound: float) -> bool:
        moved, widened = self._moved(pair, actuator, bound)
        return moved > 0.0 and widened >= APART * moved

    def _moved(self, pair: Pair, actuator: int, bound: float) -> tuple[float, float]:
        """Return how far a step to a limit moves the tips past each other, and how much apart [m].

        The distance between convex parts is signed, so that it grows where tips overlap, too.
        """
        kinematics = self._geometry.kinematics
        u = np.array(self._hand.rest)
        before = kinematics.placements(u)
        distance, point = self._closest(pair, before, convex=True)
        u[actuator] += _STEP * (bound - u[actuator])
        after = kinematics.placements(u)
        ends = []
        for i in pair:
            tip = str(self._hand.fingers[i].tip)
            ends.append((after[tip] @ np.linalg.inv(before[tip]) @ np.append(point, 1.0))[:3])
        moved = float(np.linalg.norm(ends[1] - ends[0]))
        return moved, self._distance(pair, after, convex=True) - distance

    def _distance(self, pair: Pair, poses: Mapping[str, FloatArray], *, convex: bool) -> float:
        return self._closest(pair, poses, convex=convex)[0]

    def _closest(
        self, pair: Pair, poses: Mapping[str, FloatArray], *, convex: bool
    ) -> tuple[float, FloatArray]:
        """Return the signed distance of the tips [m] and the middle of the closest points [m].

        Args:
            pair: The fingers.
            poses: Where the links are.
            convex: Of the convex parts, instead of the shapes as given.
        """
        coal, geometry = self._coal, self._geometry
        tips = [str(self._hand.fingers[i].tip) for i in pair]
        best, where = math.inf, np.zeros(3)
        for i in geometry.of_link(tips[0]):
            for j in geometry.of_link(tips[1]):
                shapes = [geometry.shapes[i], geometry.shapes[j]]
                places = []
                for shape, tip in zip(shapes, tips, strict=True):
                    pose = poses[tip]
                    rotation = pose[:3, :3] @ shape.in_link.rotation
                    position = pose[:3, :3] @ shape.in_link.translation + pose[:3, 3]
                    places.append(coal.Transform3s(rotation, position))
                bodies = [shape.convex if convex else shape.exact for shape in shapes]
                result = coal.DistanceResult()
                distance = coal.distance(
                    bodies[0], places[0], bodies[1], places[1], self._request, result
                )
                if distance < best:
                    points = result.getNearestPoint1(), result.getNearestPoint2()
                    best, where = float(distance), (np.array(points[0]) + np.array(points[1])) / 2.0
        return best, where


def closed_rest_of(hand: Hand) -> ClosedRest | None:
    """Return that a hand's rest posture is a pinch; see `closed_rest`.

    Raises:
        ModelError: A mesh cannot be read.
    """
    from rtee.hand.geometry import HandGeometry

    return closed_rest(HandGeometry(hand))
