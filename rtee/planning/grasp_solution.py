"""The solution for a planner's grasp by a hand, as data that needs no geometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from rtee.hand.validation import validated
from rtee.planning.result import Matrix, Point
from rtee.values import Value


@dataclass(frozen=True, slots=True)
class WantedContact(Value):
    """A contact that a planner wants, in its own frame.

    Attributes:
        point: Where the object is to be touched ``(3,)`` [m].
        normal: Unit normal into the object ``(3,)``; ``None``: towards the middle of all contacts.
        finger: The finger that is to touch there; empty: whichever suits best.
    """

    point: Point
    normal: Point | None = None
    finger: str = ""


@dataclass(frozen=True, slots=True)
class Residual(Value):
    """The error between a wanted contact and the fingertip.

    Attributes:
        finger: The finger.
        point: The point of the fingertip's surface that is nearest to the contact ``(3,)``, in the
            frame of the contacts [m].
        distance: From the contact to that surface [m]; negative: the contact is inside the tip.
        angle: Between the wanted normal and the surface's [rad].
    """

    finger: str
    point: Point
    distance: float
    angle: float


@dataclass(frozen=True, slots=True)
class Collision(Value):
    """Two bodies that overlap in a posture.

    Attributes:
        links: Two links of the hand; or one, and ``object``.
        depth: How deep their convex parts overlap [m].
        posture: Which posture: ``posture`` or ``pre_grasp``.
    """

    links: tuple[str, str]
    depth: float
    posture: str

    @property
    def words(self) -> str:
        """The collision in words."""
        first, second = self.links
        where = "before the grasp" if self.posture == "pre_grasp" else "in the grasp"
        return f"{first} is {1e3 * self.depth:.1f} mm inside of {second} {where}"


@dataclass(frozen=True, slots=True)
class GraspSolution(Value):
    """A hand's posture and poses for a grasp that a planner found; lengths in metres.

    Attributes:
        hand: The hand's name.
        fingers: The fingers that touch.
        posture: Actuator positions of the grasp [rad | m], of the involved actuators.
        pre_grasp: The same before it, with room between the fingers and the object.
        palm_pose: Pose ``(4, 4)`` of the hand's base link for it, row by row, in the planner's
            frame.
        pre_palm_pose: Pose of the palm before the approach.
        flange_pose: The pose of the arm's flange for it, in the planner's frame; ``None`` if
            hand.yaml has no ``flange``.
        pre_flange_pose: Pose of the flange before the approach.
        residuals: One for each contact that was wanted.
        action: The action, for a width; empty for contacts.
        elements: Its elements.
        intensity: Its intensity at the width.
        pre_intensity: Its intensity before, with the margin.
        width: The width that was wanted [m]; 0 for contacts.
        collisions: Collisions of links with one another, or with the object if one was given, in
            the posture and the pre-grasp, the deepest first. The path in between is not checked.
    """

    hand: str
    fingers: tuple[str, ...]
    posture: Mapping[str, float]
    pre_grasp: Mapping[str, float]
    palm_pose: Matrix
    pre_palm_pose: Matrix
    residuals: tuple[Residual, ...] = ()
    action: str = ""
    elements: tuple[str, ...] = ()
    intensity: float = 0.0
    pre_intensity: float = 0.0
    width: float = 0.0
    collisions: tuple[Collision, ...] = ()
    flange_pose: Matrix | None = None
    pre_flange_pose: Matrix | None = None


def to_document(solution: GraspSolution) -> dict[str, Any]:
    """Return the solution as plain data, ready for JSON."""
    return asdict(solution)


def from_document(document: Mapping[str, Any]) -> GraspSolution:
    """Return the solution from plain data.

    Raises:
        Invalid: if it is not a grasp solution; the error names all mistakes.
    """
    return validated(GraspSolution, document)
