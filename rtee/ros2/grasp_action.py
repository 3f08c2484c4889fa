"""The action ``~/grasp``, whose goals have all options of the hand's own goals."""

from __future__ import annotations

import math
from typing import Any

from rtee.errors import GoalRejected, MessageError
from rtee.messages.goals import GOAL, OPTIONAL
from rtee.ros2.action_server import ActionServer, Offer
from rtee.ros2.hand_goals import ActionPart, HandJob
from rtee.ros2.message import Message
from rtee.ros2.served_hand import ServedHand
from rtee.types import Feedback, Goal, Result, new_goal_id

GRASP = "~/grasp"
"""Name of the action."""


class GraspAction(ActionPart):
    """Offers the action ``~/grasp``."""

    def __init__(self, served: ServedHand) -> None:
        self._served = served
        self._type = served.node.context.interfaces.action("rtee_msgs/action/Grasp")
        self._server = ActionServer(served.node, GRASP, Offer(self._type, self._accept))

    async def _accept(self, message: Any) -> HandJob:
        running = await self._served.hand.start_goal(goal_in(message))
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
    """Return the goal in a ``rtee_msgs/action/Grasp_Goal``.

    Raises `GoalRejected` if it makes no sense.
    """
    fields = {field.name: getattr(message, field.name) for field in message.STRUCTURE.fields}
    for name in OPTIONAL:  # a sequence of at most one value
        fields[name] = float(fields[name][0]) if len(fields[name]) else math.nan
    try:
        return GOAL.of({**fields, "goal_id": new_goal_id(), "client": ""})
    except MessageError as error:
        raise GoalRejected(str(error)) from None


def _feedback(feedback: Feedback) -> dict[str, Any]:
    inner = feedback.inner_progress
    return {
        "progress": feedback.progress,
        "inner": feedback.inner,
        "inner_name": list(inner),
        "inner_progress": list(inner.values()),
    }
