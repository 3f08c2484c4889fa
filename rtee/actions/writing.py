"""Actions as documents: what is written to their YAML files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rtee.actions.types import (
    Action,
    ActionReference,
    Composed,
    Evidence,
    Generic,
    Posture,
    Primitive,
    PrimitiveKind,
    Timed,
)


def primitive_document(primitives: Sequence[Primitive]) -> dict[str, Any]:
    """Return the document of all primitives of one name."""
    return {"kind": primitives[0].name, "primitives": [_primitive(p) for p in primitives]}


def _primitive(primitive: Primitive) -> dict[str, Any]:
    entry: dict[str, Any] = {"elements": list(primitive.elements)}
    if primitive.kind is PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS:
        entry["fingers"] = list(primitive.fingers)
    entry["postures"] = [
        _posture(posture, primitive.evidence[i] if primitive.evidence else None)
        for i, posture in enumerate(primitive.postures)
    ]
    return entry


def _posture(posture: Posture, evidence: Evidence | None) -> dict[str, Any]:
    entry: dict[str, Any] = {"set_points": set_points(posture)}
    if evidence is not None:
        entry["evidence"] = evidence_document(evidence)
    return entry


def set_points(posture: Posture) -> dict[str, float]:
    """Return the positions of the involved actuators [rad | m]."""
    return {name: float(posture.position[name]) for name in posture.involved}


def evidence_document(evidence: Evidence) -> dict[str, Any]:
    """Return evidence as plain data, without what is not known."""
    entry: dict[str, Any] = {"depth": float(evidence.depth), "distance": float(evidence.distance)}
    for key in ("frame_distance", "contact_at"):
        if getattr(evidence, key) is not None:
            entry[key] = float(getattr(evidence, key))
    for key in ("point", "normal"):
        if getattr(evidence, key) is not None:
            entry[key] = [float(x) for x in getattr(evidence, key)]
    entry["clear"] = bool(evidence.clear)
    entry["path_clear"] = bool(evidence.path_clear)
    if evidence.clearance is not None:
        entry["clearance"] = float(evidence.clearance)
    if evidence.colliding:
        entry["colliding"] = [list(pair) for pair in evidence.colliding]
    if evidence.pairs:
        entry["pairs"] = [[a, b, float(depth)] for a, b, depth in evidence.pairs]
    if evidence.opposition is not None:
        entry["opposition"] = {
            "angles": [float(angle) for angle in evidence.opposition.angles],
            "force_closure": bool(evidence.opposition.force_closure),
            "friction": float(evidence.opposition.friction),
        }
    return entry


def custom_document(action: Action) -> dict[str, Any]:
    """Return the document of a composed, timed or generic action."""
    entry: dict[str, Any] = {"name": action.name}
    if isinstance(action, (Composed, Timed, Generic)) and action.description:
        entry["description"] = action.description
    match action:
        case Composed():
            entry["independent"] = action.independent
            entry["parts"] = [_use(part) for part in action.parts]
        case Timed():
            entry["steps"] = [
                {
                    **_use(step.use),
                    "alias": step.alias,
                    "before": float(step.before),
                    "after": float(step.after),
                }
                for step in action.steps
            ]
        case Generic():
            entry["set_points"] = set_points(action.posture)
        case Primitive():
            raise TypeError("a primitive has no document of its own")
    return entry


def _use(use: ActionReference) -> dict[str, Any]:
    entry: dict[str, Any] = {"action": use.action}
    if use.elements:
        entry["elements"] = list(use.elements)
    entry["scale"] = float(use.scale)
    return entry
