"""Pairs of links that move against each other, and their closest points."""

from __future__ import annotations

from dataclasses import dataclass

from rtee.sample import FloatArray


@dataclass(frozen=True, slots=True)
class LinkPair:
    """Two links and the pairs of their shapes.

    Attributes:
        links: Names of the links.
        bodies: Numbers of the joints that carry the links; 0 for the base.
        shapes: Indices of the shapes of the first and of the second link in the scene.
        number: Number of the pair in the scene, the same in both orders.
        moved_by: By joint ``(m,)``: 1 if it moves only the second link, -1 if only the first,
            otherwise 0.
        actuators: Indices of the actuators that move the links relative to each other.
        turned: Whether the links are in reverse order compared to the scene.
    """

    links: tuple[str, str]
    bodies: tuple[int, int]
    shapes: tuple[tuple[int, ...], tuple[int, ...]]
    number: int
    moved_by: FloatArray
    actuators: frozenset[int]
    turned: bool = False

    def reversed(self) -> LinkPair:
        """Return the same pair in the other order."""
        return LinkPair(
            self.links[::-1],
            self.bodies[::-1],
            self.shapes[::-1],
            self.number,
            -self.moved_by,
            self.actuators,
            not self.turned,
        )


@dataclass(frozen=True, slots=True)
class Witness:
    """Points of closest approach or deepest penetration of two links, in the hand's base frame.

    Attributes:
        distance: Signed distance between the links; negative for a penetration [m].
        first: Point on the first link [m].
        second: Point on the second link [m].
        normal: Unit vector from the first link to the second one.
    """

    distance: float
    first: FloatArray
    second: FloatArray
    normal: FloatArray
