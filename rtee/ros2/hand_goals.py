"""Goals of the hand as jobs of a ROS 2 action."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from rtee.errors import GoalRejected, MessageError
from rtee.messages.goals import GOAL, OPTIONAL
from rtee.remote.goal import RunningGoal
from rtee.remote.words import ending
from rtee.ros2.action_server import ActionServer, Offer, ServerGoal
from rtee.ros2.actions import ActionOutcome, GoalState
from rtee.ros2.message import Message
from rtee.ros2.served_hand import Part, ServedHand
from rtee.types import Feedback, Goal, Result, new_goal_id
from rtee.types import Outcome as End


def state_of(result: Result) -> GoalState:
    """Return the final state of an action's goal for the result of the hand's goal."""
    if result.succeeded:
        return GoalState.SUCCEEDED
    return GoalState.CANCELED if result.outcome is End.CANCELLED else GoalState.ABORTED


def reason_of(result: Result) -> str:
    """Return the reason for an abort as a sentence; ``""`` without an abort."""
    if state_of(result) is not GoalState.ABORTED:
        return ""
    match result.outcome:
        case End.PREEMPTED:
            return "a new goal replaced it"
        case End.TIMED_OUT:
            return f"it timed out after {result.duration:.3g} s"
        case End.STALLED:
            short = f"the hand stopped short of it by {result.error:.3g} rad or m"
            return f"{short}, and holds nothing"
    return result.reason or ending(result)


class ActionPart(Part):
    """A part of a hand's node whose constructor makes the server of an action."""

    _server: ActionServer

    async def run(self) -> None:
        """Offer the action until cancelled, and then cancel its active goals."""
        await self._server.run()


class HandJob:
    """Job of an action that follows a goal of the hand.

    The hand has one goal at a time; a new goal of any client ends this one. Two functions convert
    the hand's result to the action's result, and the hand's feedback to the fields of the action's
    feedback. A third returns a reason to abort despite a successful result; ``""``: none.
    """

    def __init__(
        self,
        running: RunningGoal,
        result: Callable[[Result], Message],
        feedback: Callable[[Feedback], dict[str, Any]],
        failed: Callable[[Result], str] = lambda _: "",
    ) -> None:
        self._running, self._result, self._feedback = running, result, feedback
        self._failed = failed

    async def run(self, goal: ServerGoal) -> ActionOutcome:
        """Wait for the end of the goal; raise `NoHand` if the hand ends first."""

        def publish(feedback: Feedback) -> None:
            if goal.heard:
                goal.feedback(**self._feedback(feedback))

        result = await self._running.result(publish)
        if result.succeeded and (why := self._failed(result)):
            return ActionOutcome(GoalState.ABORTED, self._result(result), why)
        return ActionOutcome(state_of(result), self._result(result), reason_of(result))

    async def cancel(self) -> None:
        """Have the hand brake and hold its posture; raise a `RemoteError` if it refuses."""
        await self._running.cancel()


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
        for name in ("opening", "opening_error", "force", "force_error", "force_asked"):
            fields[name] = [] if fields[name] is None else [fields[name]]
        fields["within"] = fields["within"] is True
        fields["position_name"] = list(result.position)
        fields["position"] = list(result.position.values())
        return kind(**fields)


def goal_in(message: Any) -> Goal:
    """Return the goal in a ``rtee_msgs/action/Grasp_Goal``.

    Raises `GoalRejected` if it is invalid.
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
