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


_BLANK: Final[Mapping[str, Any]] = {
    "kind": "",
    "action": "",
    "intensity": 1.0,
    "stage": Stage.BOTH,
    "tolerance": 0.01,
    "opening": math.nan,
    "narrower": 0.005,
    "wider": 0.005,
    "grasp": False,
    "touch": False,
    "speed": 1.0,
    "tip_speed": math.nan,
    "effort_name": (),
    "effort": (),
    "force": math.nan,
    "max_force": math.nan,
    "timeout": math.nan,
}
"""Fields of the message for a goal without the values of its kind, without header and time."""

OPTIONAL = ("opening", "tip_speed", "force", "max_force", "timeout")
"""Fields that are ``NaN`` for a goal without the value."""


def _fields(goal: Goal) -> dict[str, Any]:
    """Return the fields of the message for a goal, without header and time."""
    what, to, speed, effort = goal.what, goal.to, goal.speed, goal.effort
    if not isinstance(what, Named | Fingers):
        raise MessageError(f"'what' must be Named(…) or Fingers(…), not {what!r:.100}")
    fields = {
        **_BLANK,
        "goal_id": goal.goal_id,
        "client": goal.client,
        "elements": what.elements,
        "contact_finger": list(goal.on_contact),
        "on_contact": list(goal.on_contact.values()),
    }
    if isinstance(what, Named):
        fields["action"], fields["kind"] = what.action, what.kind or ""
    match to:
        case Intensity():
            fields |= {"intensity": to.share, "stage": to.stage, "tolerance": to.tolerance}
        case FirstContact():
            fields |= {"touch": True, "tolerance": to.tolerance}
        case Around():
            fields |= {"grasp": True, "narrower": to.narrower, "wider": to.wider}
            fields["opening"] = to.width
        case _:
            fields["opening"] = to.width
    if isinstance(speed, TipSpeed):
        fields["tip_speed"] = speed.value
    else:
        fields["speed"] = speed
    if isinstance(effort, Force):
        fields["force"] = effort.value
        if effort.most is not None:
            fields["max_force"] = effort.most
    else:
        fields["effort_name"], fields["effort"] = list(effort), list(effort.values())
    if goal.timeout is not None:
        fields["timeout"] = goal.timeout
    return fields


# The words come from the network and may have any length.
_STAGE = word("stage", Stage, "stage '{:.50}' must be both, pre_grasp or grasp")
_ON_CONTACT = word("on_contact", OnContact, "on_contact '{:.50}' must be stop, hold or squeeze")


def _goal(options: dict[str, Any]) -> Goal:
    """Return the goal in the fields of a message, which become its options."""
    # Those that are no options of a goal.
    options.pop("header", None)
    options.pop("time", None)
    for name in OPTIONAL:
        if options[name] != options[name]:
            options[name] = None
    options["stage"] = _STAGE.unpack(options["stage"])
    names, fingers = options.pop("effort_name"), options.pop("contact_finger")
    options["effort"] = paired("effort", names, options["effort"])
    words = [_ON_CONTACT.unpack(word) for word in options["on_contact"]]
    options["on_contact"] = paired("on_contact", fingers, words)
    return goal_of(**options)


GOAL = Codec("rtee_msgs/msg/Goal", Goal, whole=(_fields, _goal))
"""Goals in CDR."""

_ID = slice(32, 48)
"""Place of the identifier in a goal's message, behind header and time, if it has the sixteen digits
of `new_goal_id`."""


def with_new_id(message: bytes, goal_id: str) -> bytes:
    """Return a goal's message with another identifier; both are by `new_goal_id`."""
    return b"".join((message[: _ID.start], goal_id.encode(), message[_ID.stop :]))
