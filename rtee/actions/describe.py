"""A hand and its actions as one plain object, for JSON and for the network."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from rtee.actions.build import warnings_of
from rtee.actions.types import (
    FARTHEST_CLEARANCE,
    Action,
    ActionReference,
    Composed,
    Generic,
    Posture,
    Primitive,
    Timed,
)
from rtee.actions.writing import evidence_document
from rtee.hand.model import Hand


def clearance_text(clearance: float) -> str:
    """Return a clearance [m] in words."""
    text = f"{clearance * 1e3:.1f} mm"
    return f"{text} or more" if clearance >= FARTHEST_CLEARANCE else text


def describe(hand: Hand, actions: Iterable[Action], seconds: float | None = None) -> dict[str, Any]:
    """Return a hand with its actions, ready for JSON.

    Args:
        hand: The hand.
        actions: Its actions.
        seconds: How long it took to find or read them [s], if this is told.

    Returns:
        ``hand``, ``fingers``, ``actuators``, ``primitives``, ``composed``, ``timed``, ``generic``
        and ``seconds``. A limit that a continuous actuator does not have is ``None``.
    """
    found: dict[str, Any] = {
        "hand": hand.name,
        "fingers": {
            finger.name: {"tip": finger.tip, "actuators": list(finger.actuators)}
            for finger in hand.fingers
        },
        "actuators": {
            spec.name: {
                "lower": _finite(spec.lower),
                "upper": _finite(spec.upper),
                "rest": float(rest),
            }
            for spec, rest in zip(hand.actuators, hand.rest, strict=True)
        },
        "primitives": [],
        "composed": [],
        "timed": [],
        "generic": [],
    }
    rooms = {Primitive: "primitives", Composed: "composed", Timed: "timed", Generic: "generic"}
    for action in actions:
        found[rooms[type(action)]].append(describe_action(action))
    if seconds is not None:
        found["seconds"] = seconds
    return found


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def describe_action(action: Action) -> dict[str, Any]:
    """Return one action as plain data, ready for JSON."""
    match action:
        case Primitive():
            return _primitive(action)
        case Composed():
            head = {"independent": action.independent, "parts": [_use(p) for p in action.parts]}
            return {**_head(action), **head, **_posture(action.posture)}
        case Timed():
            steps = [
                {
                    "alias": step.alias,
                    **_use(step.use),
                    "before": step.before,
                    "after": step.after,
                    **_posture(step.posture),
                }
                for step in action.steps
            ]
            return {**_head(action), "steps": steps}
        case Generic():
            return {**_head(action), **_posture(action.posture)}


def _primitive(action: Primitive) -> dict[str, Any]:
    ranked = [
        {
            **_posture(posture),
            "evidence": evidence_document(action.evidence[i]) if action.evidence else {},
        }
        for i, posture in enumerate(action.postures)
    ]
    found: dict[str, Any] = {
        "kind": action.name,
        "elements": list(action.elements),
        "fingers": list(action.fingers),
        **ranked[0],
    }
    if len(ranked) > 1:
        found["alternatives"] = ranked[1:]
    return found


def _head(action: Composed | Timed | Generic) -> dict[str, Any]:
    head: dict[str, Any] = {"name": action.name, "description": action.description}
    warnings = warnings_of(action)
    return {**head, "warnings": warnings} if warnings else head


def _use(use: ActionReference) -> dict[str, Any]:
    return {"action": use.action, "elements": list(use.elements), "scale": use.scale}


def _posture(posture: Posture) -> dict[str, Any]:
    return {
        "posture": {name: float(value) for name, value in posture.position.items()},
        "involved": list(posture.involved),
    }
