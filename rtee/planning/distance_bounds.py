"""Lower bounds on the distance of a moving hand to an object; exact distances where they matter.

A distance of two convex parts costs microseconds, and a hand has dozens of parts, an object a few:
most of the distances that a search might ask for are not worth measuring. The last
measurement bounds the next one: the gap between two planes through the closest points never exceeds
the distance of the parts, even if they overlap. When the object moves, the gap changes by its
displacement along the normal; when a shape of the hand moves, by at most that shape's displacement.

Many hands with the object are processed together, since numpy takes about as long for one of them
as for a few.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Protocol

import coal
import numpy as np

from rtee.planning.postures import HandPose, Slots
from rtee.planning.scene import NOWHERE, TOUCH, GraspScene, Measured, Touch
from rtee.sample import BoolArray, FloatArray

_EXACT: Final = 5e-6
"""Accuracy of Coal's distances and normals [m]: its iterations end at 1e-6 of a length."""


class Placed(Protocol):
    """Shape poses of one hand or of several; see `HandPose` and `HandPoses`."""

    def where(self, slot: int, /) -> coal.Transform3s:
        """Return a shape's pose for Coal."""

    def carried(self, slots: Slots, /) -> tuple[FloatArray, FloatArray]:
        """Return rotations ``(k, 3, 3)`` of the bodies of some shapes, and middles ``(k, 3)``."""


class DistanceBounds:
    """Lower bounds of the distances between the shapes of hands and the pieces of an object.

    Each row is a hand with the object. The caller reports motions by `pushed` and `closed`, and
    passes the new poses of the hands as ``at``. The object does not turn.

    Args:
        scene: The hand and the object.
        at: Initial pose of the hand in each row.
        poses: Poses of the object ``(k, 4, 4)`` in the base frame.
    """

    def __init__(self, scene: GraspScene, at: Sequence[HandPose], poses: FloatArray) -> None:
        self._scene = scene
        self._turns, self.places = poses[:, :3, :3], poses[:, :3, 3].copy()
        self._here: list[coal.Transform3s | None] = [None] * len(poses)
        found = [scene.gaps(there, pose) for there, pose in zip(at, poses, strict=True)]
        # Arrays (rows, shapes, pieces): a pair has one number there, its shape a slot. Its bound
        # follows every move; the place of its planes is kept as well, to compute the gap again.
        self._bounds = np.array([gaps for gaps, _ in found])
        count, shapes, self._pieces = self._bounds.shape
        normals = np.array([normals for _, normals in found])
        bodies = np.array([there.bodies for there in at])
        self._in_body = (normals @ bodies).reshape(-1, 3)
        shifts = self.places[:, None] - np.array([there.middles for there in at])
        self._begin = (self._bounds - np.einsum("knpi,kni->knp", normals, shifts)).ravel()
        self._normals = normals.reshape(-1, 3)
        self._radii = np.tile(scene.postures.radii, count)
        self._shapes, self._rows = shapes, np.arange(count)
        self._known: list[dict[int, Measured]] = [{} for _ in poses]

    def pushed(self, shifts: FloatArray, rows: Slots | None = None) -> None:
        """Update the bounds after the object has moved in some rows, by ``(len(rows), 3)`` [m]."""
        rows = self._moved(rows)
        normals = self._normals.reshape(*self._bounds.shape, 3)
        self._bounds[rows] += (normals[rows] * shifts[:, None, None]).sum(axis=-1)
        self.places[rows] += shifts
        for row in rows.tolist():
            self._here[row] = None

    def closed(self, shifts: FloatArray, rows: Slots | None = None) -> None:
        """Update the bounds after shapes have moved, by at most ``(len(rows), shapes)`` [m]."""
        self._bounds[self._moved(rows)] -= shifts[:, :, None]

    def touching(
        self, at: Placed, rows: Slots | None = None, among: BoolArray | None = None
    ) -> list[list[Touch]]:
        """Return the shapes that touch the object in each row, in their order.

        Args:
            at: Where the hands are.
            rows: Which rows are checked; all unless given.
            among: Which shapes are checked ``(len(rows), shapes)``; all unless given.
        """
        rows, bounds = self._of(rows)
        pairs, _ = self._pairs(bounds <= TOUCH, rows, among)
        refined = self._refined(pairs, at)
        pairs, refined = pairs[refined <= TOUCH], refined[refined <= TOUCH]
        slots = pairs // self._pieces
        order = np.lexsort((refined, slots))
        left = zip(*(array[order].tolist() for array in (slots, pairs, refined)), strict=True)
        # The nearest piece of each shape counts, and rules most others out.
        nearest: dict[int, Measured] = {}
        new: list[int] = []
        for slot, pair, bound in left:
            least = nearest.get(slot)
            if least is None or bound < least[0]:
                found = self._distance(pair, at, new)
                if found[0] <= TOUCH and (least is None or found[0] < least[0]):
                    nearest[slot] = found
        self._note(new, at)
        touches: dict[int, list[Touch]] = {row: [] for row in rows.tolist()}
        for slot, found in nearest.items():
            row, shape = divmod(slot, self._shapes)
            touches[row].append(Touch(shape, *found))
        return list(touches.values())

    def touch(self, row: int, shape: int, at: Placed) -> Touch:
        """Return the distance from a shape to the object, and the contact if they touch."""
        first = (row * self._shapes + shape) * self._pieces
        bounds = self._bounds[row, shape].tolist()
        least: Measured | None = None
        # The nearest piece first: its distance rules most others out.
        for piece in sorted(range(self._pieces), key=bounds.__getitem__):
            if least is not None and bounds[piece] > least[0]:
                break
            found = self._distance(first + piece, at, [])
            if least is None or found[0] < least[0]:
                least = found
        return Touch(shape, *(least or (math.inf, NOWHERE, NOWHERE)))

    def least(
        self,
        at: Placed,
        enough: float | FloatArray,
        rows: Slots | None = None,
        *,
        paces: FloatArray | None = None,
        among: BoolArray | None = None,
        until: float = 0.0,
        below: float = -math.inf,
    ) -> FloatArray:
        """Return the least distance of each hand from the object, or the least time to a contact.

        Args:
            at: Where the hands are.
            enough: Larger results need not be exact; this value is then returned. One for all rows,
                or one for each.
            rows: Which rows are checked; all unless given.
            paces: How fast the shapes may come nearer ``(len(rows), shapes)`` [m per unit of time];
                without them, distances are returned [m].
            among: Which shapes count ``(len(rows), shapes)``; all unless given.
            until: The distance that is a contact [m].
            below: Smaller results need not be exact, only smaller than this.
        """
        rows, bounds = self._of(rows)
        free = bounds - until if paces is None else (bounds - until) / paces[:, :, None]
        limits = np.broadcast_to(np.asarray(enough, dtype=np.float64), (len(rows),))
        if paces is None and among is None:
            limits = self._capped(limits, bounds, rows, at, until)
        pairs, which = self._pairs(free < limits[:, None, None], rows, among)
        if not len(pairs):
            return limits.copy()
        least = limits.tolist()
        slow = np.ones(len(pairs))
        if paces is not None:
            slow = paces[which, pairs // self._pieces % self._shapes]
        times = (self._refined(pairs, at) - until) / slow
        order = np.lexsort((times, which))
        left = zip(*(array[order].tolist() for array in (which, times, pairs, slow)), strict=True)
        measured: list[int] = []
        # The nearest first: its distance rules most others of its row out.
        for row, time, pair, pace in left:
            if time >= least[row] or least[row] < below:
                continue
            distance = self._distance(pair, at, measured)[0] - until
            least[row] = min(least[row], distance / pace)
        self._note(measured, at)
        return np.array(least)

    def _capped(
        self, limits: FloatArray, bounds: FloatArray, rows: Slots, at: Placed, until: float
    ) -> FloatArray:
        """Return limits ``(len(rows),)``, each at most the distance of one pair of its row [m].

        Without these limits, distant shapes would be measured, too.
        """
        flat = bounds.reshape(len(rows), -1)
        nearest = flat.argmin(axis=1)
        near = np.flatnonzero(flat[np.arange(len(rows)), nearest] - until < limits)
        pairs = rows[near] * (self._shapes * self._pieces) + nearest[near]
        found = self._measured(pairs.tolist(), at)
        capped = limits.copy()
        for row, (distance, _, _) in zip(near.tolist(), found, strict=True):
            capped[row] = min(capped[row], distance - until)
        return capped

    def _moved(self, rows: Slots | None) -> Slots:
        """Mark the distances of some rows as unknown; return the rows."""
        rows = self._rows if rows is None else rows
        for row in rows.tolist():
            self._known[row].clear()
        return rows

    def _of(self, rows: Slots | None) -> tuple[Slots, FloatArray]:
        """Return some rows and their bounds ``(len(rows), shapes, pieces)`` [m]."""
        return (self._rows, self._bounds) if rows is None else (rows, self._bounds[rows])

    def _pairs(self, near: BoolArray, rows: Slots, among: BoolArray | None) -> tuple[Slots, Slots]:
        """Return the pairs that count, and the place of their row among some rows."""
        found = np.flatnonzero(near if among is None else near & among[:, :, None])
        which, inner = np.divmod(found, self._shapes * self._pieces)
        return rows[which] * (self._shapes * self._pieces) + inner, which

    def _refined(self, pairs: Slots, at: Placed) -> FloatArray:
        """Return the bounds of some pairs, renewed from their present poses ``(k,)`` [m]."""
        slots, normals = pairs // self._pieces, self._normals[pairs]
        turns, middles = at.carried(slots)
        # The farthest point of a shape along a normal moves with the shape's middle, and by no more
        # than the shape turns times its radius.
        turned = (normals[:, None] @ turns)[:, 0] - self._in_body[pairs]
        swung = np.sqrt(np.add.reduce(turned * turned, axis=1)) * self._radii[slots]
        shifts = self.places[slots // self._shapes] - middles
        gaps = self._begin[pairs] + np.add.reduce(normals * shifts, axis=1) - swung
        all_bounds = self._bounds.reshape(-1)
        bounds: FloatArray = np.maximum(all_bounds[pairs], gaps)
        all_bounds[pairs] = bounds
        return bounds

    def _measured(self, pairs: Sequence[int], at: Placed) -> list[Measured]:
        """Return distance, point and normal of pairs, and note them."""
        new: list[int] = []
        found = [self._distance(pair, at, new) for pair in pairs]
        self._note(new, at)
        return found

    def _distance(self, pair: int, at: Placed, new: list[int]) -> Measured:
        """Return distance, point and normal of a pair; if they are new, it is added to a list."""
        slot, piece = divmod(pair, self._pieces)
        row, shape = divmod(slot, self._shapes)
        found: Measured | None = self._known[row].get(pair)
        if found is None:
            here = self._here[row]
            if here is None:
                here = self._here[row] = coal.Transform3s(self._turns[row], self.places[row])
            found = self._scene.measured(shape, piece, at.where(slot), here)
            self._known[row][pair] = found
            new.append(pair)
        return found

    def _note(self, measured: Sequence[int], at: Placed) -> None:
        """Store the planes of pairs whose distances are known."""
        if not measured:
            return
        pairs = np.array(measured)
        slots = pairs // self._pieces
        rows = slots // self._shapes
        found = [self._known[r][p] for r, p in zip(rows.tolist(), measured, strict=True)]
        bounds = np.array([distance for distance, _, _ in found]) - _EXACT
        normals = np.array([normal for _, _, normal in found])
        turns, middles = at.carried(slots)
        self._bounds.reshape(-1)[pairs] = bounds
        self._begin[pairs] = bounds - np.add.reduce(normals * (self.places[rows] - middles), axis=1)
        self._normals[pairs] = normals
        self._in_body[pairs] = (normals[:, None] @ turns)[:, 0]
