"""Goals as flat options: in messages, on command lines and as arguments of calls.

This is the only place that tells the kind of a goal from the options that are given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rtee.errors import GoalRejected
from rtee.messages.codec import As, Codec, paired, word
from rtee.types import (
    Around,
    Fingers,
    FirstContact,
    Force,
    Goal,
    Intensity,
    Named,
    OnContact,
    Opening,
    Stage,
    TipSpeed,
)


def number(name: str) -> As:
    """Return the conversion of an optional number to a field, with ``NaN`` for ``None``."""
    return As(
        {name: lambda value: math.nan if value is None else value},
        lambda value: None if math.isnan(value) else value,
    )


def goal_of(
    action: str = "",
    elements: Sequence[str] = (),
    kind: str | None = None,
    *,
    intensity: float = 1.0,
    stage: Stage = Stage.BOTH,
    tolerance: float = 0.01,
    opening: float | None = None,
    narrower: float = 0.005,
    wider: float = 0.005,
    grasp: bool = False,
    touch: bool = False,
    speed: float = 1.0,
    tip_speed: float | None = None,
    effort: Mapping[str, float] | None = None,
    force: float | None = None,
    max_force: float | None = None,
    **others: Any,
) -> Goal:
    """Return the goal that options ask for.

    Args:
        action: Name of the action; empty: the best one of the fingers in ``elements``.
        elements: Fingers or actuator.
        kind: Kind of the action, where its name is ambiguous.
        intensity: Intensity of the action.
        stage: Stages of a pinch.
        tolerance: Norm of the error at which the goal counts as reached [rad | m].
        opening: Opening of the fingertips; with ``grasp``, the width of the object [m].
        narrower: Tolerance of the width below it [m].
        wider: Tolerance of the width above it [m].
        grasp: Whether to open wider than the object, then close on it.
        touch: Whether to close slowly until the first contact.
        speed: Share of the velocity limits.
        tip_speed: Speed of the opening, instead of ``speed`` [m/s].
        effort: Effort limits by actuator [N·m | N].
        force: Force between the fingertips, instead of ``effort`` [N].
        max_force: Force up to which slips raise ``force`` [N].
        others: Attributes of the `Goal` with the same name.

    Raises:
        GoalRejected: if a value cannot be used, or two of them exclude one another.
    """
    return Goal(
        _what(action, elements, kind),
        _to(intensity, stage, tolerance, opening, narrower, wider, grasp, touch),
        _speed(speed, tip_speed),
        _effort({} if effort is None else effort, force, max_force),
        **others,
    )


def _what(action: str, elements: Sequence[str], kind: str | None) -> Named | Fingers:
    return Named(action, tuple(elements), kind or None) if action else Fingers(tuple(elements))


def _to(
    intensity: float,
    stage: Stage,
    tolerance: float,
    opening: float | None,
    narrower: float,
    wider: float,
    grasp: bool,
    touch: bool,
) -> Intensity | Opening | Around | FirstContact:
    posture = Intensity(intensity, stage, tolerance)
    if touch and (grasp or opening is not None):
        raise GoalRejected("a touch takes no opening: it stops by itself")
    if not (touch or grasp) and opening is None:
        return posture
    if (posture.share, posture.stage) != (1.0, Stage.BOTH):
        what = "an intensity" if posture.share != 1.0 else "a stage"
        raise GoalRejected(f"give {what} or {'a touch' if touch else 'an opening'}, not both")
    if touch:
        return FirstContact(tolerance)
    if opening is None:
        raise GoalRejected("a grasp needs the width of the object, in metres")
    return Around(opening, narrower, wider) if grasp else Opening(opening)


def _speed(speed: float, tip_speed: float | None) -> float | TipSpeed:
    if tip_speed is None:
        return speed
    if speed != 1.0:
        raise GoalRejected("give the speed as a share or in m/s, not both")
    return TipSpeed(tip_speed)


def _effort(
    efforts: Mapping[str, float], force: float | None, most: float | None
) -> Mapping[str, float] | Force:
    if force is None:
        if most is not None:
            raise GoalRejected("a largest force needs the force to begin with")
        return efforts
    if efforts:
        raise GoalRejected("give efforts or a force, not both")
    return Force(force, most)


def _attribute(kind: type | tuple[type, ...], name: str, otherwise: Any) -> Any:
    """Return a function that returns an attribute of objects of a kind, a default for others."""
    return lambda value: getattr(value, name) if isinstance(value, kind) else otherwise


def _optional(value: float) -> float | None:
    return None if math.isnan(value) else value


_NONE = math.nan

# The words come from the network and may have any length.
_STAGE = word("stage", Stage, "stage '{:.50}' is none of both, pre_grasp, grasp")
_ON_CONTACT = word("on_contact", OnContact, "on_contact '{:.50}' is none of stop, hold, squeeze")

GOAL = Codec(
    "rtee_msgs/msg/Goal",
    Goal,
    what=As(
        {
            "action": _attribute(Named, "action", ""),
            "elements": lambda what: what.elements,
            "kind": lambda what: (isinstance(what, Named) and what.kind) or "",
        },
        _what,
    ),
    to=As(
        {
            "intensity": _attribute(Intensity, "share", 1.0),
            "stage": _attribute(Intensity, "stage", Stage.BOTH),
            "tolerance": _attribute((Intensity, FirstContact), "tolerance", 0.01),
            "opening": _attribute((Opening, Around), "width", _NONE),
            "narrower": _attribute(Around, "narrower", 0.005),
            "wider": _attribute(Around, "wider", 0.005),
            "grasp": lambda to: isinstance(to, Around),
            "touch": lambda to: isinstance(to, FirstContact),
        },
        lambda intensity, stage, tolerance, opening, *others: _to(
            intensity, _STAGE.unpack(stage), tolerance, _optional(opening), *others
        ),
    ),
    speed=As(
        {
            "speed": lambda speed: 1.0 if isinstance(speed, TipSpeed) else speed,
            "tip_speed": _attribute(TipSpeed, "value", _NONE),
        },
        lambda speed, tip_speed: _speed(speed, _optional(tip_speed)),
    ),
    effort=As(
        {
            "effort_name": lambda effort: [] if isinstance(effort, Force) else list(effort),
            "effort": lambda effort: [] if isinstance(effort, Force) else list(effort.values()),
            "force": _attribute(Force, "value", _NONE),
            "max_force": lambda effort: _most(effort),
        },
        lambda names, values, force, most: _effort(
            paired("effort", names, values), _optional(force), _optional(most)
        ),
    ),
    on_contact=As(
        {"contact_finger": list, "on_contact": lambda by_finger: list(by_finger.values())},
        lambda fingers, words: paired("on_contact", fingers, list(map(_ON_CONTACT.unpack, words))),
    ),
    timeout=number("timeout"),
)
"""Goals in CDR."""


def _most(effort: Mapping[str, float] | Force) -> float:
    most = effort.most if isinstance(effort, Force) else None
    return math.nan if most is None else most
