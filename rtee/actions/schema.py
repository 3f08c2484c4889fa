"""Documents as actions: what stands in their YAML files, with the line of every mistake."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from rtee.actions.build import StepPlan, check_custom_name, full_posture
from rtee.actions.documents import Node
from rtee.actions.naming import normalise
from rtee.actions.types import (
    ActionKind,
    ActionReference,
    Evidence,
    Opposition,
    Posture,
    Primitive,
    PrimitiveKind,
)
from rtee.errors import UserError, suggestion
from rtee.hand.model import Hand


@dataclass(frozen=True, slots=True)
class Definition:
    """A custom action as it stands in its file, before what it refers to is looked up.

    Attributes:
        kind: Composed, timed or generic.
        name: Its name.
        node: The whole document.
        parts: For a composed action, its parts.
        steps: For a timed action, its steps.
        uses: The entries of parts or steps, for messages.
        independent: For a composed action.
        set_points: For a generic action.
        description: One sentence.
    """

    kind: ActionKind
    name: str
    node: Node
    parts: tuple[ActionReference, ...] = ()
    steps: tuple[StepPlan, ...] = ()
    uses: tuple[Node, ...] = ()
    independent: bool = False
    set_points: Mapping[str, float] | None = None
    description: str = ""


def _located(node: Node, check: Callable[[], Any]) -> Any:
    """Return what ``check`` returns; its error gets the file and the line of an entry."""
    try:
        return check()
    except UserError as error:
        if error.path is not None:
            raise
        raise node.error(error.message) from None


def read_primitives(hand: Hand, node: Node) -> list[Primitive]:
    """Read the document of all primitives of one name.

    Raises:
        ActionError: for every mistake, with file and line.
    """
    fields = node.fields(("kind", "primitives"))
    kind, count = _primitive_kind(fields["kind"])
    return [_read_primitive(hand, kind, count, item) for item in fields["primitives"].items()]


def _primitive_kind(node: Node) -> tuple[PrimitiveKind, int | None]:
    text = node.string()
    base, _, digits = text.rpartition("_")
    for kind in PrimitiveKind:
        if kind.counted:
            if normalise(base) == normalise(kind) and digits.isascii() and digits.isdigit():
                return kind, int(digits[:6])
        elif normalise(text) == normalise(kind):
            return kind, None
    names = [f"{kind}_3" if kind.counted else str(kind) for kind in PrimitiveKind]
    raise node.error(f"unknown kind '{text}'; {suggestion(text, names)}")


def _read_primitive(hand: Hand, kind: PrimitiveKind, count: int | None, node: Node) -> Primitive:
    fields = node.fields(("elements", "postures"), ("fingers",))
    elements = fields["elements"].strings()
    single = kind is PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS
    source = fields["elements"]
    if single:
        _located(source, lambda: [hand.actuator(name) for name in elements])
        source = fields.get("fingers", node)
        fingers = source.strings() if "fingers" in fields else ()
    else:
        fingers = elements
    _located(source, lambda: [hand.finger(name) for name in fingers])
    needed = _elements_needed(kind, count)
    if len(elements) != needed or len(set(elements)) != needed:
        raise fields["elements"].error(f"{kind} takes {needed} different elements")
    if count is not None and len(set(fingers)) != count:
        raise source.error(f"{kind}_{count} moves {count} fingers, not {len(set(fingers))}")
    postures, evidence = _read_postures(hand, fields["postures"])
    return Primitive(kind, elements, postures, evidence, len(fingers), fingers)


def _elements_needed(kind: PrimitiveKind, count: int | None) -> int:
    if kind is PrimitiveKind.MULTI_PINCH_TIGHT:
        return count or 0
    return 2 if kind in (PrimitiveKind.PINCH_TIGHT, PrimitiveKind.PINCH_LOOSE) else 1


def _read_postures(hand: Hand, node: Node) -> tuple[tuple[Posture, ...], tuple[Evidence, ...]]:
    postures: list[Posture] = []
    evidence: list[Evidence] = []
    for item in node.items():
        fields = item.fields(("set_points",), ("evidence",))
        postures.append(_read_set_points(hand, fields["set_points"]))
        if "evidence" in fields:
            evidence.append(_read_evidence(fields["evidence"]))
    if not postures:
        raise node.error("a primitive needs at least one posture")
    if evidence and len(evidence) != len(postures):
        raise node.error("either every posture has evidence, or none")
    return tuple(postures), tuple(evidence)


def _read_set_points(hand: Hand, node: Node) -> Posture:
    values = {name: entry.number() for name, entry in node.entries().items()}
    for name, entry in node.entries().items():
        _located(entry, partial(full_posture, hand, {name: values[name]}))
    return full_posture(hand, values)


_EVIDENCE = (
    "depth",
    "distance",
    "frame_distance",
    "contact_at",
    "point",
    "normal",
    "clear",
    "path_clear",
    "clearance",
    "colliding",
    "pairs",
    "opposition",
)


def _read_evidence(node: Node) -> Evidence:
    fields = node.fields((), _EVIDENCE)
    found: dict[str, Any] = {}
    for key in ("depth", "distance", "frame_distance", "contact_at", "clearance"):
        if key in fields:
            found[key] = fields[key].number(lowest=0.0)
    for key in ("point", "normal"):
        if key in fields:
            found[key] = fields[key].numbers(3)
    for key in ("clear", "path_clear"):
        if key in fields:
            found[key] = fields[key].flag()
    if "colliding" in fields:
        pairs = [item.strings() for item in fields["colliding"].items()]
        if any(len(pair) != 2 for pair in pairs):
            raise fields["colliding"].error("'colliding' must be a list of pairs of links")
        found["colliding"] = tuple(pairs)
    if "pairs" in fields:
        found["pairs"] = tuple(_read_pair(item) for item in fields["pairs"].items())
    if "opposition" in fields:
        found["opposition"] = _read_opposition(fields["opposition"])
    return Evidence(**found)


def _read_pair(node: Node) -> tuple[str, str, float]:
    items = node.items()
    if len(items) != 3:
        raise node.error("a pair is [finger, finger, depth]")
    return items[0].string(), items[1].string(), items[2].number(lowest=0.0)


def _read_opposition(node: Node) -> Opposition:
    fields = node.fields(("angles", "force_closure"), ("friction",))
    first, second = fields["angles"].numbers(2)
    friction = fields["friction"].number(lowest=0.0) if "friction" in fields else 0.5
    return Opposition((first, second), fields["force_closure"].flag(), friction)


def read_definition(kind: ActionKind, node: Node) -> Definition:
    """Read the document of a composed, timed or generic action.

    Raises:
        ActionError: for every mistake, with file and line.
    """
    body = {
        ActionKind.COMPOSED: "parts",
        ActionKind.TIMED: "steps",
        ActionKind.GENERIC: "set_points",
    }[kind]
    optional = ("description", "independent") if kind is ActionKind.COMPOSED else ("description",)
    fields = node.fields(("name", body), optional)
    name = fields["name"].string()
    _located(fields["name"], lambda: check_custom_name(name))
    found: dict[str, Any] = {}
    if "description" in fields:
        found["description"] = fields["description"].string()
    if "independent" in fields:
        found["independent"] = fields["independent"].flag()
    if kind is ActionKind.GENERIC:
        entries = fields[body].entries()
        found["set_points"] = {key: entry.number() for key, entry in entries.items()}
        found["uses"] = tuple(entries.values())
    else:
        items = fields[body].items()
        if not items:
            raise fields[body].error(f"'{body}' is empty")
        found["uses"] = tuple(items)
        read = _read_part if kind is ActionKind.COMPOSED else _read_step
        found[body] = tuple(read(item) for item in items)
    return Definition(kind, name, node, **found)


def _read_use(fields: Mapping[str, Node]) -> ActionReference:
    return ActionReference(
        fields["action"].string(),
        fields["elements"].strings() if "elements" in fields else (),
        fields["scale"].number(lowest=0.0) if "scale" in fields else 1.0,
    )


def _read_part(node: Node) -> ActionReference:
    return _read_use(node.fields(("action",), ("elements", "scale")))


def _read_step(node: Node) -> StepPlan:
    fields = node.fields(("action",), ("elements", "scale", "alias", "before", "after"))
    alias = fields["alias"].string() if "alias" in fields else ""
    before, after = (
        fields[side].number(lowest=0.0) if side in fields else 0.0 for side in ("before", "after")
    )
    return StepPlan(_read_use(fields), alias, before, after)
