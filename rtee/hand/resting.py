"""Detect rest postures that are a pinch, as for grippers closed at zero, and find better ones."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Final

import numpy as np

from rtee.hand.limits import clamped
from rtee.hand.model import Hand
from rtee.hand.yamlfile import rest_line
from rtee.sample import FloatArray

if TYPE_CHECKING:
    from rtee.hand.geometry import HandGeometry, Sides

NEAR: Final = 0.002
"""Gap below which two tips nearly touch [m]: the error of a model is about a millimetre per tip."""

_STEP: Final = 0.05
"""Fraction of the way to a limit at which to test whether an actuator moves the tips apart: small,
since the direction may change on the way."""

APART: Final = 0.5
"""Least ratio of the change of the gap to the relative motion of two opposed tips; for tips side by
side, which slide along each other, it is smaller."""

OWN: Final = 0.25
"""Least motion of the tips at which an actuator of only one finger counts [fraction of the largest
motion by any actuator]; smaller ones are adjustments."""

_POSTURES: Final = 33
"""Postures in which a single actuator is examined: each 3 % of its range."""

_PASSES: Final = 2
"""Number of times that the limits of every actuator are compared; the second time, the limits
chosen for the others are known."""


@dataclass(frozen=True)
class ClosedRest:
    """A rest posture that closes a pinch, and an open alternative.

    Attributes:
        fingers: The pairs of fingers whose tips touch or nearly touch.
        gap: The widest gap of these pairs at rest [m]; 0 if all touch.
        opened: Rest positions for hand.yaml [rad | m]. Actuators that open the tips are at the
            limit with the widest gap; the others keep a rest position that is given already.
        opening: The narrowest gap of these pairs at ``opened`` [m].
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
        """The finding as a phrase."""
        pairs = ", ".join(f"'{a}' and '{b}'" for a, b in self.fingers)
        how = f"are only {self.gap * 1e3:.1f} mm apart" if self.gap > 0.0 else "touch"
        return f"the tips of {pairs} {how}"

    @property
    def text(self) -> str:
        """The problem and its remedy in one sentence."""
        return (
            f"the rest posture is a pinch: {self.found} there, so `rtee open` closes the hand; "
            f"type into hand.yaml: {self.line} (then they are {self.opening * 1e3:.1f} mm apart) "
            "and extract again"
        )


def closed_rest(geometry: HandGeometry) -> ClosedRest | None:
    """Return the pinch that the rest posture is; ``None`` if it is not one, or cannot be opened.

    Two tips pinch at rest if they touch or nearly touch, and their largest relative motion moves
    them apart. Tips side by side, which bend next to each other, do not.

    Raises:
        ModelError: if a mesh cannot be read.
    """
    search = _GapSearch(geometry)
    pairs = search.pinching()
    if not pairs:
        return None
    u = search.opened(pairs)
    hand = geometry.hand
    gaps = search.gaps(hand.rest, pairs)
    openings = search.gaps(u, pairs)
    # No better posture was found, so the hand is meant to be closed at rest.
    if min(openings) <= NEAR or sum(openings) <= sum(gaps):
        return None
    names = tuple((hand.fingers[i].name, hand.fingers[j].name) for i, j in pairs)
    return ClosedRest(names, max(gaps), _rest_of(hand, u), min(openings))


def widest_rest(geometry: HandGeometry) -> ClosedRest | None:
    """Return the widest posture of a hand whose fingers close together, with no rest given.

    Its fingers are moved by one actuator, or are two jaws that mirror each other. ``None`` if it
    rests there already, or its fingertips do not part. At 0, a claw is nearly closed: `rtee open`
    would not open it, and its pinch would have no room to close. Actuators that move no fingertip,
    such as those of a motor's screw in some models, stay where they rest.

    Raises:
        ModelError: if a mesh cannot be read.
    """
    hand, search = geometry.hand, _GapSearch(geometry)
    pairs, factors = search.parted(), _together(hand)
    specs = [hand.actuators[a] for a in factors]
    if not pairs or not specs or any(s.rest != clamped(0.0, s.lower, s.upper) for s in specs):
        return None
    lower, upper = specs[0].lower, specs[0].upper
    if not (math.isfinite(lower) and math.isfinite(upper)):
        return None
    gaps = search.gaps(hand.rest, pairs)
    tried = []
    for value in np.linspace(lower, upper, _POSTURES):
        u = np.array(hand.rest)
        for (a, factor), spec in zip(factors.items(), specs, strict=True):
            u[a] = clamped(factor * value, spec.lower, spec.upper)
        tried.append(u)
    widest = max(tried, key=lambda u: sum(search.gaps(u, pairs)))
    openings = search.gaps(widest, pairs)
    if sum(openings) < sum(gaps) + NEAR:
        return None
    names = tuple((hand.fingers[i].name, hand.fingers[j].name) for i, j in pairs)
    return ClosedRest(names, max(gaps), _rest_of(hand, widest), min(openings))


def _together(hand: Hand) -> dict[int, int]:
    """Return the actuators by which all fingers close together, each with 1 or -1; or none."""
    moving = [a for a, spec in enumerate(hand.actuators) if spec.fingers]
    if len(moving) == 1:
        return {moving[0]: 1}
    # Imported here, since a running hand does without it.
    from rtee.hand.candidates import one_motor

    jaws = one_motor(hand)
    if jaws is None:
        return {}
    first, second = hand.actuator_index(jaws.master), hand.actuator_index(jaws.joint)
    return {first: 1, second: jaws.factor}


def _rest_of(hand: Hand, u: FloatArray) -> dict[str, float]:
    """Return a rest posture ``(n,)`` for hand.yaml, without the values that hold in any case."""
    return {
        spec.name: float(value)
        for spec, value in zip(hand.actuators, u, strict=True)
        if value != spec.rest or spec.rest != clamped(0.0, spec.lower, spec.upper)
    }


Pair = tuple[int, int]


class _GapSearch:
    """Computes gaps between fingertips, and finds the actuators that widen them."""

    def __init__(self, geometry: HandGeometry) -> None:
        self._geometry = geometry
        self._hand = geometry.hand

    def pinching(self) -> list[Pair]:
        """Return the pairs of fingers whose tips pinch at rest."""
        return [pair for pair in self.parted() if self._near(pair) and self._opposed(pair)]

    def parted(self) -> list[Pair]:
        """Return the pairs of fingers whose tips are on different bodies."""
        tipped = [i for i, finger in enumerate(self._hand.fingers) if finger.tip]
        return [pair for pair in combinations(tipped, 2) if self._on_two_bodies(pair)]

    def gaps(self, u: FloatArray, pairs: Iterable[Pair]) -> list[float]:
        """Return the gap of each pair of tips at a posture [m]; 0 if they touch."""
        poses = self._geometry.kinematics.placements(u)
        closest = self._geometry.closest
        return [max(0.0, closest(self._sides(p), poses, convex=False)[0]) for p in pairs]

    def opened(self, pairs: Sequence[Pair]) -> FloatArray:
        """Return the rest posture ``(n,)`` with actuators that open tips at their best limit."""
        u = np.array(self._hand.rest)
        helpful = {
            a for pair in pairs for a, bound in self._steps(pair) if self._parts(pair, a, bound)
        }
        for _ in range(_PASSES):
            # In the hand's order, since the choice for an actuator affects the following ones.
            for a in sorted(helpful):
                spec = self._hand.actuators[a]
                tried = []
                for value in (float(u[a]), spec.lower, spec.upper):
                    v = u.copy()
                    v[a] = value
                    tried.append((sum(self.gaps(v, pairs)), value))
                # Of equally good positions, the first one, so that the present one is kept.
                u[a] = max(tried, key=lambda found: found[0])[1]
        return u

    def _on_two_bodies(self, pair: Pair) -> bool:
        """Return whether the tips are on different bodies."""
        first, second = map(self._geometry.kinematics.body, self._tips(pair))
        return first != second

    def _near(self, pair: Pair) -> bool:
        poses = self._geometry.kinematics.placements(self._hand.rest)
        sides = self._sides(pair)
        (first, reach), (second, other) = (self._ball(side, poses) for side in sides)
        between = float(np.linalg.norm(first - second)) - reach - other
        # The spheres first, since distances of meshes are expensive.
        return between <= NEAR and self._geometry.closest(sides, poses, convex=False)[0] <= NEAR

    def _ball(
        self, side: Sequence[int], poses: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, float]:
        """Return the centre ``(3,)`` and radius of a sphere around a fingertip's shapes [m]."""
        shapes = [self._geometry.shapes[i] for i in side]
        centres = [(poses[s.link] @ s.in_link.homogeneous @ [*s.ball[0], 1.0])[:3] for s in shapes]
        middle = np.mean(centres, axis=0)
        radius = max(
            float(np.linalg.norm(c - middle)) + s.ball[1]
            for c, s in zip(centres, shapes, strict=True)
        )
        return middle, radius

    def _steps(self, pair: Pair) -> list[tuple[int, float]]:
        """Return the motions of the tips to test: indices of actuators, each with a limit."""
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
        """Return whether the largest relative motion of the tips moves them apart.

        Motions of only one of the fingers take precedence, since spreading moves several fingers
        that lie side by side.
        """
        hand = self._hand
        own = {name for i in pair for name in hand.fingers[i].own}
        tried = [(*self._moved(pair, a, b), hand.actuators[a].name) for a, b in self._steps(pair)]
        farthest = max((moved for moved, *_ in tried), default=0.0)
        first = [step for step in tried if step[2] in own and step[0] >= OWN * farthest]
        moved, widened, _ = max(first or tried, default=(0.0, 0.0, ""), key=lambda step: step[0])
        return moved > 0.0 and widened >= APART * moved

    def _parts(self, pair: Pair, actuator: int, bound: float) -> bool:
        moved, widened = self._moved(pair, actuator, bound)
        return moved > 0.0 and widened >= APART * moved

    def _moved(self, pair: Pair, actuator: int, bound: float) -> tuple[float, float]:
        """Return the relative motion of the tips by a step to a limit, and the change of their gap.

        Both in metres. The distance of convex parts is signed, so that it changes for overlapping
        tips, too.
        """
        kinematics, tips, sides = self._geometry.kinematics, self._tips(pair), self._sides(pair)
        u = np.array(self._hand.rest)
        before = kinematics.placements(u)
        distance, point = self._geometry.closest(sides, before, convex=True)
        u[actuator] += _STEP * (bound - u[actuator])
        after = kinematics.placements(u)
        # Where each tip carries the point that was in the middle of the gap before.
        first, second = (
            (after[tip] @ np.linalg.inv(before[tip]) @ np.append(point, 1.0))[:3] for tip in tips
        )
        apart = self._geometry.closest(sides, after, convex=True)[0]
        return float(np.linalg.norm(second - first)), apart - distance

    def _tips(self, pair: Pair) -> tuple[str, str]:
        return str(self._hand.fingers[pair[0]].tip), str(self._hand.fingers[pair[1]].tip)

    def _sides(self, pair: Pair) -> Sides:
        first, second = (self._hand.fingers[i].tip_links for i in pair)
        return self._geometry.of_links(*first), self._geometry.of_links(*second)


def closed_rest_of(hand: Hand, *, narrow: bool = False) -> ClosedRest | None:
    """Return a hand's `closed_rest`; with ``narrow``, its `widest_rest` if there is none.

    Raises:
        ModelError: if a mesh cannot be read.
    """
    # Imported here, since it needs Coal and Pinocchio, which a robot's computer may not have.
    from rtee.hand.geometry import HandGeometry

    geometry = HandGeometry(hand)
    closed = closed_rest(geometry)
    return closed if closed is not None or not narrow else widest_rest(geometry)
