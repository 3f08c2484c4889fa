"""The grasping actions as immutable dataclasses (section III of the paper)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import ClassVar, Final, Literal, Protocol, Self

from rtee.errors import ActionError
from rtee.values import Value


class ActionKind(StrEnum):
    """The four kinds of grasping actions."""

    PRIMITIVE = "primitive"
    COMPOSED = "composed"
    TIMED = "timed"
    GENERIC = "generic"


class PrimitiveKind(StrEnum):
    """The seven kinds of primitives and their properties; `rtee.extract` has the search for each.

    Attributes:
        label: Description in a few words.
        noun: Noun for an element: finger or actuator.
        elements: Number of elements; ``None``: the count in the name.
        counted: Whether the number of tips is part of the name, as in ``MultiPinchTight_3``.
        pinch: Whether two tips touch, or nearly do.
    """

    label: str
    noun: Literal["finger", "actuator"]
    elements: int | None
    counted: bool
    pinch: bool

    def __new__(
        cls,
        name: str,
        label: str = "",  # optional, since a kind is also looked up by its name alone
        noun: Literal["finger", "actuator"] = "finger",
        elements: int | None = 1,
        counted: bool = False,
        pinch: bool = False,
    ) -> PrimitiveKind:
        """Make a kind; see the attributes."""
        kind = str.__new__(cls, name)
        # Otherwise the enumeration would take the tuple of all arguments as the value.
        kind._value_ = name
        kind.label, kind.noun, kind.elements = label, noun, elements
        kind.counted, kind.pinch = counted, pinch
        return kind

    TRIG = "Trig", "all actuators that move only this finger, at their farthest bound"
    TIP_FLEX = "TipFlex", "the actuator nearest the fingertip, at its farthest bound"
    FING_FLEX = "FingFlex", "the actuator nearest the palm, at its farthest bound"
    PINCH_TIGHT = (
        "PinchTight", "two fingertips pressed against each other", "finger", 2, False, True,
    )  # fmt: skip
    PINCH_LOOSE = (
        "PinchLoose", "two fingertips brought as near as they come", "finger", 2, False, True,
    )  # fmt: skip
    MULTI_PINCH_TIGHT = (
        "MultiPinchTight", "several fingertips pressed against each other", "finger", None, True,
    )  # fmt: skip
    SINGLE_JOINT_MULTIPLE_TIPS = (
        "SingleJointMultipleTips", "one actuator that moves several fingertips",
        "actuator", 1, True,
    )  # fmt: skip

    @property
    def of_actuators(self) -> bool:
        """Whether the elements are actuators instead of fingers."""
        return self.noun == "actuator"


@dataclass(frozen=True, slots=True)
class Posture(Value):
    """Actuator positions, with the mask of the involved ones.

    Attributes:
        position: Position of every actuator of the hand [rad | m], by name, in the hand's order;
            those not involved are at rest.
        involved: The actuators that the action moves, in the hand's order.
    """

    position: Mapping[str, float]
    involved: tuple[str, ...]

    def __post_init__(self) -> None:
        # A read-only view of a copy, since the caller may still change the mapping.
        object.__setattr__(self, "position", MappingProxyType(dict(self.position)))


@dataclass(frozen=True, slots=True)
class Opposition(Value):
    """Opposition of the contact forces of two tips in a pinch.

    Attributes:
        angles: Angle between the contact normal and the line of closing, per tip [rad].
        force_closure: Whether a small ball at the contact is in force closure.
        friction: Coefficient of friction assumed.
    """

    angles: tuple[float, float]
    force_closure: bool
    friction: float = 0.5


DEEPEST: Final = "deepest"
"""Suffix of a primitive's name, after an ``@``, that asks for its deepest posture."""

SHALLOW: Final = 0.5
"""Share of the deepest posture's depth below which a note mentions that posture."""

FARTHEST_CLEARANCE: Final = 0.005
"""Largest clearance measured [m]: at this distance, no link is in danger of a collision."""


@dataclass(frozen=True, slots=True)
class Evidence(Value):
    """Results of the extraction at a posture, in the frame of the hand's base.

    Attributes:
        depth: Penetration of the tips' convex parts; 0 without contact [m].
        distance: Distance of the tips' geometry; 0 in contact [m].
        frame_distance: Distance of the origins of the tips' links [m].
        point: Contact point, or the middle of the closest points [m].
        normal: Unit contact normal, from the first element to the second.
        clear: Whether the posture is free of other collisions.
        path_clear: Whether the straight path from rest is free of other collisions.
        clearance: Least distance of other links in the posture and, if that is clear, on the path,
            at most 5 mm [m]; ``None`` if the posture is not clear.
        colliding: Pairs of other links that collide.
        contact_at: Intensity at which the tips first touch on the path from rest.
        opposition: Opposition of the contact forces.
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
class ActionReference(Value):
    """A use of an action: alone, in a stream, or inside another one.

    Its text, which `of` reads, is ``ACTION[:ELEMENT[,ELEMENT…]][*SCALE]``, such as
    ``trig:ring*0.8``.

    Attributes:
        action: Name of the action.
        elements: Elements, for a primitive.
        scale: Scale of its set-points from rest, 0 or more.
    """

    action: str
    elements: tuple[str, ...] = ()
    scale: float = 1.0

    @classmethod
    def of(cls, what: ActionReference | str, elements: Sequence[str] = ()) -> ActionReference:
        """Return the reference that a string describes; a reference is returned unchanged.

        Args:
            what: The reference, or its string.
            elements: Its elements, if the string has none.

        Raises:
            ActionError: if the string has another form.
        """
        if isinstance(what, str):
            body, star, factor = what.partition("*")
            words = list(map(str.strip, body.replace(",", ":").split(":")))
            try:
                scale = float(factor) if star else 1.0
            except ValueError:
                raise ActionError(
                    f"the scale in '{what}' must be a number, not '{factor}'"
                ) from None
            if not all(words):
                raise ActionError(
                    f"'{what}' is not an action; write ACTION, ACTION:ELEMENT or "
                    "ACTION:ELEMENT,ELEMENT*SCALE"
                )
            what = cls(words[0], tuple(words[1:]), scale)
        elif not isinstance(what, cls):
            raise ActionError(f"an action is a string such as 'trig:ring*0.8', not {what!r:.100}")
        if isinstance(elements, str):
            raise ActionError(f"elements must be a list of names, such as ['{elements:.100}']")
        if not elements:
            return what
        if what.elements:
            raise ActionError(f"the elements of '{what}' are given twice")
        return cls(what.action, tuple(elements), what.scale)

    def __str__(self) -> str:
        elements = f":{','.join(self.elements)}" if self.elements else ""
        return f"{self.action}{elements}" + (f"*{self.scale:g}" if self.scale != 1.0 else "")


class _WithPosture(Protocol):
    @property
    def posture(self) -> Posture: ...


class _Action(Value):
    """Base class of all kinds of actions, with the defaults for actions without parts."""

    # A base class without `__slots__` would give every action a dictionary.
    __slots__ = ()

    @property
    def waypoints(self: _WithPosture) -> tuple[Posture, ...]:
        """The postures of the action, in order; the last one is its target."""
        return (self.posture,)

    @property
    def uses(self) -> tuple[ActionReference, ...]:
        """The actions that this action consists of."""
        return ()

    def with_uses(self, change: Callable[[ActionReference], ActionReference]) -> Self:
        """Return a copy with a function applied to all uses of other actions."""
        return self


@dataclass(frozen=True, slots=True)
class Primitive(_Action):
    """A primitive grasping action, found by the extraction.

    Attributes:
        kind: Kind of the primitive.
        elements: Fingers, or the actuator of a SingleJointMultipleTips.
        postures: Ranked postures, of which the first is executed.
        evidence: Evidence of each posture, or empty.
        tips: Number of ``fingers``; part of the name for the counted kinds.
        fingers: The fingers involved, which differ from ``elements`` in SingleJointMultipleTips.
    """

    action_kind: ClassVar = ActionKind.PRIMITIVE

    kind: PrimitiveKind
    elements: tuple[str, ...]
    postures: tuple[Posture, ...]
    evidence: tuple[Evidence, ...] = ()
    tips: int = 1
    fingers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        # By `object`, since the dataclass is frozen.
        if not self.fingers and not self.kind.of_actuators:
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

    @property
    def deepest(self) -> Primitive:
        """The same primitive with its deepest posture first, clear or not."""
        first = max(range(len(self.evidence)), key=lambda i: self.evidence[i].depth, default=0)
        order = [first, *(i for i in range(len(self.postures)) if i != first)]
        return replace(
            self,
            postures=tuple(self.postures[i] for i in order),
            evidence=tuple(self.evidence[i] for i in order if self.evidence),
        )

    @property
    def deeper(self) -> Evidence | None:
        """Evidence of the deepest posture if the executed one has less than half of its depth."""
        if not self.evidence:
            return None
        deepest = self.deepest.evidence[0]
        return deepest if self.evidence[0].depth < SHALLOW * deepest.depth else None


class _Custom(_Action):
    """Base class of the actions that people define, without the properties of primitives."""

    __slots__ = ()
    elements: ClassVar[tuple[str, ...]] = ()
    fingers: ClassVar[tuple[str, ...]] = ()
    evidence: ClassVar[tuple[Evidence, ...]] = ()


@dataclass(frozen=True, slots=True)
class Composed(_Custom):
    """A combination of actions, each with a scale.

    Attributes:
        name: Name of the action.
        parts: The parts.
        posture: The combined set-points, with the mean for actuators of several parts.
        independent: Whether parts sharing an actuator are refused.
        description: One sentence for people.
    """

    action_kind: ClassVar = ActionKind.COMPOSED

    name: str
    parts: tuple[ActionReference, ...]
    posture: Posture
    independent: bool = False
    description: str = ""

    @property
    def uses(self) -> tuple[ActionReference, ...]:
        """The parts."""
        return self.parts

    def with_uses(self, change: Callable[[ActionReference], ActionReference]) -> Self:
        """Return a copy with a function applied to all parts."""
        return replace(self, parts=tuple(map(change, self.parts)))


@dataclass(frozen=True, slots=True)
class Step(Value):
    """One inner action of a timed action.

    Attributes:
        use: The inner action.
        alias: Name within the timed action, unique there.
        before: Margin before its start [s].
        after: Margin after its end [s].
        posture: The scaled set-points.
    """

    use: ActionReference
    alias: str
    before: float
    after: float
    posture: Posture


@dataclass(frozen=True, slots=True)
class Timed(_Custom):
    """Actions in sequence.

    Attributes:
        name: Name of the action.
        steps: The inner actions, in order.
        description: One sentence for people.
    """

    action_kind: ClassVar = ActionKind.TIMED

    name: str
    steps: tuple[Step, ...]
    description: str = ""

    @property
    def uses(self) -> tuple[ActionReference, ...]:
        """The inner actions."""
        return tuple(step.use for step in self.steps)

    @property
    def waypoints(self) -> tuple[Posture, ...]:
        """The postures of the action, in order; the last one is its target."""
        return tuple(step.posture for step in self.steps)

    def with_uses(self, change: Callable[[ActionReference], ActionReference]) -> Self:
        """Return a copy with a function applied to all inner actions."""
        return replace(self, steps=tuple(replace(s, use=change(s.use)) for s in self.steps))


@dataclass(frozen=True, slots=True)
class Generic(_Custom):
    """Set-points given directly.

    Attributes:
        name: Name of the action.
        posture: The set-points with the mask of involved actuators.
        description: One sentence for people.
    """

    action_kind: ClassVar = ActionKind.GENERIC

    name: str
    posture: Posture
    description: str = ""


CustomAction = Composed | Timed | Generic
"""A grasping action that people define."""

Action = Primitive | CustomAction
"""A grasping action of any kind."""


def kind_of(action: Action) -> ActionKind:
    """Return the kind of an action; raises `ActionError` for anything else."""
    if not isinstance(action, _Action):
        raise ActionError(f"an action is what a library returns, not {action!r:.100}")
    return action.action_kind


@dataclass(frozen=True, slots=True)
class PrimitiveGroup(Value):
    """All primitives of one name, for user interfaces.

    Attributes:
        name: ``Trig``, ``MultiPinchTight_3`` and so on.
        selectable: The elements that occur in them.
        count: Number of elements of each primitive.
        combinations: The existing combinations of elements.
    """

    name: str
    selectable: tuple[str, ...]
    count: int
    combinations: tuple[tuple[str, ...], ...] = field(default_factory=tuple)
