"""Openings of actions: the distances between opposing fingertips on the path from rest.

Distances are those of the original geometry, measured by Coal. Levers follow from the Jacobians of
the tips' nearest points and the transmission: the opening decreases by ``-dw/du`` per unit of an
actuator, so a force ``F`` between the sides requires the actuator effort ``-F dw/du`` (virtual
work).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise, product
from typing import Final

import coal
import numpy as np
import pinocchio as pin

from rtee.actions.openings import Meeting, Openings, OpeningTable, fingerprint_of
from rtee.actions.types import Action, Timed
from rtee.extract.collisions import Collisions
from rtee.extract.jobs import Progress
from rtee.extract.motion import MotionBounds
from rtee.extract.scene import Scene
from rtee.hand.geometry import HandGeometry, Shape
from rtee.hand.linalg import dot, matmul, matvec, norm, norms, vecmat
from rtee.hand.model import Hand
from rtee.hand.pairs import Pairs
from rtee.sample import FloatArray
from rtee.types import from_rest, readonly

ERROR: Final = 2e-5
"""Largest interpolation error of a table with one actuator [m]: a fifth of the accuracy of parallel
grippers, 0.1 mm."""

ERROR_OF_FINGERS: Final = 1e-4
"""Largest interpolation error with several actuators [m]: their position errors move a fingertip by
more."""

_FIRST: Final = 17
"""Number of points of the initial, even table: enough to detect tips that approach, then part."""

_FINEST: Final = 1.0 / 2048
"""Smallest difference between the intensities of two points, even if the error is larger."""

_CLOSES: Final = 2e-3
"""Smallest approach of two opposing tips [m]."""

_SHARE: Final = 0.3
"""Smallest approach of opposing tips, as a share of that of the pair that closes most; neighbouring
fingers, which approach each other a little, have less."""

_PARTS: Final = 0.9
"""Approach of a jaw's shape, as a share of that of its link, below which the shape is not part of
the fingertip: hinges and levers stay near the other jaw all the time."""

_LINKS: Final = 0.75
"""Smallest approach of a link, as a share of the largest, if several links form a jaw's tip. If a
marker sits back on a pad, the markers approach from farther apart, but the pads touch."""

_BUMP: Final = 1e-4
"""Largest increase of an opening that still counts as falling [m]."""

_STEP: Final = 1e-6
"""Smallest decrease of the opening between two points of the table [m]: its rounding."""

_TOUCH: Final = 1e-6
"""Distance below which surfaces touch, and their nearest points do not define a line [m]."""

_ROUNDS: Final = 30
"""Maximum number of steps to find the centre of tips that close from all sides; three suffice for a
symmetric gripper."""

_WORTH: Final = 0.005
"""Share of the path above which a note reports an omitted part."""

_FLAT: Final = 1e-12
"""Squared sine of the angle below which three points are collinear."""

_DIGITS: Final = 4
"""Decimals of the intensity of a first contact: a few micrometres of a fingertip's path."""

_STILL: Final = 1e-9
"""Speed below which a tip does not move [m per unit of intensity]."""


@dataclass(frozen=True)
class _Gap:
    """Gap between two surfaces: distance [m], nearest points, unit normal from first to second."""

    distance: float
    first: FloatArray
    second: FloatArray
    normal: FloatArray


@dataclass(frozen=True)
class _Sample:
    """Opening at one intensity: width [m], levers, and the largest angle of a tip [rad]."""

    width: float
    lever: FloatArray
    angle: float


def make_openings(
    hand: Hand, actions: Iterable[Action], progress: Progress | None = None
) -> Openings:
    """Return the openings of the actions that have one, and where the empty hand touches itself.

    Both are in the order of the actions. ``progress`` is called with the number of finished actions
    and the total.

    Raises:
        ModelError: A mesh is missing or cannot be read.
    """
    chosen = [action for action in actions if not isinstance(action, Timed)]
    scene = Scene(hand)
    collisions = Collisions(scene, MotionBounds(scene))
    openings, meetings = [], []
    for number, action in enumerate(chosen, 1):
        table = opening_of(scene.geometry, action)
        if table is not None:
            openings.append(table)
        first = collisions.meetings(_goal(hand, action))
        names = {hand.actuator_names[i]: round(at, _DIGITS) for i, at in first.items()}
        meetings.append(Meeting(action.name, action.elements, fingerprint_of(hand, action), names))
        if progress is not None:
            progress(number, len(chosen))
    return Openings(hand, tuple(openings), tuple(meetings))


def _goal(hand: Hand, action: Action) -> FloatArray:
    """Return the actuators' positions at intensity 1 ``(n,)`` [rad | m]."""
    posture, goal = action.waypoints[-1], np.array(hand.rest)
    for name in posture.involved:
        goal[hand.actuator_index(name)] = posture.position[name]
    return np.clip(goal, hand.lower, hand.upper)


def opening_of(geometry: HandGeometry, action: Action) -> OpeningTable | None:
    """Return the opening of an action; ``None`` if no tips oppose each other on its path.

    If tips close from two sides, the opening is the least distance between a tip of one side and a
    tip of the other. If tips close from more sides, it is the diameter of the smallest ball that
    touches all of them.
    """
    if isinstance(action, Timed):
        return None
    fingers = _fingers(geometry.hand, action)
    if len(fingers) < 2:
        return None
    way = _TipPaths(geometry, action, fingers)
    sides = way.sides()
    if not sides:
        return None
    return _Table(way, sides).opening()


def _fingers(hand: Hand, action: Action) -> tuple[str, ...]:
    """Return the fingers whose tips may oppose each other.

    A single moving finger may close on fixed ones.
    """
    tipped = [finger for finger in hand.fingers if finger.tip]
    moved = set(action.waypoints[-1].involved)
    named = [f.name for f in tipped if f.name in action.fingers]
    fingers = named or [f.name for f in tipped if moved.intersection(f.actuators)]
    if len(fingers) == 1:
        fingers += [f.name for f in tipped if not f.actuators]
    return tuple(fingers)


class _TipPaths:
    """The path of an action from rest, with the gaps and motions of its tips."""

    def __init__(self, geometry: HandGeometry, action: Action, fingers: Sequence[str]) -> None:
        hand = geometry.hand
        self.geometry, self.action, self.fingers = geometry, action, tuple(fingers)
        self.actuators = tuple(
            name
            for name in action.waypoints[-1].involved
            if action.waypoints[-1].position[name] != hand.actuator(name).rest
        )
        self._columns = [hand.actuator_index(name) for name in self.actuators]
        self._goal = _goal(hand, action)
        self.direction: FloatArray = (self._goal - hand.rest)[self._columns]
        self._kinematics = geometry.kinematics
        self.tips = {name: str(hand.finger(name).tip) for name in self.fingers}
        shapes = {
            name: [geometry.shapes[i] for i in geometry.of_links(*hand.finger(name).tip_links)]
            for name in self.fingers
        }
        self._couples: Pairs[str, list[tuple[Shape, Shape]]] = Pairs(
            (
                ((one, other), list(product(shapes[one], shapes[other])))
                for one, other in combinations(self.fingers, 2)
            ),
            turned=lambda couples: [(other, one) for one, other in couples],
        )
        self._parts: dict[str, list[Shape]] = shapes
        self._slopes = np.zeros((0, 0))
        self._normals: Pairs[str, FloatArray] = Pairs(turned=np.negative)

    def go(self, intensity: float) -> None:
        """Place the hand at an intensity."""
        hand, robot = self.geometry.hand, self._kinematics
        u = from_rest(np.array(hand.rest), self._goal, intensity)
        pin.computeJointJacobians(robot.model, robot.data, hand.transmission.joints(u))
        self._slopes = hand.transmission.jacobian(u)[:, self._columns]

    def _pose(self, shape: Shape) -> coal.Transform3s:
        at = self._kinematics.data.oMi[shape.body] * shape.placement
        return coal.Transform3s(at.rotation, at.translation)

    def _between(self, one: Shape, other: Shape) -> tuple[float, coal.DistanceResult]:
        result = coal.DistanceResult()
        places = self._pose(one), self._pose(other)
        distance = coal.distance(
            one.exact, places[0], other.exact, places[1], coal.DistanceRequest(), result
        )
        return max(float(distance), 0.0), result

    def gap(self, first: str, second: str) -> _Gap:
        """Return the gap between the tips of two fingers at the present posture."""
        distances = (self._between(*couple) for couple in self._couples[first, second])
        distance, result = min(distances, key=lambda each: each[0])
        points = np.array(result.getNearestPoint1()), np.array(result.getNearestPoint2())
        if distance > _TOUCH:
            between = points[1] - points[0]
            self._normals[first, second] = between / norm(between)
        # Touching tips keep their last normal, since coincident points do not define one.
        normal = self._normals.get((first, second), np.zeros(3))
        return _Gap(distance, *points, normal)

    def from_point(self, finger: str, centre: FloatArray) -> tuple[float, FloatArray]:
        """Return the distance of a tip from a point [m], and the tip's nearest point."""
        # Coal cannot measure points; use a sphere of tiny radius.
        point, at = coal.Sphere(_TOUCH), coal.Transform3s(np.eye(3), centre)
        best, nearest = math.inf, centre
        for shape in self._parts[finger]:
            result = coal.DistanceResult()
            distance = coal.distance(
                shape.exact, self._pose(shape), point, at, coal.DistanceRequest(), result
            )
            if distance < best:
                best, nearest = distance, np.array(result.getNearestPoint1())
        return max(best + _TOUCH, 0.0), nearest

    def jacobian(self, finger: str, point: FloatArray) -> FloatArray:
        """Return the Jacobian ``(3, a)`` of a point of a tip by the actuators."""
        robot = self._kinematics
        body = robot.body(self.tips[finger])
        if body == 0:  # the base, which nothing moves
            return np.zeros((3, len(self.actuators)))
        joint = pin.getJointJacobian(
            robot.model, robot.data, body, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        ).reshape(6, -1)  # Pinocchio drops the axis of a single joint
        offset = point - robot.data.oMi[body].translation
        linear = joint[:3] + np.cross(joint[3:].T, offset).T
        return matmul(linear, self._slopes)

    def sides(self) -> tuple[tuple[str, ...], ...]:
        """Return the opposing sides of the tips; empty if no tips oppose each other."""
        closes: dict[tuple[str, str], float] = {}
        for pair, distances in self._distances().items():
            counted = self._counted(pair, _approach(distances))
            self._couples[pair] = [self._couples[pair][k] for k in counted]
            closes[pair] = float(_approach(distances[:, counted].min(axis=1)))
        most = {f: max(by for pair, by in closes.items() if f in pair) for f in self.fingers}
        # Each finger opposes at least the one that it approaches most.
        share = _SHARE * max(most.values())
        opposed = [
            pair
            for pair, by in closes.items()
            if by >= _CLOSES and by >= min(share, *(most[finger] for finger in pair))
        ]
        for finger in self.fingers:
            met = [c[p.index(finger)] for p in opposed if finger in p for c in self._couples[p]]
            self._parts[finger] = list(dict.fromkeys(met))
        there = [f for f in self.fingers if any(f in pair for pair in opposed)]
        return _two_sides(there, opposed) or tuple((finger,) for finger in there)

    def _distances(self) -> dict[tuple[str, str], FloatArray]:
        """Return the distances ``(s, k)`` [m] of the shapes of each pair of tips along the path."""
        found: dict[tuple[str, str], list[list[float]]] = {pair: [] for pair in self._couples}
        for s in np.linspace(0.0, 1.0, _FIRST).tolist():
            self.go(s)
            for pair, couples in self._couples.items():
                found[pair].append([self._between(*couple)[0] for couple in couples])
        return {pair: np.array(rows) for pair, rows in found.items()}

    def _counted(self, pair: tuple[str, str], approach: FloatArray) -> list[int]:
        """Return which couples of a pair's shapes are fingertips on both sides.

        The whole distal link of an articulated finger is its fingertip. A jaw is one link from its
        hinge or slide to its tip, so only the parts that approach most are its tip.
        """
        couples = self._couples[pair]
        tips: list[Collection[Shape]] = []
        for side, finger in enumerate(pair):
            parts: dict[Shape, float] = {}
            for couple, by in zip(couples, approach.tolist(), strict=True):
                parts[couple[side]] = max(by, parts.get(couple[side], 0.0))
            tips.append(_foremost(parts) if self._is_jaw(finger) else parts)
        return [k for k, (a, b) in enumerate(couples) if a in tips[0] and b in tips[1]]

    def _is_jaw(self, finger: str) -> bool:
        """Return whether a finger has at most one moving joint."""
        hand = self.geometry.hand
        below = hand.finger(finger).links[1:]
        return sum(hand.urdf.joint_to[link].moving for link in below) <= 1


def _approach(distances: FloatArray) -> FloatArray:
    """Return the largest decrease of distances along the first axis [m]."""
    farthest = np.maximum.accumulate(distances, axis=0)
    most: FloatArray = (farthest - distances).max(axis=0)
    return most


def _foremost(parts: Mapping[Shape, float]) -> set[Shape]:
    """Return the shapes of a jaw that approach most; ``parts`` has the approach of each [m]."""
    links: dict[str, float] = {}
    for part, by in parts.items():
        links[part.link] = max(by, links.get(part.link, 0.0))
    least = _LINKS * max(links.values())
    return {
        part
        for part, by in parts.items()
        if by >= _PARTS * links[part.link] and links[part.link] >= least
    }


def _two_sides(
    fingers: Sequence[str], opposed: Sequence[tuple[str, str]]
) -> tuple[tuple[str, ...], ...]:
    """Return the fingers on two sides such that each opposed pair spans both.

    Return an empty tuple if that is impossible.
    """
    partners: dict[str, list[str]] = {finger: [] for finger in fingers}
    for a, b in opposed:
        partners[a].append(b)
        partners[b].append(a)
    side: dict[str, int] = {}
    for start in fingers:
        waiting = [] if start in side else [start]
        side.setdefault(start, 0)
        while waiting:
            finger = waiting.pop()
            for other in partners[finger]:
                if other not in side:
                    side[other] = 1 - side[finger]
                    waiting.append(other)
                # An odd cycle cannot be divided into two sides.
                elif side[other] == side[finger]:
                    return ()
    return tuple(tuple(f for f in fingers if side[f] == k) for k in (0, 1)) if fingers else ()


class _Table:
    """Samples the opening of one action, more finely where it is not linear."""

    def __init__(self, way: _TipPaths, sides: tuple[tuple[str, ...], ...]) -> None:
        self._way, self._sides = way, sides
        self._known: dict[float, _Sample] = {}

    def at(self, intensity: float) -> _Sample:
        """Return the sample at an intensity."""
        if intensity not in self._known:
            self._way.go(intensity)
            sample = self._around() if len(self._sides) > 2 else self._between()
            self._known[intensity] = sample
        return self._known[intensity]

    def opening(self) -> OpeningTable | None:
        """Return the table for the part of the path on which the opening falls, or ``None``."""
        for s in np.linspace(0.0, 1.0, _FIRST).tolist():
            self.at(s)
        self._refine()
        grid = sorted(self._known)
        falling = _falling([self._known[s].width for s in grid])
        part = [grid[i] for i in falling]
        rows = [self._known[s] for s in part]
        # If this part hardly closes, the action does not grip.
        if len(rows) < 2 or rows[0].width - rows[-1].width < _CLOSES:
            return None
        action = self._way.action
        return OpeningTable(
            action.name,
            action.elements,
            fingerprint_of(self._way.geometry.hand, action),
            self._sides,
            self._way.actuators,
            readonly(part),
            readonly([row.width for row in rows]),
            np.array([row.lever for row in rows]),
            readonly([row.angle for row in rows]),
            _note(part[0], part[-1], rows[-1].width),
        )

    def _refine(self) -> None:
        """Halve the steps over which the opening is not linear enough."""
        error = ERROR if len(self._way.actuators) == 1 else ERROR_OF_FINGERS
        waiting = list(pairwise(sorted(self._known)))
        while waiting:
            low, high = waiting.pop()
            if high - low <= _FINEST:
                continue
            middle = (low + high) / 2.0
            straight = (self._known[low].width + self._known[high].width) / 2.0
            if abs(self.at(middle).width - straight) > error:
                waiting += [(low, middle), (middle, high)]

    def _between(self) -> _Sample:
        """Return the sample for tips on two sides."""
        way, (one, other) = self._way, self._sides
        gaps = {(a, b): way.gap(a, b) for a in one for b in other}
        lever = np.zeros(len(way.actuators))
        angle = 0.0
        for k, side in enumerate(self._sides):
            for finger in side:
                near = min(
                    (gap for pair, gap in gaps.items() if pair[k] == finger),
                    key=lambda gap: gap.distance,
                )
                point, towards = (
                    (near.first, near.normal) if k == 0 else (near.second, -near.normal)
                )
                moved = way.jacobian(finger, point)
                # The tips of a side press together, each with its share of the force.
                lever += vecmat(towards, moved) / len(side)
                angle = max(angle, _angle(matvec(moved, way.direction), towards))
        return _Sample(min(gap.distance for gap in gaps.values()), lever, angle)

    def _around(self) -> _Sample:
        """Return the sample for tips around a centre."""
        way, fingers = self._way, [side[0] for side in self._sides]
        gap = way.gap(fingers[0], fingers[1])
        centre = (gap.first + gap.second) / 2.0
        reach: list[tuple[float, FloatArray]] = []
        for _ in range(_ROUNDS):
            reach = [way.from_point(finger, centre) for finger in fingers]
            moved = _middle(np.array([point for _, point in reach]))
            if norm(moved - centre) < _TOUCH:
                break
            centre = moved
        lever, angle = np.zeros(len(way.actuators)), 0.0
        for finger, (distance, point) in zip(fingers, reach, strict=True):
            if distance < _STEP:  # the direction is undefined
                continue
            towards = (centre - point) / distance
            moved = way.jacobian(finger, point)
            # The factor 2: the opening is a diameter, and each tip closes along a radius.
            lever += 2.0 * vecmat(towards, moved) / len(fingers)
            angle = max(angle, _angle(matvec(moved, way.direction), towards))
        return _Sample(2.0 * max(distance for distance, _ in reach), lever, angle)


def _falling(width: Sequence[float]) -> list[int]:
    """Return the indices of the strictly falling part with the largest decrease."""
    # Skip points that do not fall, within the tolerance of a bump: the table must fall strictly.
    best: list[int] = [0]
    run: list[int] = [0]
    for i in range(1, len(width)):
        if width[i] > width[run[-1]] + _BUMP:
            run = [i]
        elif width[i] < width[run[-1]] - _STEP:
            run = [*run, i]
        if width[run[0]] - width[run[-1]] > width[best[0]] - width[best[-1]]:
            best = run
    return best


def _note(first: float, last: float, width: float) -> str:
    sentences = []
    if first > _WORTH:
        sentences.append(f"the tips first part: used from {first:.0%} of the way on")
    if last < 1.0 - _WORTH and width > _TOUCH:
        sentences.append(f"the tips part again: used up to {last:.0%} of the way")
    return "; ".join(sentences)


def _angle(motion: FloatArray, towards: FloatArray) -> float:
    """Return the angle between a tip's motion and a unit vector [rad]; 0 for a still tip."""
    speed = norm(motion)
    if speed < _STILL:
        return 0.0
    return math.acos(min(1.0, max(-1.0, dot(motion, towards) / speed)))


def _middle(points: FloatArray) -> FloatArray:
    """Return the centre of the smallest ball that contains a few points ``(k, 3)``."""
    best: float = math.inf
    centre: FloatArray = points.mean(axis=0)
    for size in (2, 3):
        for chosen in combinations(points, size):
            middle = _circumcentre(np.array(chosen))
            radius = norm(chosen[0] - middle)
            inside = norms(points - middle).max() <= radius * (1.0 + 1e-9) + 1e-12
            if inside and radius < best:
                best, centre = radius, middle
    return centre


def _circumcentre(points: FloatArray) -> FloatArray:
    """Return the centre of the smallest sphere through two or three points ``(k, 3)``.

    Return the mean of three collinear points, for which there is no such sphere.
    """
    edges = points[1:] - points[0]
    a, c = dot(edges[0], edges[0]), 0.5 * norms(edges) ** 2
    if len(edges) == 1:
        weights = c / a if a > 0.0 else np.zeros(1)
    else:
        b, d = dot(edges[0], edges[1]), dot(edges[1], edges[1])
        determinant = a * d - b * b  # of the edges' inner products, by Cramer's rule
        if determinant <= _FLAT * a * d:
            mean: FloatArray = points.mean(axis=0)
            return mean
        weights = np.array([c[0] * d - c[1] * b, a * c[1] - b * c[0]]) / determinant
    centre: FloatArray = points[0] + vecmat(weights, edges)
    return centre
