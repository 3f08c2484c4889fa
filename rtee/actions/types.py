"""The grasping actions as data (section III of the paper): immutable, without I/O."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Final


class ActionKind(StrEnum):
    """The four kinds of grasping actions."""

    PRIMITIVE = "primitive"
    COMPOSED = "composed"
    TIMED = "timed"
    GENERIC = "generic"


class PrimitiveKind(StrEnum):
    """The seven kinds of primitives."""

    TRIG = "Trig"
    TIP_FLEX = "TipFlex"
    FING_FLEX = "FingFlex"
    PINCH_TIGHT = "PinchTight"
    PINCH_LOOSE = "PinchLoose"
    MULTI_PINCH_TIGHT = "MultiPinchTight"
    SINGLE_JOINT_MULTIPLE_TIPS = "SingleJointMultipleTips"

    @property
    def counted(self) -> bool:
        """Whether the number of tips is part of the name, as in ``MultiPinchTight_3``."""
        return self in (PrimitiveKind.MULTI_PINCH_TIGHT, PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS)


@dataclass(frozen=True, slots=True)
class Posture:
    """Actuator positions, with the mask of the involved ones.

    Attributes:
        position: Position of every actuator of the hand [rad | m], by name, in the hand's order;
            those not involved stand at rest.
        involved: The actuators that the action moves, in the hand's order.
    """

    position: Mapping[str, float]
    involved: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", MappingProxyType(dict(self.position)))


@dataclass(frozen=True, slots=True)
class Opposition:
    """How well the contact forces of two tips oppose each other at a pinch.

    Attributes:
        angles: Angle between the contact normal and the line of closing, per tip [rad].
        force_closure: A small ball at the contact is in force closure.
        friction: Coefficient of friction assumed.
    """

    angles: tuple[float, float]
    force_closure: bool
    friction: float = 0.5


FARTHEST_CLEARANCE: Final = 0.005
"""Clearances are measured up to here; beyond, no hand is near anything of itself [m]."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the extraction found at a posture; lengths in metres, frames: the hand's base.

    Attributes:
        depth: Penetration of the tips' convex parts, 0 when they do not touch [m].
        distance: Distance of the tips' geometry, 0 when they touch [m].
        frame_distance: Distance of the origins of the tips' links [m].
        point: Contact point, or the middle of the closest points [m].
        normal: Unit contact normal, from the first element to the second.
        clear: Nothing else collides in the posture.
        path_clear: Nothing else collides on the straight way from rest.
        clearance: Least distance from everything else in the posture and, where that is clear, on
            the way [m], at most 5 mm; ``None`` where the posture is not clear.
        colliding: Pairs of other links that do collide.
        contact_at: Intensity at which the tips first touch on the way from rest.
        opposition: How well the contact forces oppose each other.
        pairs: For a multi-pinch, the touching pairs of elements and their depths [m].
    """

    depth: float = 0.0
    distance: float = 0.0
    frame_distance: float | None = None
    point: tuple[float, float, float] | None = None
    normal: tuple[float, float, float] | None = None
    clear: bool = True
    path_clear: bool = True
    clearance: float | None = None
    colliding: tuple[tuple[str, str], ...] = ()
    contact_at: float | None = None
    opposition: Opposition | None = None
    pairs: tuple[tuple[str, str, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Primitive:
    """A primitive grasping action, found by the extraction.

    Attributes:
        kind: Which of the seven.
        elements: Fingers, or the one actuator of a SingleJointMultipleTips.
        postures: Ranked postures; the first is the one executed.
        evidence: Evidence per posture, same length, or empty.
        tips: Number of ``fingers``; part of the name for the counted kinds.
        fingers: The fingers involved (equal to ``elements`` but for SingleJointMultipleTips).
    """

    kind: PrimitiveKind
    elements: tuple[str, ...]
    postures: tuple[Posture, ...]
    evidence: tuple[Evidence, ...] = ()
    tips: int = 1
    fingers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.fingers and self.kind is not PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS:
            object.__setattr__(self, "fingers", self.elements)
        if self.fingers:
            object.__setattr__(self, "tips", len(self.fingers))

    @property
    def name(self) -> str:
        """``Trig``, ``PinchTight``, ``MultiPinchTight_3`` and so on."""
        return f"{self.kind}_{self.tips}" if self.kind.counted else str(self.kind)

    @property
    def posture(self) -> Posture:
        """The posture that is executed."""
        return self.postures[0]


@dataclass(frozen=True, slots=True)
class ActionReference:
    """A use of an action inside another one.

    Attributes:
        action: Name of the action.
        elements: Elements, for a primitive.
        scale: Scale of its set-points from rest, 0 or more.
    """

    action: str
    elements: tuple[str, ...] = ()
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class Composed:
    """A combination of actions, each with a scale.

    Attributes:
        name: Its name.
        parts: What it is made of.
        posture: The combined set-points: the mean where parts share an actuator.
        independent: Whether parts sharing an actuator are refused.
        description: One sentence for people.
    """

    name: str
    parts: tuple[ActionReference, ...]
    posture: Posture
    independent: bool = False
    description: str = ""


@dataclass(frozen=True, slots=True)
class Step:
    """One inner action of a timed action.

    Attributes:
        use: The inner action.
        alias: Its name within the timed action, unique there.
        before: Margin before it starts [s].
        after: Margin after it is completed [s].
        posture: Its scaled set-points.
    """

    use: ActionReference
    alias: str
    before: float
    after: float
    posture: Posture


@dataclass(frozen=True, slots=True)
class Timed:
    """Actions in sequence.

    Attributes:
        name: Its name.
        steps: The inner actions, in order.
        description: One sentence for people.
    """

    name: str
    steps: tuple[Step, ...]
    description: str = ""


@dataclass(frozen=True, slots=True)
class Generic:
    """Set-points given directly.

    Attributes:
        name: Its name.
        posture: The set-points with the mask of involved actuators.
        description: One sentence for people.
    """

    name: str
    posture: Posture
    description: str = ""


Action = Primitive | Composed | Timed | Generic


def kind_of(action: Action) -> ActionKind:
    """Return which of the four kinds an action is."""
    match action:
        case Primitive():
            return ActionKind.PRIMITIVE
        case Composed():
            return ActionKind.COMPOSED
        case Timed():
            return ActionKind.TIMED
        case Generic():
            return ActionKind.GENERIC


@dataclass(frozen=True, slots=True)
class PrimitiveGroup:
    """All primitives of one name, as a user interface shows them.

    Attributes:
        name: ``Trig``, ``MultiPinchTight_3`` and so on.
        selectable: The elements that occur.
        count: How many elements are selected at once.
        combinations: The combinations there are.
    """

    name: str
    selectable: tuple[str, ...]
    count: int
    combinations: tuple[tuple[str, ...], ...] = field(default_factory=tuple)
