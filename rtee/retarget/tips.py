"""The fingertips of a hand at a posture: positions, gaps between surfaces, and derivatives."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations, product
from typing import Final

import coal
import numpy as np
import pinocchio as pin

from rtee.hand.geometry import HandGeometry
from rtee.hand.halton import halton
from rtee.hand.kinematics import Kinematics
from rtee.hand.model import Hand
from rtee.sample import FloatArray

NEAR: Final = 0.004
"""Distance to keep between links of different fingers [m]: more than their motion in a solver step
near contact."""

_POSTURES: Final = 200
"""Number of postures at which `Tips.watch` checks pairs of shapes for coming near one another."""

_FAR: Final = 0.008
"""Distance above which a pair at all these postures never comes near [m]: more than `NEAR`, since
pairs come closer between them."""

Row = tuple[float, FloatArray]
"""A distance [m] and its derivative by the actuators ``(n,)``."""


def limits_of(hand: Hand) -> tuple[FloatArray, FloatArray]:
    """Return the actuators' limits ``(n,)`` [rad | m]; an actuator without limits gets one turn."""
    return (
        np.where(np.isfinite(hand.lower), hand.lower, -np.pi),
        np.where(np.isfinite(hand.upper), hand.upper, np.pi),
    )


class Tips:
    """A hand's kinematics and convex shapes, evaluated at one posture at a time."""

    def __init__(self, hand: Hand) -> None:
        """Read the model; raises `ModelError` if a mesh cannot be read."""
        self.hand = hand
        self.kinematics = Kinematics(hand)
        self.geometry = HandGeometry(hand, self.kinematics)
        bodies = range(self.kinematics.model.njoints)
        self._support = np.array([self.kinematics.support(body) for body in bodies])
        self._model = pin.GeometryModel()
        for number, shape in enumerate(self.geometry.shapes):
            self._model.addGeometryObject(
                pin.GeometryObject(str(number), shape.body, shape.placement, shape.convex)
            )
        self._pairs: dict[tuple[str, str], list[int]] = {}
        self._others: list[int] = []
        self._links: dict[int, frozenset[str]] = {}
        self._spheres = np.zeros((0, 9))
        self._add_pairs()

    # --- the pairs ---------------------------------------------------------------------------

    def _add_pairs(self) -> None:
        hand, shapes = self.hand, self.geometry.shapes
        of_finger = {link: f.name for f in hand.fingers for link in (*f.links[1:], *f.tip_links)}
        disabled = {frozenset(pair[:2]) for pair in hand.disabled_collisions}
        tips = [finger for finger in hand.fingers if finger.tip_links]
        for a, b in combinations(tips, 2):
            sides = self.geometry.of_links(*a.tip_links), self.geometry.of_links(*b.tip_links)
            self._pairs[a.name, b.name] = [self._add(i, j) for i, j in product(*sides)]
        for i, j in combinations(range(len(shapes)), 2):
            links = shapes[i].link, shapes[j].link
            fingers = of_finger.get(links[0]), of_finger.get(links[1])
            if None in fingers or fingers[0] == fingers[1] or frozenset(links) in disabled:
                continue
            self._links[self._add(i, j)] = frozenset(links)
        self._data = pin.GeometryData(self._model)
        for request in self._data.distanceRequests:
            request.enable_signed_distance = True

    def watch(self) -> None:
        """Find the links that may come near one another, for `near`; takes up to a second."""
        hand, shapes = self.hand, self.geometry.shapes
        # Hulls that overlap at rest cannot reveal a collision.
        self.go(np.array(hand.rest))
        self._others = list(self._links)
        self._others = [k for k in self._others if self._distance(k).min_distance > NEAR]
        # Most pairs never come near one another.
        never = set(self._others)
        lower, upper = limits_of(hand)
        for shares in halton(len(lower), _POSTURES):
            self.go(lower + shares * (upper - lower))
            never -= {k for k in never if self._distance(k).min_distance < _FAR}
        self._others = [k for k in self._others if k not in never]
        self._spheres = np.array(
            [
                (
                    *(shapes[i].body for i in self._shapes_of(k)),
                    *np.concatenate([self._centre(i) for i in self._shapes_of(k)]),
                    sum(shapes[i].ball[1] for i in self._shapes_of(k)),
                )
                for k in self._others
            ]
        ).reshape(-1, 9)

    def _tips_of(self, pair: tuple[str, str]) -> list[frozenset[str]]:
        first, second = (self.hand.finger(name).tip_links for name in pair)
        return [frozenset(links) for links in product(first, second)]

    def _add(self, first: int, second: int) -> int:
        self._model.addCollisionPair(pin.CollisionPair(first, second))
        return len(self._model.collisionPairs) - 1

    def _shapes_of(self, pair: int) -> tuple[int, int]:
        found = self._model.collisionPairs[pair]
        return found.first, found.second

    def _centre(self, shape: int) -> FloatArray:
        found = self.geometry.shapes[shape]
        return np.array(found.placement * found.ball[0])

    # --- one posture -------------------------------------------------------------------------

    def go(self, u: FloatArray) -> None:
        """Place the hand at actuator positions ``(n,)`` [rad | m]."""
        model, data = self.kinematics.model, self.kinematics.data
        transmission = self.hand.transmission
        pin.computeJointJacobians(model, data, transmission.joints(u))
        pin.updateGeometryPlacements(model, data, self._model, self._data)
        self._by_actuator = transmission.matrix if transmission.linear else transmission.jacobian(u)
        self._jacobian = np.array(data.J)

    def place(self, body: int, point: FloatArray) -> FloatArray:
        """Return a body's point ``(3,)`` in the base frame [m]."""
        found: FloatArray = self.kinematics.data.oMi[body].act(point)
        return found

    def moves(self, bodies: Sequence[int], points: FloatArray) -> FloatArray:
        """Return the derivatives ``(k, 3, n)`` of bodies' points ``(k, 3)`` by the actuators."""
        linear, angular = self._jacobian[:3], self._jacobian[3:]
        x, y, z = points.T
        across = np.zeros((len(points), 3, 3))
        across[:, 0, 1], across[:, 0, 2], across[:, 1, 2] = z, -y, x
        across[:, 1, 0], across[:, 2, 0], across[:, 2, 1] = -z, y, -x
        moved = (linear + across @ angular) * self._support[bodies, None, :]
        found: FloatArray = moved @ self._by_actuator
        return found

    def gap(self, pair: tuple[str, str]) -> Row:
        """Return the signed distance between the hulls of two fingertips, and its derivative."""
        if pair not in self._pairs:
            pair = pair[1], pair[0]
        return self._row(min(self._pairs[pair], key=lambda k: self._distance(k).min_distance))

    def near(self, meeting: Iterable[tuple[str, str]]) -> list[Row]:
        """Return the distances of links that should not touch and are nearer than `NEAR`.

        Only links that `watch` has found count. The tips of ``meeting`` fingers are left out.
        """
        if not len(self._spheres):
            return []
        # Check the spheres around the shapes first: most pairs are far apart.
        placements = self.kinematics.data.oMi
        turns = np.array([place.rotation for place in placements])
        moves = np.array([place.translation for place in placements])
        first, second = self._spheres[:, 0].astype(int), self._spheres[:, 1].astype(int)
        between = (
            np.einsum("kij,kj->ki", turns[first], self._spheres[:, 2:5])
            + moves[first]
            - np.einsum("kij,kj->ki", turns[second], self._spheres[:, 5:8])
            - moves[second]
        )
        close = np.flatnonzero(
            np.einsum("ki,ki->k", between, between) < (self._spheres[:, 8] + NEAR) ** 2
        )
        left_out = {link for pair in meeting for link in self._tips_of(pair)}
        pairs = (k for i in close.tolist() if self._links[k := self._others[i]] not in left_out)
        return [self._row(k) for k in pairs if self._distance(k).min_distance < NEAR]

    def _distance(self, pair: int) -> coal.DistanceResult:
        return pin.computeDistance(self._model, self._data, pair)

    def _row(self, pair: int) -> Row:
        result = self._distance(pair)
        first, second = (self._support[self.geometry.shapes[i].body] for i in self._shapes_of(pair))
        # The work that a unit force along the normal does on the motion of each joint.
        points = np.array([result.getNearestPoint1(), result.getNearestPoint2()])
        x, y, z = result.normal
        turns = points @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]).T
        straight = result.normal @ self._jacobian[:3]
        work = turns @ self._jacobian[3:]
        along = second * (straight + work[1]) - first * (straight + work[0])
        return float(result.min_distance), along @ self._by_actuator
