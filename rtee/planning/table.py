"""The table under the object, from which a hand keeps clear as it approaches, closes and opens.

The table goes with the object, so that it is elsewhere in the hand's base frame for each pose of
the object. It fills everything below its top. Where a grasp needs room below the object, the table
ends at an edge, over which the object stands out on the hand's side.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import coal
import numpy as np

from rtee.errors import ConfigError
from rtee.objects.shape import Table
from rtee.planning.approaches import PoseCandidate
from rtee.planning.closing import Closure, HandClosing
from rtee.planning.postures import HandPose
from rtee.planning.scene import GraspScene
from rtee.sample import FloatArray

CLEAR: Final = 4e-3
"""Least gap between a hand and the table [m]."""

_TILT: Final = math.tan(math.radians(5.0))
"""Increase of that gap per metre of distance from the object: the accuracy of arms and cameras."""

STEEP: Final = 0.5
"""A hand comes from above if its approach is less than 60 degrees off the table's normal: the
cosine."""

_PRESSED: Final = 3e-3
"""Depth in the table beyond which the closing hand presses an object on it [m]."""

_STANDS: Final = 0.2
"""An object may overhang until only this share of its part beyond the centre of mass is on the
table: it then does not tip when touched, nor when it stands 10 mm from its place."""

_LEAST: Final = 0.9
"""Share of the gap that is enough: the steps of a closing hand are 6 mm apart."""

_RAISED: Final = 0.02
"""Largest height by which a hand is raised to clear the table [m]: more makes another grasp."""

_SIZE: Final = (1.2, 1.2, 0.6)
"""Size of the block for a table with an edge [m]: larger than the hand and its approach."""

_SHARES: Final = (0.1, 0.3, 0.6, 1.0)
"""Shares of the approach at which the hand is checked, closer to each other near its end."""


class ClosingKind(Enum):
    """How a hand closes on an object that stands on a table.

    The value has scores, and the shares of grasps with these scores that held in simulation, with
    5 mm, 5 degrees and friction varied (docs/benchmarks/planning.md).
    """

    JAWS = (0.0, 0.5, 0.9), (0.0, 0.86, 0.95)
    """Two jaws press with equal forces."""
    FINGERS = (0.0, 0.28, 0.38, 0.65, 0.8), (0.0, 0.1, 0.6, 0.75, 0.95)
    """Several fingers that share motors push the object until they oppose each other."""
    WAITING = (0.0, 0.1, 0.2, 0.3, 0.5, 0.65, 0.9), (0.03, 0.1, 0.3, 0.6, 0.8, 0.93, 0.97)
    """The sides wait for one another, then press with the same force."""
    UNEVEN = (0.0, 1.0), (0.1, 0.2)
    """Fingers with motors of their own push the object, and press with efforts that do not
    balance."""

    def share_held(self, score: float) -> float:
        """Return the share of grasps that hold, for a score of geometry and forces."""
        return round(float(np.interp(score, *self.value)), 4)


@dataclass(frozen=True)
class Top:
    """Pose of a table top in a hand's base frame.

    Attributes:
        pose: Pose ``(4, 4)`` of its top: z is up, x points out over the edge, and the origin is on
            the edge; below the object's centre of mass if there is none.
        overhang: How far the object stands out over the edge [m]; 0 without one.
    """

    pose: FloatArray
    overhang: float = 0.0

    @property
    def up(self) -> FloatArray:
        """Its upward normal ``(3,)``."""
        return np.asarray(self.pose[:3, 2])

    def moved(self, shift: FloatArray) -> Top:
        """Return the table top moved by a shift ``(3,)`` [m]."""
        pose = self.pose.copy()
        pose[:3, 3] += shift
        return Top(pose, self.overhang)


class Ground:
    """Measures how far a hand is from the table.

    Attributes:
        up: The table's normal in the object's frame ``(3,)``; ``None``: it is against the weight.
        edge: Whether the object stands out over the table's edge.
    """

    def __init__(self, scene: GraspScene, table: Table, weight_axis: FloatArray) -> None:
        """Set up the table for a hand and an object.

        Args:
            scene: The hand and the object.
            table: The table.
            weight_axis: Direction of the weight ``(3,)`` in the base frame, unless the table gives
                it.

        Raises:
            ConfigError: if the whole object is below the table's top.
        """
        self._scene, self._table, self._axis, self.edge = scene, table, weight_axis, False
        up = None if table.up is None else np.array(table.up)
        self.up: FloatArray | None = None if up is None else up / np.linalg.norm(up)
        if self.up is not None and table.height is not None:
            highest = float(scene.object.support(self.up[None])[0])
            if table.height >= highest:
                raise ConfigError(
                    f"the table's top is {table.height * 1e3:.0f} mm above the origin of "
                    f"'{scene.object.name}', whose highest point is at {highest * 1e3:.0f} mm: it "
                    "would be below the table"
                )
        points = [shape.points for shape in scene.geometry.shapes]
        self._points = np.concatenate(points)
        self._of = np.repeat(np.arange(len(points)), [len(some) for some in points])
        self._first = np.cumsum([0, *(len(some) for some in points[:-1])])
        self._block = coal.Box(*_SIZE)

    def top(self, pose: FloatArray, approach_from: FloatArray) -> Top:
        """Return the table top for a pose of the object.

        Args:
            pose: Pose of the object ``(4, 4)`` in the base frame.
            approach_from: From where it comes, relative to the hand ``(3,)``: an edge is on the
                other side.
        """
        obj, turn = self._scene.object, pose[:3, :3]
        z = -self._axis if self.up is None else turn @ self.up
        up = turn.T @ z
        height = self._table.height
        if height is None:
            height = -float(obj.support(-up[None])[0])
        out = -(approach_from - (approach_from @ z) * z)
        size = float(np.linalg.norm(out))
        edge = self.edge and size > STEEP * float(np.linalg.norm(approach_from))
        if not edge:  # any axis across
            out = np.eye(3)[int(np.argmin(np.abs(z)))]
            out = out - (out @ z) * z
            size = float(np.linalg.norm(out))
        x = out / size
        # Below the centre of mass, on the top.
        origin = turn @ (obj.centre + (height - float(up @ obj.centre)) * up) + pose[:3, 3]
        overhang = 0.0
        if edge:
            along = turn.T @ x
            beyond = float(obj.support(along[None])[0] - along @ obj.centre)
            origin = origin + _STANDS * beyond * x
            overhang = (1.0 - _STANDS) * beyond
        placed = np.eye(4)
        placed[:3] = np.column_stack([x, np.cross(z, x), z, origin])
        return Top(placed, overhang)

    def gap(self, at: HandPose, top: Top) -> float:
        """Return the distance of a hand to the table [m], less the room that its tilt needs.

        Beyond `CLEAR` from a table with an edge, the distance need not be exact.
        """
        normals = at.turns.swapaxes(1, 2) @ top.up
        heights = np.einsum("ki,ki->k", self._points, normals[self._of])
        lowest = np.minimum.reduceat(heights, self._first)
        gaps = lowest + (at.places - top.pose[:3, 3]) @ top.up
        beside = (at.middles - top.pose[:3, 3]) @ top.pose[:3, :2]
        needed = _TILT * np.hypot(beside[:, 0], beside[:, 1])
        gaps -= needed
        if not top.overhang:
            return float(gaps.min())
        x, _, z = (0.5 * size for size in _SIZE)
        middle = top.pose[:3, :3] @ np.array([-x, 0.0, -z]) + top.pose[:3, 3]
        block = coal.Transform3s(top.pose[:3, :3], middle)
        low = np.flatnonzero(gaps < CLEAR).tolist()
        scene = self._scene
        return min(
            (scene.distance(shape, at, self._block, block) - float(needed[shape]) for shape in low),
            default=CLEAR,
        )

    def missing(
        self, closing: HandClosing, steps: int, begin: FloatArray, direction: FloatArray
    ) -> FloatArray:
        """Return how much farther an object has to be for the closing hand to clear the table.

        Args:
            closing: Closes the hand.
            steps: Steps of its table until it touches the object.
            begin: Pose of the object ``(4, 4)``.
            direction: Unit vector towards where it comes from.

        Returns:
            For one that comes at each step and closes from there ``(steps + 1,)`` [m].
        """
        top = self.top(begin, direction)
        gaps = np.array([self.gap(at, top) for at in closing.table[: steps + 1]])
        return CLEAR - np.minimum.accumulate(gaps[::-1])[::-1]

    def clears(self, closing: HandClosing, candidate: PoseCandidate, closure: Closure) -> bool:
        """Return whether a hand keeps clear of the table, from its approach until it has closed."""
        top = self.top(candidate.pose, candidate.approach_from)
        # Fingers that push an object deeper would press it on the table.
        if float((closure.pose[:3, 3] - candidate.pose[:3, 3]) @ top.up) < -_PRESSED:
            return False
        return self._least(closing, candidate, closure) >= _LEAST * CLEAR and all(
            self.gap(closing.table[candidate.start], top.moved(share * candidate.approach_from))
            >= _LEAST * CLEAR
            for share in _SHARES
        )

    def raised(
        self, closing: HandClosing, candidate: PoseCandidate, closure: Closure
    ) -> Iterator[PoseCandidate]:
        """Yield a candidate at which a hand that did not keep clear of the table may do so."""
        more = CLEAR - self._least(closing, candidate, closure)
        if self.edge or candidate.raised or not 0.0 < more < _RAISED:
            return
        up, pose = self.top(candidate.pose, candidate.approach_from).up, candidate.pose.copy()
        unit = candidate.approach_from / np.linalg.norm(candidate.approach_from)
        steep = -float(unit @ up)
        pose[:3, 3] += more * (unit / steep if steep > STEEP else -up)
        yield replace(candidate, pose=pose, raised=True)

    def _least(self, closing: HandClosing, candidate: PoseCandidate, closure: Closure) -> float:
        """Return the least gap between a hand that closes and the table [m]."""
        top = self.top(candidate.pose, candidate.approach_from)
        steps = np.count_nonzero(closing.grid < closure.first)
        there = [*closing.table[candidate.start : steps], self._scene.posed(closure.u)]
        return min(self.gap(at, top) for at in there)
