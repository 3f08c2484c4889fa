"""Distances and contacts of the shapes of two links, independent of earlier measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from rtee.extract.levers import Levers
from rtee.hand.geometry import Shape
from rtee.hand.linalg import dot
from rtee.sample import FloatArray

TOUCH: Final = 1e-8
"""Distance below which surfaces touch [m]: above the rounding errors of Coal."""

_POLYTOPES: Final = 1e-9
"""Precision of distances and penetration depths of boxes, hulls and spheres [m]. With Coal's
default, 1e-6, the last digit decides between two normals whose depths differ by less, and searches
end at such points; distances would depend on the base frame, the order of vertices and earlier
measurements. Cylinders, which have infinitely many faces, keep the default: some queries would not
converge."""

_FAILED: Final = -1e6
"""Distance below which Coal has failed to find a depth [m]: no hand overlaps itself so deeply."""

_CLIMBED: Final = 32
"""Number of vertices above which Coal climbs along edges, starting where its last query ended."""

_MOST_KNOWN: Final = 4096
"""Maximum number of distances that the queries of two links keep, in less than a megabyte."""

_ENDLESS: Final = (coal.Cylinder, coal.BVHModelBase)
"""Shapes that no polytope with finitely many faces represents exactly."""

_FIRST_DIRECTION: Final = np.array([1.0, 0.0, 0.0])
_FIRST_VERTICES: Final = np.zeros(2, dtype=np.int32)

_place, _measure = pin.updateGeometryPlacements, pin.computeDistances


@dataclass(frozen=True, slots=True)
class _Lead:
    """The deepest couple of two links that overlap, when all couples were measured.

    Attributes:
        joints: Joint positions then ``(m,)`` [rad | m].
        levers: Levers of the joints on the shapes ``(m,)``.
        couple: The couple's number.
        first: Its distance [m].
        second: Distance of the next couple [m].
    """

    joints: FloatArray
    levers: FloatArray
    couple: int
    first: float
    second: float


class DistanceQueries:
    """Distances and contacts of two links, by convex parts, coarse shapes, or original geometry.

    One call measures all couples of shapes, one of the first link and one of the second. Coal can
    use the end of a couple's last search as a guess for the next one, which changes the last digits
    of results. Here, every search starts from the same guess, so that results depend on the posture
    alone. For convex shapes, this is Coal's default; for original meshes, the guess must be reset
    before each query.

    Attributes:
        couples: Indices of the couples' shapes in the scene.
        slack: Largest excess of the bodies' distance over that of the convex parts [m].
        measures_meshes: Whether any of the shapes is an original mesh, which is slow.
        remembers: Whether Coal remembers where its last search on a hull ended, which changes the
            next distance from a cylinder by about 10 nm; only new queries have no memory.
        results: Coal's last distance result for each couple.
    """

    def __init__(
        self,
        robot: tuple[pin.Model, pin.Data],
        shapes: Sequence[Shape],
        first: Sequence[int],
        second: Sequence[int],
        bodies: Mapping[int, coal.CollisionGeometry],
        *,
        coarse: bool = False,
        slack: float = 0.0,
        levers: Levers | None = None,
    ) -> None:
        """Prepare the couples of two links.

        Args:
            robot: Model and data of the hand; the data has the joint placements.
            shapes: All shapes.
            first: Indices of the first link's shapes.
            second: Indices of the second link's shapes.
            bodies: Geometry of each shape, by its index: its convex part, its coarse shape, or its
                original geometry.
            coarse: Whether to measure for a search, with more precise distances of polytopes.
            slack: Largest excess of the bodies' distance over that of the convex parts [m].
            levers: Levers of the joints on the shapes, if only the nearest couple matters.
        """
        self.slack = slack
        self.couples = tuple((i, j) for i in first for j in second)
        self._robot, self._robot_data = robot
        self._model = pin.GeometryModel()
        number = {}
        self.measures_meshes = False
        for i in (*first, *second):
            shape, body = shapes[i], bodies[i]
            self.measures_meshes |= isinstance(body, coal.BVHModelBase)
            placed = pin.GeometryObject(str(i), shape.body, shape.placement, body)
            number[i] = self._model.addGeometryObject(placed)
        self._precise, self.remembers, hulls = [], False, False
        for couple in self.couples:
            self._model.addCollisionPair(pin.CollisionPair(*(number[n] for n in couple)))
            # Only flat faces have exact depths.
            flat = not any(isinstance(bodies[n], _ENDLESS) for n in couple)
            hull = flat and any(shapes[n].is_mesh for n in couple)
            hulls |= hull
            self._precise.append(flat and (coarse or hull))
            self.remembers |= not hull and any(
                isinstance(bodies[n], coal.ConvexBase) and bodies[n].num_points > _CLIMBED
                for n in couple
            )
        self._levers: FloatArray | None = None
        self._movers: NDArray[np.intp] | None = None
        self._known: dict[bytes, float] = {}
        # Several hulls are slow; one, or primitives, are measured as fast as anything is compared.
        if levers is not None and hulls and len(self.couples) > 1 and not self.remembers:
            self._levers = levers.between(first, second)
            self._movers = levers.movers((*first, *second))
        self.forget()

    def forget(self) -> None:
        """Reset Coal's memory of earlier measurements."""
        self._data = self._model.createData()
        distance = coal.DistanceRequest()
        # One contact suffices to know whether they touch.
        collision = coal.CollisionRequest(coal.CollisionRequestFlag.NO_REQUEST, 1)
        if self.measures_meshes:
            distance.gjk_initial_guess = collision.gjk_initial_guess = coal.CachedGuess
        for k in range(len(self.couples)):
            self._data.distanceRequests[k] = distance
            self._data.collisionRequests[k] = collision
        # The elements are Pinocchio's own requests, so that the changes below take effect.
        self._distances = list(self._data.distanceRequests)
        for request, precise in zip(self._distances, self._precise, strict=True):
            if precise:
                request.epa_tolerance = request.gjk_tolerance = _POLYTOPES
        self._collisions = list(self._data.collisionRequests)
        self.results: Any = list(self._data.distanceResults)
        self._lead: _Lead | None = None
        self._measured: FloatArray | None = None
        self._placed: FloatArray | None = None
        self._least = (0.0, 0)

    @property
    def used(self) -> bool:
        """Whether anything was measured since the last `forget`."""
        return self._placed is not None

    def distance(self, joints: FloatArray) -> float:
        """Return the least distance [m], known if the links have been in the same place before.

        Unlike after `least`, the results may be those of another posture. Searches often move one
        finger, while the tips of two others stay where they are.
        """
        if self._movers is None or joints is self._measured:
            return self.least(joints)[0]
        key = joints[self._movers].tobytes()
        known = self._known.get(key)
        if known is None:
            if len(self._known) >= _MOST_KNOWN:
                self._known.clear()
            known = self._known[key] = self.least(joints)[0]
        return known

    def least(self, joints: FloatArray, convex: DistanceQueries | None = None) -> tuple[float, int]:
        """Return the links' least distance [m] and the number of the nearest couple of shapes.

        The distance is negative if convex shapes overlap. With ``convex``, the queries of the
        convex parts, couples whose convex parts are farther apart than the nearest couple are not
        measured.

        Args:
            joints: Joint positions ``(m,)`` [rad | m] for which the data has the placements; a new
                array for each placement.
            convex: Queries of the convex parts at the same positions.
        """
        # Cached, since goal, constraints and checks request it at the same posture.
        if joints is not self._measured:
            _place(self._robot, self._robot_data, self._model, self._data)
            if self.measures_meshes:
                for request in self._distances:
                    _forget(request)
            if convex is not None:
                k = self._nearest([result.min_distance for result in convex.results])
            elif self._lead is None:
                k = _measure(self._model, self._data)
            else:
                k = self._still_nearest(self._lead, joints)
            distance = self.results[k].min_distance
            if distance < _FAILED:
                k = self._measured_again()
                distance = self.results[k].min_distance
            elif distance < 0.0 and self._levers is not None and self._lead is None:
                others = [result.min_distance for result in self.results]
                del others[k]
                self._lead = _Lead(joints, self._levers, k, distance, min(others))
            self._least = distance, k
            self._measured = self._placed = joints
        return self._least

    def _nearest(self, bounds: Sequence[float]) -> int:
        """Return the number of the nearest couple, using lower bounds on all distances [m]."""
        nearest = (np.inf, 0)
        for bound, k in sorted((bound, k) for k, bound in enumerate(bounds)):
            if bound - TOUCH > nearest[0]:
                break
            pin.computeDistance(self._model, self._data, k)
            nearest = min(nearest, (self.results[k].min_distance, k))
        return nearest[1]

    def _still_nearest(self, lead: _Lead, joints: FloatArray) -> int:
        """Return the number of the nearest couple, which most often is the leading one."""
        # No other couple can have come nearer than this since all were measured.
        others = lead.second - dot(lead.levers, np.abs(joints - lead.joints))
        if lead.first < others:
            pin.computeDistance(self._model, self._data, lead.couple)
            if self.results[lead.couple].min_distance < others - TOUCH:
                return lead.couple
        self._lead = None
        k: int = _measure(self._model, self._data)
        return k

    def _measured_again(self) -> int:
        """Measure failed depths again, less precisely; return the number of the nearest couple."""
        _measure(self._model, self._data)  # all couples, since some may have been skipped
        for k, request in enumerate(self._distances):
            precision = request.epa_tolerance
            # Only for this query; the tolerance is restored below.
            while self.results[k].min_distance < _FAILED and request.epa_tolerance < 1.0:
                request.epa_tolerance *= 10.0
                pin.computeDistance(self._model, self._data, k)
            request.epa_tolerance = precision
        return min(range(len(self.results)), key=lambda k: float(self.results[k].min_distance))

    def collide(self, couple: int, joints: FloatArray, margin: float) -> bool:
        """Return whether the surfaces of a couple are closer than a margin [m].

        Use a margin of 10 nm for contact: if a triangle lies symmetrically in a primitive, Coal
        returns a distance of the order of rounding errors instead of a collision. Primitives are
        solid. ``joints`` are the joint positions, as in `least`.
        """
        if joints is not self._placed:
            _place(self._robot, self._robot_data, self._model, self._data)
            self._placed = joints
        request = self._collisions[couple]
        request.security_margin = margin
        if self.measures_meshes:
            _forget(request)
        return bool(pin.computeCollision(self._model, self._data, couple))


def _forget(request: coal.QueryRequest) -> None:
    request.cached_gjk_guess = _FIRST_DIRECTION
    request.cached_support_func_guess = _FIRST_VERTICES
