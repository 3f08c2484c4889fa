"""The goals that searches minimise: distances of two or more tips."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import combinations
from typing import Final, Protocol

from rtee.extract.descent import Slope
from rtee.extract.pairs import LinkPair
from rtee.extract.scene import Scene
from rtee.extract.space import Space, rounded
from rtee.sample import FloatArray

_MARGIN: Final = 2e-4
"""Desired overlap of the convex parts of linked tips [m], so that the tips inside them touch, too.
"""

_PULL: Final = 5.0
"""Weight of a gap between tips that should be linked, relative to a depth: one more tip in contact
matters more than a deeper contact."""


class SearchGoal(Protocol):
    """A quantity to minimise, at the current posture of the scene."""

    def value(self) -> float:
        """Return the value [m]; lower is better."""

    def slope(self, space: Space) -> tuple[float, Slope]:
        """Return the value [m], and a function for its derivative by the coordinates ``(k,)``."""

    def overlapping(self) -> bool:
        """Return whether the convex parts of the tips overlap as required."""

    def touching(self) -> bool:
        """Return whether the tips touch as required, by their original geometry."""


class GoalFunction:
    """A goal as a function of the coordinates of a space."""

    def __init__(self, scene: Scene, goal: SearchGoal, space: Space) -> None:
        self.scene = scene
        self.goal = goal
        self.space = space

    def __call__(self, y: FloatArray) -> tuple[float, Slope]:
        """Return the value [m] at coordinates ``(k,)``, and a function for its derivative there."""
        self.scene.place(self.space.posture(y))
        return self.goal.slope(self.space)

    def fine(self) -> AbstractContextManager[None]:
        """Measure on the full convex parts within this context."""
        return self.scene.fine()

    def value(self, y: FloatArray) -> float:
        """Return the value [m] at coordinates ``(k,)``."""
        self.scene.place(self.space.posture(y))
        return self.goal.value()

    def overlapping(self, y: FloatArray) -> bool:
        """Return whether the convex parts overlap as required at coordinates ``(k,)``."""
        self.scene.place(self.space.posture(y))
        return self.goal.overlapping()

    def touching(self, u: FloatArray) -> bool:
        """Return whether the tips touch as required at a posture ``(n,)`` [rad | m]."""
        self.scene.place(u)
        return self.goal.touching()

    def stored(self, y: FloatArray) -> FloatArray:
        """Return the posture ``(n,)`` at coordinates ``(k,)``, rounded as stored."""
        return rounded(self.scene.hand, self.space.posture(y), self.scene.unit)


class PinchGoal:
    """Goal of two tips: the signed distance of their convex parts."""

    def __init__(self, scene: Scene, tips: LinkPair) -> None:
        self._scene = scene
        self._tips = tips

    def value(self) -> float:
        """Return the signed distance [m]."""
        return self._scene.distance(self._tips)

    def slope(self, space: Space) -> tuple[float, Slope]:
        """Return the signed distance [m] and a function that returns its derivative ``(k,)``."""
        scene, tips = self._scene, self._tips
        return scene.distance(tips), lambda: scene.derivative(tips, space)

    def overlapping(self) -> bool:
        """Return whether the convex parts overlap."""
        return self.value() <= 0.0

    def touching(self) -> bool:
        """Return whether the tips touch exactly."""
        return self._scene.touching(self._tips)


class GapGoal(PinchGoal):
    """Goal of two tips: the distance of their original geometry, 0 in contact."""

    def value(self) -> float:
        """Return the distance [m]."""
        return self._scene.exact_distance(self._tips)

    def slope(self, space: Space) -> tuple[float, Slope]:
        """Return the distance [m] and a function that returns its derivative ``(k,)``."""
        value, slope = self._scene.exact_slope(self._tips, space)
        return value, lambda: slope


class SeparationGoal(PinchGoal):
    """Goal of separating two tips: minus the signed distance of their convex parts."""

    def value(self) -> float:
        """Return minus the signed distance [m]."""
        return -super().value()

    def slope(self, space: Space) -> tuple[float, Slope]:
        """Return minus the signed distance [m] and a function for its derivative ``(k,)``."""
        value, rise = super().slope(space)
        return -value, lambda: -rise()


@dataclass(frozen=True, slots=True)
class TipEdge:
    """Two tips of a group that can touch each other: their numbers in it, and their links."""

    ends: tuple[int, int]
    tips: LinkPair


class MultiPinchGoal:
    """Goal of three or more tips, linked by contacts.

    The value is minus the sum of all depths, plus a penalty on the gaps of the shortest spanning
    tree, which links the tips, plus a penalty on contacts with tips of other fingers (bystanders).
    Most bystanders never touch; the goal measures only those that have touched.
    """

    def __init__(
        self,
        scene: Scene,
        size: int,
        edges: Sequence[TipEdge],
        bystanders: Sequence[LinkPair],
    ) -> None:
        """Prepare a goal.

        Args:
            scene: The hand's links.
            size: Number of tips.
            edges: The pairs of these tips that can touch.
            bystanders: Pairs of tips that are not both part of the pinch.
        """
        self._scene = scene
        self._size = size
        self._edges = edges
        self._ends = [edge.ends for edge in edges]
        self._pairs = [edge.tips for edge in edges]
        self._bystanders = bystanders
        self._touched: list[LinkPair] = []

    def learn_bystanders(self) -> bool:
        """Add bystanders that overlap another tip for the first time; return whether any did."""
        known = {pair.number for pair in self._touched}
        new = [pair for pair in self._bystanders if pair.number not in known]
        # Those already known need no measurement.
        new = [pair for pair in new if self._scene.distance(pair) < 0.0]
        self._touched += new
        return bool(new)

    def value(self) -> float:
        """Return the value [m]."""
        gaps = self._scene.distances(self._pairs)
        value = sum(min(gap, 0.0) for gap in gaps)
        value += _PULL * sum(max(0.0, gaps[i] + _MARGIN) for i in self._tree(gaps))
        for pair in self._touched:
            value += _PULL * max(0.0, -self._scene.distance(pair))
        return value

    def _tree(self, gaps: Sequence[float]) -> Sequence[int]:
        """Return the pairs whose gaps must close to link all tips."""
        if max(gaps) <= -_MARGIN:  # all pairs overlap enough
            return ()
        return spanning_tree(self._size, self._ends, gaps)

    def slope(self, space: Space) -> tuple[float, Slope]:
        """Return the value [m] and a function that returns its derivative ``(k,)``."""
        scene = self._scene
        gaps = scene.distances(self._pairs)
        tree = set(self._tree(gaps))
        value, terms = 0.0, []
        for i, (pair, gap) in enumerate(zip(self._pairs, gaps, strict=True)):
            # The penalty ends at the margin; it does not press a pair deeper.
            pull = _PULL if i in tree and gap > -_MARGIN else 0.0
            weight = pull + (1.0 if gap < 0.0 else 0.0)
            if weight:
                value += min(gap, 0.0) + pull * (gap + _MARGIN)
                terms.append((pair, weight))
        for pair in self._touched:
            gap = scene.distance(pair)
            if gap < 0.0:
                value -= _PULL * gap
                terms.append((pair, -_PULL))
        # If the tree switches from one pair to another, the value has a kink, but no step.
        return value, lambda: scene.gradient(terms, space)

    def overlapping(self) -> bool:
        """Return whether the tips are linked by overlaps of their convex parts."""
        overlaps = [edge.ends for edge in self._edges if self._scene.distance(edge.tips) <= 0.0]
        return linked(self._size, overlaps)

    def touching(self) -> bool:
        """Return whether exactly these tips touch, linked by contacts."""
        contacts = [edge.ends for edge in self._edges if self._scene.touching(edge.tips)]
        return linked(self._size, contacts) and not any(
            self._scene.touching(pair) for pair in self._bystanders
        )


def spanning_tree(
    size: int, edges: Sequence[tuple[int, int]], lengths: Sequence[float]
) -> list[int]:
    """Return the edges, by number, of the shortest spanning tree (Kruskal, 1956).

    Args:
        size: Number of nodes.
        edges: Pairs of nodes.
        lengths: Length of each edge.
    """
    part = list(range(size))  # number of the subtree of each node
    tree: list[int] = []
    for i in sorted(range(len(edges)), key=lengths.__getitem__):
        first, second = edges[i]
        a, b = part[first], part[second]
        if a != b:
            tree.append(i)
            if len(tree) == size - 1:
                break
            # Relabel all nodes; for a handful of tips, a union-find would be no faster.
            part = [b if p == a else p for p in part]
    return tree


def linked(size: int, edges: Sequence[tuple[int, int]]) -> bool:
    """Return whether edges connect all nodes."""
    return len(spanning_tree(size, edges, [0.0] * len(edges))) == size - 1


def spanning_trees(size: int, edges: Sequence[tuple[int, int]]) -> list[tuple[int, ...]]:
    """Return all spanning trees, as edges by number; meant for few nodes."""
    return [
        chosen
        for chosen in combinations(range(len(edges)), size - 1)
        if linked(size, [edges[i] for i in chosen])
    ]
