"""The hand as the searches see it: signed distances with gradients, and exact contact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pinocchio as pin

from rtee.extract.couplings import Couplings
from rtee.extract.space import Space
from rtee.extract.surface import encloses
from rtee.hand.geometry import HandGeometry
from rtee.hand.kinematics import Kinematics
from rtee.hand.model import Hand
from rtee.types import FloatArray


@dataclass(frozen=True, slots=True)
class LinkPair:
    """Two links and the pairs of their shapes.

    Attributes:
        links: The links' names.
        bodies: The joints that carry them, 0 for the base.
        pairs: Indices of the shapes' pairs in the scene.
        moved_by: 1 for joints that move the second link, -1 the first; 0 for none or both ``(m,)``.
        actuators: The actuators that move the links against each other.
        turned: Whether the shapes' pairs are in the other order than the links.
    """

    links: tuple[str, str]
    bodies: tuple[int, int]
    pairs: tuple[int, ...]
    moved_by: FloatArray
    actuators: frozenset[int]
    turned: bool = False

    def reversed(self) -> LinkPair:
        """Return the same pair in the other order."""
        return LinkPair(
            self.links[::-1],
            self.bodies[::-1],
            self.pairs,
            -self.moved_by,
            self.actuators,
            not self.turned,
        )


@dataclass(frozen=True, slots=True)
class Witness:
    """Where two links are closest, or deepest in each other, in the hand's base frame.

    Attributes:
        distance: Signed distance of their convex parts, negative: depth of penetration [m].
        first: Point on the first link [m].
        second: Point on the second link [m].
        normal: Unit vector from the first link to the second one.
        pair: The pair of shapes.
    """

    distance: float
    first: FloatArray
    second: FloatArray
    normal: FloatArray
    pair: int


class Scene:
    """A hand's links at a posture.

    `place` moves everything to a posture; what is asked afterwards is answered there.

    The signed distance of two links is the least over the pairs of their convex parts: the
    distance of the parts, or minus the depth, the shortest translation that separates them. Its
    derivative by the actuators is ``n · (J_p2 - J_p1) · dq/du`` with the witness points ``p1, p2``
    and the normal ``n``, and exact wherever these are unique.

    Attributes:
        hand: The hand.
        geometry: Its collision geometry.
        couplings: Its transmission.
        pairs: All pairs of links that have geometry and move against each other, by names in the
            order of the URDF's tree.
    """

    def __init__(self, hand: Hand) -> None:
        """Read the geometry of a hand.

        Raises:
            ModelError: A mesh is missing or cannot be read.
        """
        self.hand = hand
        self.kinematics = Kinematics(hand)
        self.geometry = HandGeometry(hand, self.kinematics)
        everything = tuple(range(len(self.geometry.shapes)))
        self._convex = self.geometry.model(everything, convex=True)
        self._exact = self.geometry.model(everything, convex=False)
        self.pairs: dict[tuple[str, str], LinkPair] = {}
        self._shapes: list[tuple[int, int]] = []
        links = list(dict.fromkeys(shape.link for shape in self.geometry.shapes))
        for first, second in combinations(links, 2):
            self._add_pair(first, second)
        self._model = self.kinematics.model
        self._data = self.kinematics.data
        self._convex_data = self._convex.createData()
        self._exact_data = self._exact.createData()
        self.couplings = Couplings(hand)
        self._slope = self.couplings.slope(hand.rest)
        self._row = np.empty(6)
        self._exact_placed = False

    def _add_pair(self, first: str, second: str) -> None:
        bodies = (self.kinematics.body(first), self.kinematics.body(second))
        if bodies[0] == bodies[1]:
            return
        support = self.kinematics.support
        moved_by = support(bodies[1]) - support(bodies[0])
        indices = []
        for i in self.geometry.of_link(first):
            for j in self.geometry.of_link(second):
                k = len(self._shapes)
                indices.append(k)
                self._shapes.append((i, j))
                self._convex.addCollisionPair(pin.CollisionPair(i, j))
                self._exact.addCollisionPair(pin.CollisionPair(i, j))
        moves = [self.hand.transmission.moves(j) for j in np.flatnonzero(moved_by).tolist()]
        actuators = frozenset(i for i in moves if i is not None)
        self.pairs[first, second] = LinkPair(
            (first, second), bodies, tuple(indices), moved_by, actuators
        )

    def pair(self, first: str, second: str) -> LinkPair | None:
        """Return a pair of links in the order asked for; ``None`` if they never move apart."""
        if (first, second) in self.pairs:
            return self.pairs[first, second]
        pair = self.pairs.get((second, first))
        return pair.reversed() if pair else None

    def place(self, u: FloatArray) -> None:
        """Move all links to a posture.

        Args:
            u: Actuator positions ``(n,)`` [rad | m].
        """
        pin.computeJointJacobians(self._model, self._data, self.couplings.joints(u))
        pin.updateGeometryPlacements(self._model, self._data, self._convex, self._convex_data)
        if not self.couplings.linear:
            self._slope = self.couplings.slope(u)
        self._exact_placed = False

    def distance(self, pair: LinkPair) -> float:
        """Return the signed distance of two links [m]."""
        return min(
            pin.computeDistance(self._convex, self._convex_data, k).min_distance for k in pair.pairs
        )

    def slope(self, pair: LinkPair, space: Space) -> tuple[float, FloatArray]:
        """Return the signed distance of two links and its derivative.

        Returns:
            The distance [m] and its derivative by the coordinates of the space ``(k,)`` [m].
        """
        least, closest = np.inf, None
        for k in pair.pairs:
            result = pin.computeDistance(self._convex, self._convex_data, k)
            if result.min_distance < least:
                least, closest = result.min_distance, result
        assert closest is not None  # noqa: S101 - a pair has shapes
        normal, point = closest.normal, closest.getNearestPoint1()
        return least, self._derivative(-normal if pair.turned else normal, point, pair, space)

    def exact_slope(self, pair: LinkPair, space: Space) -> tuple[float, FloatArray]:
        """Return the distance of two links' geometry as given and its derivative, as `slope`.

        Both are 0 where they touch.
        """
        if self.touching(pair):
            return 0.0, np.zeros(space.size)
        found = self.exact_witness(pair)
        return found.distance, self._derivative(found.normal, found.first, pair, space)

    def _derivative(
        self, normal: FloatArray, point: FloatArray, pair: LinkPair, space: Space
    ) -> FloatArray:
        row, n, p = self._row, normal, point
        row[0], row[1], row[2] = n
        row[3] = p[1] * n[2] - p[2] * n[1]
        row[4] = p[2] * n[0] - p[0] * n[2]
        row[5] = p[0] * n[1] - p[1] * n[0]
        by_joint = (row @ self._data.J) * pair.moved_by
        result: FloatArray = (by_joint @ self._slope[:, space.index]) * space.extent
        return result

    def witness(self, pair: LinkPair) -> Witness:
        """Return where two links' convex parts are closest or deepest in each other."""
        return _witness(pair, self._convex, self._convex_data)

    def touching(self, pair: LinkPair) -> bool:
        """Return whether two links touch: their geometry as given, meshes not convexified.

        Meshes touch where their surfaces meet or one lies within the other; primitives are solid.
        """
        return any(self._touching(k) for k in pair.pairs)

    def _touching(self, k: int) -> bool:
        overlap = -pin.computeDistance(self._convex, self._convex_data, k).min_distance
        if overlap < 0.0:
            return False
        i, j = self._shapes[k]
        self._place_exact()
        if pin.computeCollision(self._exact, self._exact_data, k):
            return True
        a, b = self.geometry.shapes[i], self.geometry.shapes[j]
        if overlap < min(a.least_width, b.least_width):
            return False
        to_a = self._exact_data.oMg[i].actInv(self._exact_data.oMg[j])
        return encloses(a, b, to_a) or encloses(b, a, to_a.inverse())

    def exact_distance(self, pair: LinkPair) -> float:
        """Return the distance of two links' geometry as given, 0 where they touch [m]."""
        if self.touching(pair):
            return 0.0
        self._place_exact()
        return max(
            0.0,
            min(
                float(pin.computeDistance(self._exact, self._exact_data, k).min_distance)
                for k in pair.pairs
            ),
        )

    def exact_witness(self, pair: LinkPair) -> Witness:
        """Return where two links that do not touch are closest, in their geometry as given."""
        self._place_exact()
        found = _witness(pair, self._exact, self._exact_data)
        gap = found.second - found.first
        length = float(np.linalg.norm(gap))
        return found if length == 0.0 else replace(found, normal=gap / length)

    def point_jacobian(self, link: str, point: FloatArray) -> FloatArray:
        """Return the Jacobian ``(3, n)`` of a point of a link by the actuators, base frame [m]."""
        jacobian = self._data.J.reshape(6, -1) * self.kinematics.support(self.kinematics.body(link))
        jacobian = jacobian[:3] - pin.skew(point) @ jacobian[3:]
        result: FloatArray = jacobian @ self._slope
        return result

    def origin(self, link: str) -> FloatArray:
        """Return the origin of a link's frame in the base frame [m]."""
        body, placement = self.kinematics.bodies[link]
        return np.array((self._data.oMi[body] * placement).translation)

    def shape_pose(self, shape: int) -> pin.SE3:
        """Return the pose of a shape in the base frame."""
        return self._convex_data.oMg[shape]

    def _place_exact(self) -> None:
        if not self._exact_placed:
            pin.updateGeometryPlacements(self._model, self._data, self._exact, self._exact_data)
            self._exact_placed = True


def _witness(pair: LinkPair, model: pin.GeometryModel, data: pin.GeometryData) -> Witness:
    least, result = np.inf, None
    for k in pair.pairs:
        pin.computeDistance(model, data, k)
        if data.distanceResults[k].min_distance < least:
            result = data.distanceResults[k]
            least, chosen = result.min_distance, k
    assert result is not None  # noqa: S101 - a pair has shapes
    points = [np.array(result.getNearestPoint1()), np.array(result.getNearestPoint2())]
    normal = np.array(result.normal)
    if pair.turned:
        points, normal = points[::-1], -normal
    return Witness(float(least), points[0], points[1], normal, chosen)
