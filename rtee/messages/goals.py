"""Goals as flat options: in messages, on command lines and as arguments of calls.

Only this module derives the kind of a goal from the given options.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from rtee.errors import GoalRejected, MessageError
from rtee.messages.codec import Codec, paired, word
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
    what = Named(action, tuple(elements), kind or None) if action else Fingers(tuple(elements))
    to: Intensity | Opening | Around | FirstContact = Intensity(intensity, stage, tolerance)
    if touch or grasp or opening is not None:
        other = "a touch" if touch else "an opening"
        if intensity != 1.0 or stage is not Stage.BOTH:
            first = "an intensity" if intensity != 1.0 else "a stage"
            raise GoalRejected(f"give {first} or {other}, not both")
        if touch and (grasp or opening is not None):
            raise GoalRejected("a touch takes no opening: it stops by itself")
        if touch:
            to = FirstContact(tolerance)
        elif opening is None:
            raise GoalRejected("a grasp needs the width of the object, in metres")
        else:
            to = Around(opening, narrower, wider) if grasp else Opening(opening)
    if tip_speed is not None and speed != 1.0:
        raise GoalRejected("give the speed as a share or in m/s, not both")
    if force is not None and effort:
        raise GoalRejected("give efforts or a force, not both")
    if force is None and max_force is not None:
        raise GoalRejected("a largest force needs an initial force")
    pressing = (effort or {}) if force is None else Force(force, max_force)
    return Goal(what, to, speed if tip_speed is None else TipSpeed(tip_speed), pressing, **others)


def _fields(goal: Goal) -> dict[str, Any]:
    """Return the fields of the message for a goal, without header and time."""
    what, to, speed = goal.what, goal.to, goal.speed
    if not isinstance(what, Named | Fingers):
        raise MessageError(f"a goal is for Named(…) or Fingers(…), not for {what!r:.100}")
    efforts = {} if isinstance(goal.effort, Force) else goal.effort
    optional = {
        "opening": getattr(to, "width", None),
        "tip_speed": getattr(speed, "value", None),
        "force": getattr(goal.effort, "value", None),
        "max_force": getattr(goal.effort, "most", None),
        "timeout": goal.timeout,
    }
    return {
        "goal_id": goal.goal_id,
        "client": goal.client,
        "action": getattr(what, "action", ""),
        "elements": what.elements,
        "kind": getattr(what, "kind", None) or "",
        "intensity": getattr(to, "share", 1.0),
        "stage": getattr(to, "stage", Stage.BOTH),
        "tolerance": getattr(to, "tolerance", 0.01),
        "narrower": getattr(to, "narrower", 0.005),
        "wider": getattr(to, "wider", 0.005),
        "grasp": isinstance(to, Around),
        "touch": isinstance(to, FirstContact),
        "speed": 1.0 if isinstance(speed, TipSpeed) else speed,
        "effort_name": list(efforts),
        "effort": list(efforts.values()),
        "contact_finger": list(goal.on_contact),
        "on_contact": list(goal.on_contact.values()),
        **{name: math.nan if value is None else value for name, value in optional.items()},
    }


_WITHOUT: Final = ("header", "time")
"""Fields that are no options of a goal."""

OPTIONAL = ("opening", "tip_speed", "force", "max_force", "timeout")
"""Fields that are ``NaN`` for a goal without the value."""

# The words come from the network and may have any length.
_STAGE = word("stage", Stage, "stage '{:.50}' must be both, pre_grasp or grasp")
_ON_CONTACT = word("on_contact", OnContact, "on_contact '{:.50}' must be stop, hold or squeeze")


def _goal(fields: Mapping[str, Any]) -> Goal:
    """Return the goal in the fields of a message."""
    options = dict(fields)
    for name in OPTIONAL:
        if math.isnan(options[name]):
            options[name] = None
    words = list(map(_ON_CONTACT.unpack, options["on_contact"]))
    options["stage"] = _STAGE.unpack(options["stage"])
    options["effort"] = paired("effort", options.pop("effort_name"), options["effort"])
    options["on_contact"] = paired("on_contact", options.pop("contact_finger"), words)
    for name in _WITHOUT:
        options.pop(name, None)
    return goal_of(**options)


GOAL = Codec("rtee_msgs/msg/Goal", Goal, whole=(_fields, _goal))
"""Goals in CDR."""
