"""Distances and contacts of shapes, the same whatever was asked before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import pinocchio as pin

from rtee.hand.geometry import Shape

TOUCH: Final = 1e-8
"""Surfaces closer than this touch [m]."""

_FIRST_DIRECTION: Final = np.array([1.0, 0.0, 0.0])
_FIRST_VERTICES: Final = np.zeros(2, dtype=np.int32)


class Forms:
    """Shapes in one of their two forms, convex or exact, at a posture.

    Pinocchio keeps where Coal's last search of a couple ended as a guess for the next one, which
    moves results in their last digits. Here every search begins from the same guess, so that
    results depend on the posture alone.
    """

    def __init__(
        self, shapes: Sequence[Shape], couples: Sequence[tuple[int, int]], *, convex: bool
    ) -> None:
        """Prepare couples of shapes.

        Args:
            shapes: The shapes.
            couples: Pairs of their indices.
            convex: Take the convex parts instead of the geometry as given.
        """
        self._model = pin.GeometryModel()
        for i, shape in enumerate(shapes):
            form = shape.convex if convex else shape.exact
            placed = pin.GeometryObject(str(i), shape.body, shape.placement, form)
            self._model.addGeometryObject(placed)
        for i, j in couples:
            self._model.addCollisionPair(pin.CollisionPair(i, j))
        self._data = self._model.createData()
        self._distances = list(self._data.distanceRequests)
        self._collisions = list(self._data.collisionRequests)
        for request in self._collisions:
            request.security_margin = TOUCH
        self.results: Any = self._data.distanceResults
        """Coal's last distance result of every couple."""

    def place(self, model: pin.Model, data: pin.Data) -> None:
        """Take over the placements of the joints."""
        pin.updateGeometryPlacements(model, data, self._model, self._data)

    def pose(self, shape: int) -> pin.SE3:
        """Return the pose of a shape in the base frame, valid until the next placement."""
        return self._data.oMg[shape]

    def distance(self, couple: int) -> float:
        """Return the distance of a couple [m], negative where convex shapes overlap."""
        request = self._distances[couple]
        request.cached_gjk_guess = _FIRST_DIRECTION
        request.cached_support_func_guess = _FIRST_VERTICES
        found = pin.computeDistance(self._model, self._data, couple)
        distance: float = found.min_distance
        return distance

    def collide(self, couple: int) -> bool:
        """Return whether the surfaces of a couple meet; primitives are solid.

        They meet where they are closer than 10 nm: where a triangle lies symmetrically in a
        primitive, Coal finds a distance of the order of rounding errors instead of a collision.
        """
        request = self._collisions[couple]
        request.cached_gjk_guess = _FIRST_DIRECTION
        request.cached_support_func_guess = _FIRST_VERTICES
        return bool(pin.computeCollision(self._model, self._data, couple))
