"""A hand and its actions as plain data, for JSON and for the network."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from typing import Any

from rtee.actions.build import warnings_of
from rtee.actions.documents import evidence_document
from rtee.actions.types import (
    DEEPEST,
    FARTHEST_CLEARANCE,
    Action,
    ActionKind,
    ActionReference,
    Posture,
    Primitive,
    PrimitiveKind,
    kind_of,
)
from rtee.hand.abduction import abduction
from rtee.hand.model import Hand
from rtee.values import plain


def clearance_text(clearance: float) -> str:
    """Return a clearance [m] as text."""
    text = f"{clearance * 1e3:.1f} mm"
    return f"{text} or more" if clearance >= FARTHEST_CLEARANCE else text


def described(use: ActionReference) -> str:
    """Return a reference to an action as text, such as ``Trig thumb × 0.3``."""
    name = " ".join((use.action, *use.elements))
    return name if use.scale == 1.0 else f"{name} × {use.scale:g}"


def deeper_text(primitive: Primitive) -> str:
    """Describe the posture of a pinch that is much deeper than the executed one, if any."""
    deeper = primitive.deeper
    if deeper is None:
        return ""
    state = "" if deeper.clear and deeper.path_clear else ", not clear"
    return f"deepest {deeper.depth * 1e3:.1f} mm{state}: {primitive.name}@{DEEPEST}"


def describe(hand: Hand, actions: Iterable[Action], seconds: float | None = None) -> dict[str, Any]:
    """Return a hand with its actions, ready for JSON.

    ``seconds``: time that it took to find or read the actions [s].

    Returns:
        ``hand``, ``fingers``, ``actuators``, ``primitives``, ``composed``, ``timed``, ``generic``
        and ``seconds``. A limit that a continuous actuator does not have is ``None``.
    """
    document: dict[str, Any] = {
        "hand": hand.name,
        "fingers": {
            finger.name: {"tip": finger.tip, "actuators": list(finger.actuators)}
            for finger in hand.fingers
        },
        "actuators": {
            spec.name: {
                "lower": plain(spec.lower),
                "upper": plain(spec.upper),
                "rest": float(rest),
            }
            for spec, rest in zip(hand.actuators, hand.rest, strict=True)
        },
        **{_section(kind): [] for kind in ActionKind},
    }
    for action in actions:
        document[_section(kind_of(action))].append(describe_action(action))
    if seconds is not None:
        document["seconds"] = seconds
    return document


def _section(kind: ActionKind) -> str:
    return "primitives" if kind is ActionKind.PRIMITIVE else str(kind)


def describe_action(action: Action) -> dict[str, Any]:
    """Return one action as plain data, ready for JSON."""
    if isinstance(action, Primitive):
        return _primitive(action)
    head: dict[str, Any] = {"name": action.name, "description": action.description}
    warnings = warnings_of(action)
    return {**head, **({"warnings": warnings} if warnings else {}), **_plain(action)}


def _primitive(action: Primitive) -> dict[str, Any]:
    ranked = [
        {
            **_posture(posture),
            "evidence": evidence_document(action.evidence[i]) if action.evidence else {},
        }
        for i, posture in enumerate(action.postures)
    ]
    document: dict[str, Any] = {
        "kind": action.name,
        "elements": list(action.elements),
        "fingers": list(action.fingers),
        **ranked[0],
    }
    if len(ranked) > 1:
        document["alternatives"] = ranked[1:]
    return document


def _plain(value: Any) -> Any:
    """Return a field of an action as plain data, including postures and uses of actions."""
    match value:
        case Posture():
            return _posture(value)
        case tuple():
            return [_plain(item) for item in value]
        case _ if not is_dataclass(value):
            return value
    document: dict[str, Any] = {}
    for field in fields(value):
        plain = _plain(getattr(value, field.name))
        document |= plain if isinstance(plain, dict) else {field.name: plain}
    return document


def _posture(posture: Posture) -> dict[str, Any]:
    return {
        "posture": {name: float(value) for name, value in posture.position.items()},
        "involved": list(posture.involved),
    }


def abduction_actuators(hand: Hand, action: Action) -> tuple[str, ...]:
    """Return the abduction actuators of a Trig; none of other actions.

    A Trig moves all actuators that move only its finger, including abduction.
    """
    if not isinstance(action, Primitive) or action.kind is not PrimitiveKind.TRIG:
        return ()
    swinging = dict.fromkeys(
        a for name in action.fingers for a in abduction(hand, hand.finger(name))
    )
    return tuple(name for name in swinging if name in action.posture.involved)


def abduction_sentence(hand: Hand, action: Action, prefix: str = "") -> str:
    """Return a sentence about a Trig's abduction, without a prefix of names, or ``""``."""
    names = [name.removeprefix(prefix) for name in abduction_actuators(hand, action)]
    return f"also swings sideways (abduction): {', '.join(names)}" if names else ""
