"""The action ``~/grasp``, whose goals have all options of the hand's own goals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from rtee.errors import GoalRejected, suggestion
from rtee.messages.goals import goal_of
from rtee.ros2.action_server import ActionServer, Offer
from rtee.ros2.face import Face
from rtee.ros2.hand_goals import ActionPart, HandJob
from rtee.ros2.message import Message
from rtee.types import Feedback, Goal, OnContact, Result, Stage

GRASP = "~/grasp"
"""Name of the action."""

V = TypeVar("V")


class Grasp(ActionPart):
    """Offers the action ``~/grasp``."""

    def __init__(self, face: Face) -> None:
        self._face = face
        self._type = face.node.context.interfaces.action("rtee_msgs/action/Grasp")
        self._server = ActionServer(face.node, GRASP, Offer(self._type, self._accept))

    async def _accept(self, message: Any) -> HandJob:
        running = await self._face.hand.start_goal(goal_in(message))
        return HandJob(running, self._result, _feedback)

    def _result(self, result: Result) -> Message:
        kind = self._type.result
        names = {field.name for field in kind.STRUCTURE.fields}
        fields = {name: getattr(result, name) for name in names if hasattr(result, name)}
        # ROS 2 has no optional fields; a sequence of at most one value takes their place.
        for name in ("opening", "force", "force_error"):
            fields[name] = [] if fields[name] is None else [fields[name]]
        fields["within"] = fields["within"] is True
        fields["position_name"] = list(result.position)
        fields["position"] = list(result.position.values())
        return kind(**fields)


def goal_in(message: Any) -> Goal:
    """Return the goal in a ``rtee_msgs/action/Grasp_Goal``; leave checks of numbers to the hand.

    Raises `GoalRejected` if names and values do not match, or a keyword is unknown.
    """
    fingers = _pairs(message.contact_finger, message.on_contact, "on_contact")
    return goal_of(
        message.action,
        tuple(message.elements),
        kind=message.kind or None,
        intensity=message.intensity,
        effort=_pairs(message.effort_name, list(map(float, message.effort)), "effort"),
        tolerance=message.tolerance,
        speed=message.speed,
        timeout=_optional(message.timeout),
        stage=_word(Stage, message.stage, "stage"),
        opening=_optional(message.opening),
        force=_optional(message.force),
        grasp=message.grasp,
        tip_speed=_optional(message.tip_speed),
        narrower=message.narrower,
        wider=message.wider,
        on_contact={
            finger: _word(OnContact, word, "on_contact") for finger, word in fingers.items()
        },
        touch=message.touch,
        max_force=_optional(message.max_force),
    )


def _optional(values: Sequence[float]) -> float | None:
    """Return the value of a sequence of at most one."""
    return float(values[0]) if len(values) else None


def _pairs(names: Sequence[str], values: Sequence[V], what: str) -> dict[str, V]:
    if len(names) != len(values) or len(set(names)) != len(names):
        raise GoalRejected(
            f"'{what}' needs a value for each of its names, which all differ, not"
            f" {len(values)} for {len(names)}"
        )
    return dict(zip(names, values, strict=True))


W = TypeVar("W", Stage, OnContact)


def _word(kind: type[W], word: str, what: str) -> W:
    try:
        return kind(word)
    except ValueError:
        raise GoalRejected(f"unknown {what} '{word[:100]}'; {suggestion(word, kind)}") from None


def _feedback(feedback: Feedback) -> dict[str, Any]:
    inner = feedback.inner_progress
    return {
        "progress": feedback.progress,
        "inner": feedback.inner,
        "inner_name": list(inner),
        "inner_progress": list(inner.values()),
    }
