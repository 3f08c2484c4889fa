"""Convert actions to fields of messages and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

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

Fields = Mapping[str, Any]


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
            fields["postures"] = [_posture_fields(posture) for posture in action.postures]
            fields["evidence"] = [_evidence_fields(evidence) for evidence in action.evidence]
            return fields
        case Composed():
            fields["independent"] = action.independent
            fields["parts"] = [_part_fields(part) for part in action.parts]
            fields["postures"] = [_posture_fields(action.posture)]
        case Generic():
            fields["postures"] = [_posture_fields(action.posture)]
        case Timed():
            fields["parts"] = [
                _part_fields(step.use, step.alias, step.before, step.after) for step in action.steps
            ]
            fields["postures"] = [_posture_fields(step.posture) for step in action.steps]
    fields["description"] = action.description
    return fields


def _posture_fields(posture: Posture) -> dict[str, Any]:
    return {
        "name": list(posture.position),
        "position": list(posture.position.values()),
        "involved": posture.involved,
    }


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


def _known(value: float | None) -> float:
    return math.nan if value is None else value  # messages have no optional numbers


def _evidence_fields(evidence: Evidence) -> dict[str, Any]:
    opposition = evidence.opposition
    return {
        "depth": evidence.depth,
        "distance": evidence.distance,
        "frame_distance": _known(evidence.frame_distance),
        "contact_at": _known(evidence.contact_at),
        "point": evidence.point or (),
        "normal": evidence.normal or (),
        "clear": evidence.clear,
        "path_clear": evidence.path_clear,
        "clearance": _known(evidence.clearance),
        "colliding": [name for pair in evidence.colliding for name in pair[:2]],
        "pair": [name for first, second, _ in evidence.pairs for name in (first, second)],
        "pair_depth": [depth for _, _, depth in evidence.pairs],
        "angles": opposition.angles if opposition else (),
        "force_closure": opposition.force_closure if opposition else False,
        "friction": opposition.friction if opposition else math.nan,
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
    if len(fields["name"]) != len(fields["position"]):
        raise MessageError("a posture has different numbers of names and positions")
    position = dict(zip(fields["name"], fields["position"].tolist(), strict=True))
    involved = tuple(fields["involved"])
    if not set(involved) <= set(position):
        raise MessageError("a posture involves an actuator without a position")
    return Posture(position, involved)


def _use_of(fields: Fields) -> ActionReference:
    return ActionReference(fields["action"], tuple(fields["elements"]), fields["scale"])


def _primitive_of(fields: Fields, postures: list[Posture]) -> Primitive:
    # The name of a multi-pinch ends with the number of tips: MultiPinchTight_3.
    base = fields["name"].rstrip("0123456789").rstrip("_")
    try:
        kind = PrimitiveKind(base)
    except ValueError:
        raise MessageError(f"unknown primitive '{fields['name']}'") from None
    evidence = tuple(_evidence_of(entry) for entry in fields["evidence"])
    if not postures or len(evidence) not in (0, len(postures)):
        raise MessageError(f"the primitive '{fields['name']}' has no postures")
    fingers = tuple(fields["fingers"])
    return Primitive(kind, tuple(fields["elements"]), tuple(postures), evidence, fingers=fingers)


def _optional(value: float) -> float | None:
    return None if math.isnan(value) else value


def _triple(values: Any) -> tuple[float, float, float] | None:
    if len(values) != 3:
        return None
    x, y, z = values.tolist()
    return (x, y, z)


def _evidence_of(fields: Fields) -> Evidence:
    pairs, links, angles = fields["pair"], fields["colliding"], fields["angles"].tolist()
    depths = fields["pair_depth"].tolist()
    if len(pairs) != 2 * len(depths) or len(links) % 2 or len(angles) not in (0, 2):
        raise MessageError("the evidence has names that are not pairs")
    opposition = None
    if angles:
        pair = (angles[0], angles[1])
        opposition = Opposition(pair, fields["force_closure"], fields["friction"])
    return Evidence(
        depth=fields["depth"],
        distance=fields["distance"],
        frame_distance=_optional(fields["frame_distance"]),
        contact_at=_optional(fields["contact_at"]),
        point=_triple(fields["point"]),
        normal=_triple(fields["normal"]),
        clear=fields["clear"],
        path_clear=fields["path_clear"],
        clearance=_optional(fields["clearance"]),
        colliding=tuple(zip(links[::2], links[1::2], strict=True)),
        pairs=tuple(zip(pairs[::2], pairs[1::2], depths, strict=True)),
        opposition=opposition,
    )


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


def group_fields(group: PrimitiveGroup) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/PrimitiveGroup``."""
    return {
        "name": group.name,
        "selectable": group.selectable,
        "count": group.count,
        "combinations": [{"elements": elements} for elements in group.combinations],
    }


def group_of(fields: Fields) -> PrimitiveGroup:
    """Return the group in the fields of a ``rtee_msgs/PrimitiveGroup``."""
    return PrimitiveGroup(
        fields["name"],
        tuple(fields["selectable"]),
        fields["count"],
        tuple(tuple(entry["elements"]) for entry in fields["combinations"]),
    )
