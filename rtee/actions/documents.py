"""The YAML documents of actions, and their conversion to actions and back."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, TypeVar

import numpy as np
from msgspec import Meta, convert

from rtee.actions.build import Find, StepPlan, check_custom_name, compose, full_posture, sequence
from rtee.actions.naming import normalise
from rtee.actions.types import (
    Action,
    ActionKind,
    ActionReference,
    Composed,
    CustomAction,
    Evidence,
    Generic,
    Opposition,
    Posture,
    Primitive,
    PrimitiveKind,
    Timed,
    kind_of,
)
from rtee.errors import ActionError, UserError, suggestion
from rtee.hand.model import Hand
from rtee.hand.validation import Amount, Finite, Section, checked, field_names, fitting
from rtee.hand.yamlfile import Location, YamlDocument, parse_yaml, read_text

WHAT = "the file of actions"

Names = tuple[str, ...]
Vector = Annotated[tuple[Finite, ...], Meta(min_length=3, max_length=3)]
Angles = Annotated[tuple[Finite, ...], Meta(min_length=2, max_length=2)]
SetPoints = Annotated[dict[str, Finite], Meta(min_length=1)]


E = TypeVar("E")
Some = Annotated[tuple[E, ...], Meta(min_length=1)]


# --- primitives ------------------------------------------------------------------------------


class OppositionEntry(Section, frozen=True):
    """Opposition of contact forces; see `Opposition`."""

    angles: Angles
    force_closure: bool
    friction: Amount = 0.5


class EvidenceEntry(Section, frozen=True):
    """Evidence of the extraction for a posture; see `Evidence`."""

    depth: Amount = 0.0
    distance: Amount = 0.0
    frame_distance: Amount | None = None
    contact_at: Amount | None = None
    point: Vector | None = None
    normal: Vector | None = None
    clear: bool = True
    path_clear: bool = True
    clearance: Amount | None = None
    colliding: tuple[tuple[str, str], ...] = ()
    pairs: tuple[tuple[str, str, Amount], ...] = ()
    opposition: OppositionEntry | None = None

    def evidence(self) -> Evidence:
        """Return the evidence."""
        return convert(self, Evidence, from_attributes=True)


class PostureEntry(Section, frozen=True):
    """A posture of a primitive, with its evidence."""

    set_points: SetPoints
    evidence: EvidenceEntry | None = None


class PrimitiveEntry(Section, frozen=True, kw_only=True):
    """A primitive with its ranked postures."""

    elements: Names
    fingers: Names = ()
    postures: Some[PostureEntry]


class PrimitivesDocument(Section, frozen=True):
    """A file of all primitives of one name."""

    kind: str
    primitives: tuple[PrimitiveEntry, ...]


def read_primitives(hand: Hand, path: Path) -> list[Primitive]:
    """Read the file of all primitives of one name.

    Raises:
        ActionError: for every mistake, with file and line.
    """
    document = read_document(path)
    content = checked(PrimitivesDocument, document, ActionError)
    with located(document, ("kind",)):
        kind, count = _primitive_kind(content.kind)
    return [
        _primitive(hand, kind, count, entry, document, ("primitives", i))
        for i, entry in enumerate(content.primitives)
    ]


def _primitive_kind(text: str) -> tuple[PrimitiveKind, int | None]:
    base, _, digits = text.rpartition("_")
    for kind in PrimitiveKind:
        if kind.counted:
            if normalise(base) == normalise(kind) and digits.isascii() and digits.isdigit():
                return kind, int(digits[:6])  # int() refuses thousands of digits
        elif normalise(text) == normalise(kind):
            return kind, None
    names = [f"{kind}_3" if kind.counted else str(kind) for kind in PrimitiveKind]
    raise ActionError(f"unknown kind '{text}'; {suggestion(text, names)}")


def _primitive(
    hand: Hand,
    kind: PrimitiveKind,
    count: int | None,
    entry: PrimitiveEntry,
    document: YamlDocument,
    at: Location,
) -> Primitive:
    elements = fingers = entry.elements
    place = [*at, "elements"]
    with located(document, place):
        needed = kind.elements or count or 0
        if len(elements) != needed or len(set(elements)) != needed:
            raise ActionError(f"{kind} takes {needed} different elements")
        if kind.of_actuators:
            for name in elements:
                hand.actuator(name)
            fingers = entry.fingers
            place[-1] = "fingers"
        for name in fingers:
            hand.finger(name)
        if count is not None and len(set(fingers)) != count:
            raise ActionError(f"{kind}_{count} moves {count} fingers, not {len(set(fingers))}")
    postures = tuple(
        _posture(hand, posture.set_points, document, (*at, "postures", i, "set_points"))
        for i, posture in enumerate(entry.postures)
    )
    evidence = tuple(p.evidence.evidence() for p in entry.postures if p.evidence is not None)
    with located(document, (*at, "postures")):
        if evidence and len(evidence) != len(postures):
            raise ActionError("give evidence for every posture, or for none")
    return Primitive(kind, elements, postures, evidence, len(fingers), fingers)


def _posture(
    hand: Hand, values: Mapping[str, float], document: YamlDocument, at: Location
) -> Posture:
    try:
        return full_posture(hand, values)
    except UserError:
        for name, value in values.items():  # find the value that the error is about
            with located(document, (*at, name)):
                full_posture(hand, {name: value})
        raise


def primitives_document(primitives: Sequence[Primitive]) -> dict[str, Any]:
    """Return the document of all primitives of one name."""
    return {"kind": primitives[0].name, "primitives": [_primitive_entry(p) for p in primitives]}


def _primitive_entry(primitive: Primitive) -> dict[str, Any]:
    entries: list[dict[str, Any]] = [{"set_points": set_points(p)} for p in primitive.postures]
    # Not strict: either all postures have evidence or none.
    for entry, evidence in zip(entries, primitive.evidence, strict=False):
        entry["evidence"] = evidence_document(evidence)
    fingers = {"fingers": list(primitive.fingers)} if primitive.kind.of_actuators else {}
    return {"elements": list(primitive.elements), **fingers, "postures": entries}


def set_points(posture: Posture) -> dict[str, float]:
    """Return the positions of the involved actuators [rad | m]."""
    return {name: float(posture.position[name]) for name in posture.involved}


def evidence_document(evidence: Evidence) -> dict[str, Any]:
    """Return evidence as plain data, without unknown values."""
    values = {name: getattr(evidence, name) for name in field_names(EvidenceEntry)}
    return {name: _plain(value) for name, value in values.items() if value not in (None, ())}


def _plain(value: Any) -> Any:
    match value:
        case str():
            return value
        case bool() | np.bool_():
            return bool(value)
        case tuple():
            return [_plain(item) for item in value]
        case Opposition():
            return {name: _plain(getattr(value, name)) for name in field_names(OppositionEntry)}
    return float(value)


# --- composed, timed and generic actions -----------------------------------------------------


class UseEntry(Section, frozen=True):
    """A part of a composed action."""

    action: str
    elements: Names = ()
    scale: Amount = 1.0

    @property
    def use(self) -> ActionReference:
        """Return the entry as a use of an action."""
        use = ActionReference.of(self.action, self.elements)
        return replace(use, scale=use.scale * self.scale)


class StepEntry(UseEntry, frozen=True):
    """An inner action of a timed one."""

    alias: str = ""
    before: Amount = 0.0
    after: Amount = 0.0


class CustomDocument(Section, frozen=True, kw_only=True):
    """A file of one composed, timed or generic action.

    Attributes:
        body: The key of the action's parts, steps or set-points.
    """

    body: ClassVar[str]

    name: str
    description: str = ""

    def __post_init__(self) -> None:
        """Check the name."""
        with fitting("name"):
            check_custom_name(self.name)

    @abstractmethod
    def make(self, hand: Hand, find: Find, document: YamlDocument) -> Action:
        """Return the action; look up its parts in the order of the file.

        Raises:
            UserError: if the action cannot be made.
        """

    @staticmethod
    @abstractmethod
    def entries(action: Any) -> dict[str, Any]:
        """Return the entries of an action's file other than name and description."""


class ComposedDocument(CustomDocument, frozen=True, kw_only=True):
    """A file of a composed action."""

    body = "parts"

    independent: bool = False
    parts: Some[UseEntry]

    def make(self, hand: Hand, find: Find, document: YamlDocument) -> Composed:
        """See `CustomDocument.make`."""
        return compose(
            hand,
            find,
            self.name,
            [part.use for part in self.parts],
            independent=self.independent,
            description=self.description,
        )

    @staticmethod
    def entries(action: Composed) -> dict[str, Any]:
        """See `CustomDocument.entries`."""
        parts = [_use_entry(part) for part in action.parts]
        return {"independent": action.independent, "parts": parts}


class TimedDocument(CustomDocument, frozen=True, kw_only=True):
    """A file of a timed action."""

    body = "steps"

    steps: Some[StepEntry]

    def make(self, hand: Hand, find: Find, document: YamlDocument) -> Timed:
        """See `CustomDocument.make`."""
        plans = [StepPlan(s.use, s.alias, s.before, s.after) for s in self.steps]
        return sequence(hand, find, self.name, plans, description=self.description)

    @staticmethod
    def entries(action: Timed) -> dict[str, Any]:
        """See `CustomDocument.entries`."""
        return {
            "steps": [
                {
                    **_use_entry(step.use),
                    "alias": step.alias,
                    "before": float(step.before),
                    "after": float(step.after),
                }
                for step in action.steps
            ]
        }


class GenericDocument(CustomDocument, frozen=True, kw_only=True):
    """A file of a generic action."""

    body = "set_points"

    set_points: SetPoints

    def make(self, hand: Hand, find: Find, document: YamlDocument) -> Generic:
        """See `CustomDocument.make`."""
        posture = _posture(hand, self.set_points, document, ("set_points",))
        return Generic(self.name, posture, self.description)

    @staticmethod
    def entries(action: Generic) -> dict[str, Any]:
        """See `CustomDocument.entries`."""
        return {"set_points": set_points(action.posture)}


CUSTOM: Final[Mapping[ActionKind, type[CustomDocument]]] = {
    ActionKind.GENERIC: GenericDocument,
    ActionKind.COMPOSED: ComposedDocument,
    ActionKind.TIMED: TimedDocument,
}
"""Models of files by kind; kinds that others are made of come first."""


def _use_entry(use: ActionReference) -> dict[str, Any]:
    elements = {"elements": list(use.elements)} if use.elements else {}
    return {"action": use.action, **elements, "scale": float(use.scale)}


def custom_document(action: CustomAction) -> dict[str, Any]:
    """Return the document of a composed, timed or generic action."""
    described = {"description": action.description} if action.description else {}
    return {"name": action.name, **described, **CUSTOM[kind_of(action)].entries(action)}


# --- mistakes --------------------------------------------------------------------------------


def read_document(path: Path) -> YamlDocument:
    """Read a YAML file of actions.

    Raises:
        ActionError: if the file cannot be read, is empty or is not YAML; names the line.
    """
    text = read_text(path, WHAT, ActionError)
    return parse_yaml(text, path, WHAT, ActionError, foreign=True)


@contextmanager
def located(document: YamlDocument, location: Sequence[str | int]) -> Iterator[None]:
    """Add an entry's file and line to errors from inside the context that state none."""
    try:
        yield
    except UserError as error:
        if error.path is not None:
            raise
        line = document.line(tuple(location))
        raise ActionError(error.message, path=document.path, line=line) from None
