"""Goals of the hand as goals of actions: how they run, end and are cancelled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rtee.remote.goal import RunningGoal
from rtee.ros2.action_server import ServerGoal
from rtee.ros2.actions import GoalState, Outcome
from rtee.ros2.message import Message
from rtee.types import Feedback, Result


def state_of(result: Result, touch: bool = False) -> GoalState:
    """Return the state in which a goal of an action ends.

    Args:
        result: How the hand's goal ended. The action's succeeds if the posture was reached or
            something is held.
        touch: The goal was to touch: it succeeds if a finger did.
    """
    if result.cancelled:
        return GoalState.CANCELED
    ended = result.preempted or result.aborted or result.timed_out
    if not ended and (result.touched if touch else result.succeeded):
        return GoalState.SUCCEEDED
    return GoalState.ABORTED


def reason_of(result: Result, touch: bool = False) -> str:
    """Return why a goal was aborted, in words; empty if it was not. Arguments: see `state_of`."""
    if state_of(result, touch) is not GoalState.ABORTED:
        return ""
    if result.preempted:
        return "a new goal replaced it"
    if result.reason:
        return result.reason
    if result.timed_out:
        return f"it took longer than its timeout, {result.duration:.3g} s"
    if touch:
        return "nothing was touched"
    return f"the hand stopped short of it by {result.error:.3g} rad or m, and holds nothing"


class HandJob:
    """Follows a goal of the hand that an action has begun.

    The hand has one goal at a time: a new one, of whichever client, ends this one.

    Args:
        running: The goal.
        result: Returns the action's result for that of the hand.
        feedback: Returns the fields of the action's feedback for that of the hand.
    """

    def __init__(
        self,
        running: RunningGoal,
        result: Callable[[Result], Message],
        feedback: Callable[[Feedback], dict[str, Any]],
    ) -> None:
        self._running, self._result, self._feedback = running, result, feedback

    async def run(self, goal: ServerGoal) -> Outcome:
        """Wait for the end; raises `NoHand` if the hand goes."""

        def tell(feedback: Feedback) -> None:
            if goal.heard:
                goal.feedback(**self._feedback(feedback))

        result = await self._running.result(tell)
        touch = self._running.goal.touch
        return Outcome(state_of(result, touch), self._result(result), reason_of(result, touch))

    async def cancel(self) -> None:
        """Have the hand brake and hold; raises a `RemoteError` if it does not."""
        await self._running.cancel()
