"""Convert actions to fields of messages and back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from rtee.actions.build import StepPlan, generic
from rtee.actions.library import ActionLibrary
from rtee.actions.types import (
    Action,
    ActionReference,
    Composed,
    Evidence,
    Generic,
    Opposition,
    Posture,
    Primitive,
    PrimitiveGroup,
    PrimitiveKind,
    Step,
    Timed,
    kind_of,
)
from rtee.errors import ActionError, MessageError
from rtee.messages.codec import As, Codec, field, mapping, optional

Fields = Mapping[str, Any]

GROUP: Final = Codec(
    "rtee_msgs/msg/PrimitiveGroup",
    PrimitiveGroup,
    selectable=field("selectable", tuple),
    combinations=As(
        {"combinations": lambda several: [{"elements": elements} for elements in several]},
        lambda entries: tuple(tuple(entry["elements"]) for entry in entries),
    ),
)

_POSTURE: Final = Codec(
    "rtee_msgs/msg/Posture",
    Posture,
    position=mapping("name", "position"),
    involved=field("involved", tuple),
)


def _triple(name: str) -> As:
    return As(
        {name: lambda value: value or ()},
        lambda values: tuple(values) if len(values) == 3 else None,
    )


def _in_pairs(names: Sequence[str]) -> tuple[tuple[str, str], ...]:
    if len(names) % 2:
        raise MessageError("the evidence has names that are not pairs")
    return tuple(zip(names[::2], names[1::2], strict=True))


def _touching(names: Sequence[str], depths: Sequence[float]) -> tuple[tuple[str, str, float], ...]:
    if len(names) != 2 * len(depths):
        raise MessageError("the evidence has names that are not pairs")
    return tuple(zip(names[::2], names[1::2], depths, strict=True))


def _opposition(angles: Sequence[float], force_closure: bool, friction: float) -> Opposition | None:
    if len(angles) not in (0, 2):
        raise MessageError("the evidence has angles that are not a pair")
    return Opposition((angles[0], angles[1]), force_closure, friction) if angles else None


_EVIDENCE: Final = Codec(
    "rtee_msgs/msg/Evidence",
    Evidence,
    frame_distance=optional("frame_distance"),
    contact_at=optional("contact_at"),
    clearance=optional("clearance"),
    point=_triple("point"),
    normal=_triple("normal"),
    colliding=As({"colliding": lambda pairs: [name for pair in pairs for name in pair]}, _in_pairs),
    pairs=As(
        {
            "pair": lambda pairs: [name for first, second, _ in pairs for name in (first, second)],
            "pair_depth": lambda pairs: [depth for _, _, depth in pairs],
        },
        _touching,
    ),
    opposition=As(
        {
            "angles": lambda found: found.angles if found else (),
            "force_closure": lambda found: found is not None and found.force_closure,
            "friction": lambda found: found.friction if found else math.nan,
        },
        _opposition,
    ),
)


def action_fields(action: Action, stored: bool = True) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/Action``; raises `ActionError` for anything else."""
    fields: dict[str, Any] = {
        "kind": str(kind_of(action)),
        "name": action.name,
        "elements": (),
        "fingers": (),
        "description": "",
        "independent": False,
        "stored": stored,
        "postures": (),
        "evidence": (),
        "parts": (),
    }
    match action:
        case Primitive():
            # A primitive has no description: it returns before that is filled in.
            fields["elements"], fields["fingers"] = action.elements, action.fingers
            fields["postures"] = list(map(_POSTURE.fields, action.postures))
            fields["evidence"] = list(map(_EVIDENCE.fields, action.evidence))
            return fields
        case Composed():
            fields["independent"] = action.independent
            fields["parts"] = [_part_fields(part) for part in action.parts]
            fields["postures"] = [_POSTURE.fields(action.posture)]
        case Generic():
            fields["postures"] = [_POSTURE.fields(action.posture)]
        case Timed():
            fields["parts"] = [
                _part_fields(step.use, step.alias, step.before, step.after) for step in action.steps
            ]
            fields["postures"] = [_POSTURE.fields(step.posture) for step in action.steps]
    fields["description"] = action.description
    return fields


def _part_fields(
    use: ActionReference, alias: str = "", before: float = 0.0, after: float = 0.0
) -> dict[str, Any]:
    return {
        "action": use.action,
        "elements": use.elements,
        "scale": use.scale,
        "alias": alias,
        "before": before,
        "after": after,
    }


def action_of(fields: Fields) -> Action:
    """Return the action in the fields of a ``rtee_msgs/Action``.

    Raises `MessageError` if the fields do not describe an action.
    """
    postures = [_posture_from(posture) for posture in fields["postures"]]
    name, kind, description = fields["name"], fields["kind"], fields["description"]
    if kind == "primitive":
        return _primitive_of(fields, postures)
    if kind == "timed" and len(postures) == len(fields["parts"]):
        steps = [
            Step(_use_of(part), part["alias"], part["before"], part["after"], posture)
            for part, posture in zip(fields["parts"], postures, strict=True)
        ]
        return Timed(name, tuple(steps), description)
    if len(postures) == 1 and kind == "composed":
        parts = tuple(_use_of(part) for part in fields["parts"])
        return Composed(name, parts, postures[0], fields["independent"], description)
    if len(postures) == 1 and kind == "generic":
        return Generic(name, postures[0], description)
    raise MessageError(f"no action of the kind '{kind}' with {len(postures)} postures")


def _posture_from(fields: Fields) -> Posture:
    posture = _POSTURE.of(fields)
    if not set(posture.involved) <= set(posture.position):
        raise MessageError("a posture involves an actuator without a position")
    return posture


def _use_of(fields: Fields) -> ActionReference:
    return ActionReference(fields["action"], tuple(fields["elements"]), fields["scale"])


def _primitive_of(fields: Fields, postures: list[Posture]) -> Primitive:
    # The name of a multi-pinch ends with the number of tips: MultiPinchTight_3.
    base = fields["name"].rstrip("0123456789").rstrip("_")
    try:
        kind = PrimitiveKind(base)
    except ValueError:
        raise MessageError(f"unknown primitive '{fields['name']}'") from None
    evidence = tuple(map(_EVIDENCE.of, fields["evidence"]))
    if not postures or len(evidence) not in (0, len(postures)):
        raise MessageError(f"the primitive '{fields['name']}' has no postures")
    fingers = tuple(fields["fingers"])
    return Primitive(kind, tuple(fields["elements"]), tuple(postures), evidence, fingers=fingers)


def build_action(library: ActionLibrary, fields: Fields) -> Action:
    """Make the composed, timed or generic action in a client's ``rtee_msgs/Action``.

    Its postures are computed from its parts, which are looked up in the hand's library. Raises
    `ActionError` if the action cannot be made, `MessageError` if the fields do not describe one.
    """
    name, description = fields["name"], fields["description"]
    match fields["kind"]:
        case "composed":
            parts = [_use_of(part) for part in fields["parts"]]
            flag = fields["independent"]
            return library.compose(name, parts, independent=flag, description=description)
        case "timed":
            plans = [
                StepPlan(_use_of(part), part["alias"], part["before"], part["after"])
                for part in fields["parts"]
            ]
            return library.sequence(name, plans, description=description)
        case "generic":
            if len(fields["postures"]) != 1:
                raise MessageError("a generic action must have one posture")
            posture = _posture_from(fields["postures"][0])
            # The positions of all other actuators are only there to draw the posture.
            chosen = {actuator: posture.position[actuator] for actuator in posture.involved}
            return generic(library.hand, name, chosen, description=description)
    raise ActionError(
        f"only composed, timed and generic actions can be added, not {fields['kind']}"
    )
