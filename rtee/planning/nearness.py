"""How near a hand is to an object while both move: lower bounds, and distances where they matter.

A distance of two convex parts costs microseconds, and a hand has dozens of parts, an object a few:
most of the distances that a search might ask for are not worth measuring. What was measured last
says a lot about what comes next. The gap between two planes across the closest points is never more
than the distance of the parts, inside of each other or not; so where the object moves, the gap
grows or shrinks by what it moves along the normal, and where a shape of the hand moves, by no more
than that shape moves.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.planning.postures import HandPose
from rtee.planning.scene import NOWHERE, TOUCH, GraspScene, Measured, Touch
from rtee.sample import BoolArray, FloatArray

_EXACT: Final = 5e-6
"""What Coal's distances and normals are exact to [m]: its iterations end at 1e-6 of a length."""


class Nearness:
    """Lower bounds of the distances between the shapes of a hand and the pieces of an object.

    The caller says by `pushed` and `closed` how hand and object have moved since, and what it hands
    over as ``at`` and ``pose`` is where they are then. The object does not turn.

    Args:
        scene: The hand and the object.
        at: Where the hand is.
        pose: Pose of the object ``(4, 4)`` in the base frame.
    """

    def __init__(self, scene: GraspScene, at: HandPose, pose: FloatArray) -> None:
        self._scene, self._pieces = scene, len(scene.object.pieces)
        gaps, normals = scene.gaps(at, pose)
        # A pair of a shape and a piece has one number, as in an array (shapes, pieces). Its bound
        # follows every move; where its planes were is kept as well, to look at the gap again.
        self._bounds = gaps.ravel()
        self._in_shape = (normals @ at.turns).reshape(-1, 3)
        self._normals = normals.reshape(-1, 3)
        self._shapes = np.repeat(np.arange(len(gaps)), self._pieces)
        self._radii = scene.postures.radii[self._shapes]
        self._begin = self._bounds - self._between(slice(None), at, pose)
        self._known: dict[int, Measured] = {}

    def pushed(self, way: FloatArray) -> None:
        """Take into account that the object has moved by ``(3,)`` [m]."""
        self._known.clear()
        self._bounds += self._normals @ way

    def closed(self, ways: FloatArray) -> None:
        """Take into account that the shapes have moved, by so much at most ``(n,)`` [m]."""
        self._known.clear()
        self._bounds -= ways[self._shapes]

    def touching(
        self, at: HandPose, pose: FloatArray, among: BoolArray | None = None
    ) -> list[Touch]:
        """Return the shapes that touch the object, in their order.

        Args:
            at: Where the hand is.
            pose: Pose of the object.
            among: Which shapes are looked at ``(n,)``; all unless given.
        """
        near = self._bounds <= TOUCH
        pairs = np.flatnonzero(near if among is None else near & among[self._shapes])
        if not len(pairs):
            return []
        pairs = pairs[self._refined(pairs, at, pose) <= TOUCH]
        nearest: dict[int, Measured] = {}
        for pair, shape in zip(pairs.tolist(), self._shapes[pairs].tolist(), strict=True):
            found = self._measured(pair, at, pose)
            if found[0] <= TOUCH and (shape not in nearest or found[0] < nearest[shape][0]):
                nearest[shape] = found
        return [Touch(shape, *found) for shape, found in nearest.items()]

    def touch(self, shape: int, at: HandPose, pose: FloatArray) -> Touch:
        """Return how near a shape is to the object, and where if they touch."""
        first = shape * self._pieces
        bounds = self._bounds[first : first + self._pieces].tolist()
        least: Measured | None = None
        # The nearest piece first: its distance rules most others out.
        for piece in sorted(range(self._pieces), key=bounds.__getitem__):
            if least is not None and bounds[piece] > least[0]:
                break
            found = self._measured(first + piece, at, pose)
            if least is None or found[0] < least[0]:
                least = found
        return Touch(shape, *(least or (math.inf, NOWHERE, NOWHERE)))

    def least(
        self,
        at: HandPose,
        pose: FloatArray,
        enough: float,
        paces: FloatArray | None = None,
        among: BoolArray | None = None,
        until: float = 0.0,
        below: float = -math.inf,
    ) -> float:
        """Return the least distance of the hand from the object, or the least time to a contact.

        Args:
            at: Where the hand is.
            pose: Pose of the object.
            enough: More than this need not be exact; then it is what is returned.
            paces: How fast the shapes may come nearer ``(n,)`` [m per unit of time]; without them,
                distances are returned [m].
            among: Which shapes count ``(n,)``; all unless given.
            until: The distance that is a contact [m].
            below: Less than this need not be exact, only below it.
        """
        pace = None if paces is None else paces[self._shapes]
        free = self._bounds - until
        near = (free if pace is None else free / pace) < enough
        pairs = np.flatnonzero(near if among is None else near & among[self._shapes])
        if not len(pairs):
            return enough
        bounds = self._refined(pairs, at, pose) - until
        slow = np.ones(len(pairs)) if pace is None else pace[pairs]
        times, least = bounds / slow, enough
        # The nearest first: its distance rules most others out.
        for k in np.argsort(times, kind="stable").tolist():
            if times[k] >= least or least < below:
                break
            distance = self._measured(int(pairs[k]), at, pose)[0] - until
            least = min(least, distance / float(slow[k]))
        return least

    def _between(
        self, pairs: slice | NDArray[np.intp], at: HandPose, pose: FloatArray
    ) -> FloatArray:
        """Return how far the object's origin is from the shapes' middles along the normals [m]."""
        way = pose[:3, 3] - at.middles[self._shapes[pairs]]
        found: FloatArray = np.add.reduce(self._normals[pairs] * way, axis=1)
        return found

    def _refined(self, pairs: NDArray[np.intp], at: HandPose, pose: FloatArray) -> FloatArray:
        """Return the bounds of some pairs after another look at where they are ``(k,)`` [m]."""
        turns = at.turns[self._shapes[pairs]]
        # The farthest point of a shape along a normal moves with the shape's middle, and by no more
        # than the shape turns times its radius.
        turned = (self._normals[pairs, None] @ turns)[:, 0] - self._in_shape[pairs]
        swung = np.sqrt(np.add.reduce(turned * turned, axis=1)) * self._radii[pairs]
        gaps = self._begin[pairs] + self._between(pairs, at, pose) - swung
        bounds: FloatArray = np.maximum(self._bounds[pairs], gaps)
        self._bounds[pairs] = bounds
        return bounds

    def _measured(self, pair: int, at: HandPose, pose: FloatArray) -> Measured:
        """Return distance, point and normal of a pair, and note them."""
        found = self._known.get(pair)
        if found is None:
            shape, piece = divmod(pair, self._pieces)
            found = self._known[pair] = self._scene.measured(shape, piece, at, pose)
            distance, _, normal = found
            bound = distance - _EXACT
            self._bounds[pair] = bound
            self._begin[pair] = bound - float(normal @ (pose[:3, 3] - at.middles[shape]))
            self._normals[pair] = normal
            self._in_shape[pair] = normal @ at.turns[shape]
        return found
