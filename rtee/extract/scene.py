"""The hand's links at a posture, with signed distances, their gradients, and exact contact."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np
import pinocchio as pin

from rtee.extract.coarse_shapes import CoarseShape, coarse_shape, least_width, outer
from rtee.extract.couplings import Couplings
from rtee.extract.distance_queries import TOUCH, DistanceQueries
from rtee.extract.hinge import TipShape, clip_tips
from rtee.extract.levers import Levers
from rtee.extract.pairs import LinkPair, Witness
from rtee.extract.space import Space
from rtee.extract.surface import encloses
from rtee.hand.geometry import HandGeometry, Shape
from rtee.hand.kinematics import Kinematics
from rtee.hand.linalg import matmul, matvec, norm, vecmat
from rtee.hand.model import Hand
from rtee.hand.pairs import Pairs
from rtee.sample import FloatArray
from rtee.types import JointKind

_BATCH: Final = 3
"""Number of derivatives from which it is faster to sum them before the last products."""

_MOST_STACKS: Final = 1024
"""Maximum number of cached stacks of `LinkPair.moved_by`; a search uses a few dozen."""

_COLLIDE: Final = 1
_DISTANCE: Final = 6
"""Costs of queries of two meshes, for contact and for distance: about 2 ms and 12 ms for a few
thousand triangles."""

_sum = np.add.reduce


class Scene:
    """A hand's links at a posture.

    `place` moves all links to a posture; all other methods measure there.

    Distances and derivatives are those of coarse shapes, which lie about 0.1 mm inside the convex
    parts of cylinders and finely meshed links; `fine` measures the full parts. Contact, witnesses
    and all stored values always come from the full geometry.

    The signed distance of two links is the least over the pairs of their convex parts: the
    distance between the parts, or minus the depth, the shortest translation that separates them.
    Its derivative by the actuators is ``n · (J_p2 - J_p1) · dq/du`` with the witness points
    ``p1, p2`` and the normal ``n``; it is exact where these are unique.

    Attributes:
        hand: The hand.
        geometry: Collision geometry of the hand.
        couplings: Transmission of the hand.
        shapes: All collision shapes, and the clipped shapes of joined tips.
        levers: Levers of the joints on the shapes.
        pairs: All pairs of links that have geometry and different bodies, by names in the order of
            the URDF's tree.
        joints: Joint positions at the posture ``(m,)`` [rad | m].
        query_cost: Cost of queries on original meshes so far, in units of a contact query.
        tips: The pairs of fingertips that actuators move relative to each other, in the order of
            the fingers.
        unit: Length in this hand that represents one metre of the original hand [m].
    """

    def __init__(self, hand: Hand, unit: float = 1.0) -> None:
        """Read the geometry of a hand.

        Args:
            hand: The hand, which may be a scaled copy of the original hand.
            unit: Length in this hand that represents one metre of the original hand [m].

        Raises:
            ModelError: A mesh is missing or cannot be read.
        """
        self.hand = hand
        self.unit = unit
        self.kinematics = Kinematics(hand)
        self.geometry = HandGeometry(hand, self.kinematics)
        self.couplings = Couplings(hand)
        self.shapes: list[Shape] = list(self.geometry.shapes)
        self.levers = Levers(self.kinematics, self.shapes)
        self.pairs: Pairs[str, LinkPair] = Pairs(turned=LinkPair.reversed)
        self._couples = 0  # numbers the pairs
        links = list(dict.fromkeys(shape.link for shape in self.shapes))
        for first, second in combinations(links, 2):
            shapes = (self.geometry.of_links(first), self.geometry.of_links(second))
            pair = self._couple((first, second), shapes)
            if pair is not None:
                self.pairs[first, second] = pair
        self._model = self.kinematics.model
        self._data = self.kinematics.data
        self._slope = self.couplings.slope(hand.rest)
        # Queries by number of the pair, made when the pair is first measured.
        self._rough: dict[int, DistanceQueries] = {}
        self._convex: dict[int, DistanceQueries] = {}
        self._exact: dict[int, DistanceQueries] = {}
        self._searched = self._rough
        self._coarse_shapes: dict[int, CoarseShape] = {}
        self.query_cost = 0
        self._widths: dict[int, float] = {}
        self._outers: dict[tuple[int, ...], tuple[int, ...]] = {}
        self._stacks: dict[tuple[tuple[int, bool], ...], FloatArray] = {}
        self._joints = np.zeros((6, self._model.nv))
        self._jacobian_at: FloatArray | None = None
        # Place the hand at rest, where `_tip_pairs` tests which joined tips touch.
        self.place(hand.rest)
        self.tips = self._tip_pairs()

    def _couple(
        self, links: tuple[str, str], shapes: tuple[tuple[int, ...], tuple[int, ...]]
    ) -> LinkPair | None:
        bodies = (self.kinematics.body(links[0]), self.kinematics.body(links[1]))
        if bodies[0] == bodies[1]:
            return None
        support = self.kinematics.support
        moved_by = support(bodies[1]) - support(bodies[0])
        moves = [self.hand.transmission.moves(j) for j in np.flatnonzero(moved_by).tolist()]
        actuators = frozenset(i for i in moves if i is not None)
        # Numbers identify pairs, since a clipped pair has the same names as the whole one.
        self._couples += 1
        return LinkPair(links, bodies, shapes, self._couples, moved_by, actuators)

    def _tip_pairs(self) -> Pairs[str, LinkPair]:
        """Return the pairs of fingertips; clip joined tips to the parts that can pinch."""
        tips = {f.tip: f.tip_links for f in self.hand.fingers if f.tip}
        pairs: Pairs[str, LinkPair] = Pairs(turned=LinkPair.reversed)
        for first, second in combinations(tips, 2):
            pair = self._tip_pair((first, second), (tips[first], tips[second]))
            if pair is not None and self._joined(pair) and self.touching(pair):
                pair = self._clipped(pair)
            if pair is not None and pair.actuators:
                pairs[first, second] = pair
        return pairs

    def _tip_pair(
        self, tips: tuple[str, str], links: tuple[Sequence[str], Sequence[str]]
    ) -> LinkPair | None:
        """Return the pair of two fingertips, each with the shapes of all its links."""
        if len(links[0]) == len(links[1]) == 1:
            return self.pair(*tips)
        of_links = self.geometry.of_links
        return self._couple(tips, (of_links(*links[0]), of_links(*links[1])))

    def _joined(self, pair: LinkPair) -> bool:
        first, second = pair.bodies
        parents = self._model.parents
        return bool(parents[first] == second or parents[second] == first)

    def _clipped(self, pair: LinkPair) -> LinkPair | None:
        moving = max(pair.bodies)
        # The jaws of a prismatic joint have no axis.
        if self.hand.joints[moving - 1].kind is JointKind.PRISMATIC:
            return None
        placement = self._data.oMi[moving]
        spec = self.hand.urdf.joints[self.hand.joints[moving - 1].name]
        origin, axis = (
            np.array(placement.translation),
            matvec(placement.rotation, np.array(spec.axis)),
        )
        first, second = (
            [TipShape(self.shapes[i], self.shape_pose(i).copy(), origin, axis) for i in tip]
            for tip in pair.shapes
        )
        parts = clip_tips(first, second)
        if not parts[0] or not parts[1]:
            return None
        begin = len(self.shapes)
        self.shapes += [*parts[0], *parts[1]]
        middle, end = begin + len(parts[0]), len(self.shapes)
        shapes = (tuple(range(begin, middle)), tuple(range(middle, end)))
        return self._couple(pair.links, shapes)

    def pair(self, first: str, second: str) -> LinkPair | None:
        """Return a pair of links in this order; ``None`` if they form one rigid body."""
        pair: LinkPair | None = self.pairs.get((first, second))
        return pair

    def place(self, u: FloatArray) -> None:
        """Move all links to actuator positions ``(n,)`` [rad | m]."""
        # A new array, which tells all measurements that they are at another posture.
        self.joints = self.couplings.joints(u)
        pin.forwardKinematics(self._model, self._data, self.joints)
        self._at = u

    def distance(self, pair: LinkPair) -> float:
        """Return the signed distance of two links [m]."""
        queries = self._searched.get(pair.number) or self._queries(pair, self._searched)
        return queries.distance(self.joints)

    def at_least(self, pair: LinkPair) -> float:
        """Return a lower bound on the signed distance of two links' full convex parts [m]."""
        queries = self._searched.get(pair.number) or self._queries(pair, self._searched)
        return queries.distance(self.joints) - queries.slack

    def distances(self, pairs: Sequence[LinkPair]) -> list[float]:
        """Return the signed distances of several pairs of links [m]."""
        known, joints = self._searched, self.joints
        return [(known.get(p.number) or self._queries(p, known)).distance(joints) for p in pairs]

    def derivative(self, pair: LinkPair, space: Space) -> FloatArray:
        """Return the derivative of the distance of two links by coordinates ``(k,)`` [m]."""
        queries = self._searched.get(pair.number) or self._queries(pair, self._searched)
        result = queries.results[queries.least(self.joints)[1]]
        normal = -result.normal if pair.turned else result.normal
        return self._derivative(normal, result.getNearestPoint1(), pair, space)

    def gradient(self, terms: Sequence[tuple[LinkPair, float]], space: Space) -> FloatArray:
        """Return the derivative of a weighted sum of distances; see `derivative`."""
        if len(terms) < _BATCH:
            result: FloatArray = np.zeros(space.size)
            for pair, weight in terms:
                result += weight * self.derivative(pair, space)
            return result
        rows, joints, known = [], self.joints, self._searched
        for pair, weight in terms:
            queries = known.get(pair.number) or self._queries(pair, known)
            nearest = queries.results[queries.least(joints)[1]]
            sign = -weight if pair.turned else weight
            x, y, z = nearest.normal.tolist()
            x, y, z = x * sign, y * sign, z * sign
            a, b, c = nearest.getNearestPoint1().tolist()
            rows.append((x, y, z, b * z - c * y, c * x - a * z, a * y - b * x))
        torques = matmul(np.array(rows), self._jacobian())
        torques *= self._moved_by(tuple([(pair.number, pair.turned) for pair, _ in terms]), terms)
        return vecmat(_sum(torques, axis=0), self._moved(space))

    def _moved_by(
        self, key: tuple[tuple[int, bool], ...], terms: Sequence[tuple[LinkPair, float]]
    ) -> FloatArray:
        """Return the stacked `LinkPair.moved_by` of pairs ``(p, m)``, cached by set of pairs."""
        known = self._stacks.get(key)
        if known is None:
            if len(self._stacks) >= _MOST_STACKS:
                # All at once, since the sets of earlier searches are hardly used again.
                self._stacks.clear()
            known = self._stacks[key] = np.array([pair.moved_by for pair, _ in terms])
        return known

    def exact_slope(self, pair: LinkPair, space: Space) -> tuple[float, FloatArray]:
        """Return the distance of two links' original geometry and its derivative.

        Both are 0 in contact.

        Returns:
            The distance [m] and its derivative by the coordinates of the space ``(k,)`` [m].
        """
        if self.exact_distance(pair) == 0.0:
            return 0.0, np.zeros(space.size)
        witness = self.exact_witness(pair)
        return witness.distance, self._derivative(witness.normal, witness.first, pair, space)

    def _derivative(
        self, normal: FloatArray, point: FloatArray, pair: LinkPair, space: Space
    ) -> FloatArray:
        # n · (velocity of a point p) = n · v + (p x n) · w, which is one row times the joint
        # Jacobian; both witness points give the same, since they are on a line along n.
        x, y, z = normal.tolist()
        a, b, c = point.tolist()
        row = np.array([x, y, z, b * z - c * y, c * x - a * z, a * y - b * x])
        return vecmat(vecmat(row, self._jacobian()), self._levers(pair, space))

    def _jacobian(self) -> FloatArray:
        """Return the Jacobian of all joints in the base frame ``(6, m)``."""
        if self._jacobian_at is not self.joints:
            pin.computeJointJacobians(self._model, self._data)
            if not self.couplings.linear:
                self._slope = self.couplings.slope(self._at)
            # Computed once per posture, and only if a derivative is needed.
            self._jacobian_at = self.joints
            self._joints = self._data.J.reshape(6, -1)
        return self._joints

    def _levers(self, pair: LinkPair, space: Space) -> FloatArray:
        """Return the derivative of the joints between two links by the coordinates ``(m, k)``."""
        # Constant for linear couplings, and cached for each pair and space.
        key = (pair.number, pair.turned)
        known = space.levers.get(key)
        if known is None or not self.couplings.linear:
            known = space.levers[key] = pair.moved_by[:, None] * self._moved(space)
        return known

    def _moved(self, space: Space) -> FloatArray:
        """Return the derivative of all joints by the coordinates ``(m, k)``."""
        known = space.levers.get(None)
        if known is None or not self.couplings.linear:
            known = space.levers[None] = self._slope[:, space.index] * space.extent
        return known

    def witness(self, pair: LinkPair) -> Witness:
        """Return the closest or deepest points of two links' convex parts."""
        queries = self._queries(pair, self._convex)
        # New queries have no memory, so that evidence does not depend on earlier measurements.
        if queries.remembers:
            queries = self._undrafted(pair, convex=True)
        return _witness(pair, queries, self.joints)

    def forget(self) -> None:
        """Drop Coal's memory of earlier queries, which changes later results by about 10 nm."""
        for known in (self._rough, self._convex):
            for queries in known.values():
                if queries.remembers and queries.used:
                    queries.forget()

    def touching(self, pair: LinkPair, *, surfaces: bool = True) -> bool:
        """Return whether the original geometry of two links touches.

        Meshes touch if their surfaces intersect or one is inside the other; primitives are solid.
        If ``surfaces`` is false, the surfaces are known not to intersect, and are not compared.
        """
        return self.nearer(pair, TOUCH, surfaces=surfaces)

    def nearer(self, pair: LinkPair, margin: float, *, surfaces: bool = True) -> bool:
        """Return whether two links touch or are nearer to each other than a margin.

        Args:
            pair: The links.
            margin: The margin [m].
            surfaces: Whether to compare the surfaces; false if they are known to be farther apart.
        """
        if self.at_least(pair) > margin:
            return False
        convex = self._queries(pair, self._convex)
        if convex.least(self.joints)[0] > margin:
            return False
        results = convex.results
        return any(
            self._nearer(pair, k, couple, margin, surfaces=surfaces)
            for k, couple in enumerate(convex.couples)
            if results[k].min_distance <= margin
        )

    def _nearer(
        self,
        pair: LinkPair,
        k: int,
        couple: tuple[int, int],
        margin: float,
        *,
        surfaces: bool = True,
    ) -> bool:
        """Return whether two shapes, couple ``k`` of the pair, are nearer than a margin [m].

        Their convex parts must be nearer than the margin. If ``surfaces`` is false, their surfaces
        are known to be farther apart.
        """
        i, j = couple
        a, b = self.shapes[i], self.shapes[j]
        # A convex primitive is its own convex part.
        if not (a.is_mesh or b.is_mesh):  # both already exact; Coal's Boolean query misses some
            return True
        self.query_cost += _COLLIDE
        if surfaces and self._queries(pair, self._exact).collide(k, self.joints, margin):
            return True
        # One mesh may be inside the other without intersecting its surface. The convex parts then
        # overlap by its whole width, so few pairs need the expensive test.
        overlap = -self._queries(pair, self._convex).results[k].min_distance
        if overlap < min(self._width(i), self._width(j)):
            return False
        to_a = self.shape_pose(i).actInv(self.shape_pose(j))
        return encloses(a, b, to_a) or encloses(b, a, to_a.inverse())

    def exact_distance(self, pair: LinkPair) -> float:
        """Return the distance of two links' original geometry, 0 in contact [m]."""
        exact, convex = self._queries(pair, self._exact), self._queries(pair, self._convex)
        if exact.measures_meshes:
            self.query_cost += _DISTANCE
        convex.least(self.joints)
        least = exact.least(self.joints, convex)[0]
        return 0.0 if self.touching(pair, surfaces=least <= TOUCH) else max(0.0, least)

    def exact_witness(self, pair: LinkPair) -> Witness:
        """Return the closest points of the original geometry of two links that do not touch."""
        witness = _witness(pair, self._queries(pair, self._exact), self.joints)
        gap = witness.second - witness.first
        length = norm(gap)
        return witness if length == 0.0 else replace(witness, normal=gap / length)

    def point_jacobian(self, link: str, point: FloatArray) -> FloatArray:
        """Return the Jacobian ``(3, n)`` of a point of a link by the actuators, in the base frame.

        ``point`` is given in the base frame [m].
        """
        jacobian = self._jacobian() * self.kinematics.support(self.kinematics.body(link))
        jacobian = jacobian[:3] - matmul(pin.skew(point), jacobian[3:])
        return matmul(jacobian, self._slope)

    def bodies(self) -> tuple[FloatArray, FloatArray]:
        """Return the rotations ``(b, 3, 3)`` and positions ``(b, 3)`` [m] of all bodies."""
        poses = self._data.oMi.tolist()
        return np.array([p.rotation for p in poses]), np.array([p.translation for p in poses])

    def origin(self, link: str) -> FloatArray:
        """Return the origin of a link's frame in the base frame [m]."""
        body, placement = self.kinematics.bodies[link]
        return np.array((self._data.oMi[body] * placement).translation)

    def shape_pose(self, shape: int) -> pin.SE3:
        """Return the pose of a shape in the base frame."""
        placed = self.shapes[shape]
        return self._data.oMi[placed.body] * placed.placement

    def relative_pose(self, pair: LinkPair, u: FloatArray) -> pin.SE3:
        """Return the pose of the second link's body in that of the first, at a posture ``(n,)``."""
        self.place(u)
        first, second = pair.bodies
        return self._data.oMi[first].actInv(self._data.oMi[second])

    @contextmanager
    def fine(self) -> Iterator[None]:
        """Measure distances and derivatives on the full convex parts within this context."""
        before, self._searched = self._searched, self._convex
        try:
            yield
        finally:
            self._searched = before

    def _coarse_shape(self, shape: int) -> CoarseShape:
        """Return the coarse shape of a shape, which shapes with the same mesh share."""
        # By identity: shapes of one mesh share its geometry, which lives as long as the scene.
        exact = id(self.shapes[shape].exact)
        if exact not in self._coarse_shapes:
            self._coarse_shapes[exact] = coarse_shape(self.shapes[shape])
        return self._coarse_shapes[exact]

    def _outer(self, link: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shapes of a link that are not inside another of its shapes."""
        if link not in self._outers:
            self._outers[link] = outer(self.shapes, {i: self._coarse_shape(i) for i in link}, link)
        return self._outers[link]

    def _width(self, shape: int) -> float:
        """Return a lower bound on the width of a shape's convex part [m]."""
        if shape not in self._widths:
            self._widths[shape] = least_width(self.shapes[shape], self._coarse_shape(shape).shape)
        return self._widths[shape]

    def _queries(self, pair: LinkPair, known: dict[int, DistanceQueries]) -> DistanceQueries:
        """Return the queries of two links from one of the three sets; make them if necessary."""
        queries = known.get(pair.number)
        if queries is None:
            if known is self._rough:
                queries = self._drafted(pair)
            else:
                queries = self._undrafted(pair, convex=known is self._convex)
            known[pair.number] = queries
        return queries

    def _drafted(self, pair: LinkPair) -> DistanceQueries:
        first, second = pair.shapes[::-1] if pair.turned else pair.shapes
        ours, theirs = self._outer(first), self._outer(second)
        slack = max(self._coarse_shape(i).slack for i in ours)
        slack += max(self._coarse_shape(i).slack for i in theirs)
        bodies = {i: self._coarse_shape(i).shape for i in (*ours, *theirs)}
        robot = self._model, self._data
        return DistanceQueries(
            robot,
            self.shapes,
            ours,
            theirs,
            bodies,
            coarse=True,
            slack=slack,
            levers=self.levers,
        )

    def _undrafted(self, pair: LinkPair, *, convex: bool) -> DistanceQueries:
        first, second = pair.shapes[::-1] if pair.turned else pair.shapes
        shapes = {i: self.shapes[i] for i in (*first, *second)}
        bodies = {i: shape.convex if convex else shape.exact for i, shape in shapes.items()}
        return DistanceQueries((self._model, self._data), self.shapes, first, second, bodies)


def _witness(pair: LinkPair, queries: DistanceQueries, joints: FloatArray) -> Witness:
    least, k = queries.least(joints)
    result = queries.results[k]
    points = [np.array(result.getNearestPoint1()), np.array(result.getNearestPoint2())]
    normal = np.array(result.normal)
    if pair.turned:
        points, normal = points[::-1], -normal
    return Witness(float(least), points[0], points[1], normal)
