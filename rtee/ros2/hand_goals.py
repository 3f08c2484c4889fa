"""Goals of the hand as jobs of a ROS 2 action."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rtee.remote.running_goal import RunningGoal
from rtee.remote.words import ending
from rtee.ros2.action_server import ActionServer, ServerGoal
from rtee.ros2.actions import ActionOutcome, GoalState
from rtee.ros2.message import Message
from rtee.ros2.served_hand import Part
from rtee.types import Feedback, Result
from rtee.types import Outcome as End


def state_of(result: Result) -> GoalState:
    """Return the final state of an action's goal for the result of the hand's."""
    if result.succeeded:
        return GoalState.SUCCEEDED
    return GoalState.CANCELED if result.outcome is End.CANCELLED else GoalState.ABORTED


def reason_of(result: Result) -> str:
    """Return the reason for an abortion as a sentence, else ``""``."""
    if state_of(result) is not GoalState.ABORTED:
        return ""
    match result.outcome:
        case End.PREEMPTED:
            return "a new goal replaced it"
        case End.TIMED_OUT:
            return f"it took longer than its timeout, {result.duration:.3g} s"
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
    its result to that of the action, and its feedback to the fields of that of the action. A third
    returns why a result is an abortion though the hand holds something; ``""``: it is not an
    abortion.
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
