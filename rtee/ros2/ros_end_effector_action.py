"""The action of ROS End-Effector's ROS 2 packages, for programs that were written for it.

Its name is that of its node's parameter: ``/action_command``, in the namespace of the hand's node.
"""

from __future__ import annotations

from typing import Any

from rtee.actions.types import ActionKind
from rtee.errors import ActionError, GoalRejected, LeaseHeld, RequestRejected
from rtee.ros2.action_server import ActionServer, Job, Offer, ServerGoal
from rtee.ros2.actions import ActionOutcome, GoalState
from rtee.ros2.hand_goals import ActionPart, HandJob
from rtee.ros2.message import Message
from rtee.ros2.ros_end_effector import name_here
from rtee.ros2.served_hand import ServedHand
from rtee.types import Feedback, Goal, Intensity, Named, Result

COMMAND = "action_command"
"""Name of the action."""

_TOLERANCE = 0.01
"""Error norm of a goal that gives 0 [rad | m], the default of ROS End-Effector."""

_FULL = 100.0
"""Progress of a completed action in its feedback [%]; its goals have fractions instead."""


class ActionCommand(ActionPart):
    """Offers the action ``action_command``."""

    def __init__(self, served: ServedHand) -> None:
        self._served = served
        self._type = served.node.context.interfaces.action("rosee_msg/action/ROSEECommand")
        self._server = ActionServer(served.node, COMMAND, Offer(self._type, self._accept))

    async def _accept(self, message: Any) -> Job:
        command = message.goal_action
        try:
            running = await self._served.hand.start_goal(goal_of(command))
        except (ActionError, RequestRejected, LeaseHeld) as error:
            # ROS End-Effector accepts every goal, and aborts what it cannot do.
            return _Aborted(self._type.result(completed_action=command), str(error))

        def ended(_: Result) -> Message:
            return self._type.result(completed_action=command)

        def now(feedback: Feedback) -> dict[str, Any]:
            return {
                "completation_percentage": _FULL * feedback.progress,
                "action_name_current": feedback.inner or command.action_name,
            }

        return HandJob(running, ended, now)


class _Aborted:
    """Job of a goal that is aborted at once."""

    def __init__(self, result: Message, reason: str) -> None:
        self._outcome = ActionOutcome(GoalState.ABORTED, result, reason)

    async def run(self, goal: ServerGoal) -> ActionOutcome:
        return self._outcome

    async def cancel(self) -> None:
        return


def goal_of(command: Any) -> Goal:
    """Return the goal in a ``rosee_msg/msg/ROSEEActionControl``.

    Its percentage is a fraction, 0 to 1, and is ignored for a timed action, as in ROS End-Effector.
    Commands for single motors are efforts [N·m | N], which 0 leaves as configured: ROS End-Effector
    passes them on as those of its references. Raises `GoalRejected` if its type is unknown, or the
    commands are not one for each of their names.
    """
    motors, commands = list(command.optional_motors_names), list(command.optional_motors_commands)
    if len(motors) != len(commands):
        raise GoalRejected(
            f"'optional_motors_commands' needs {len(motors)} numbers, one for each of"
            f" 'optional_motors_names', not {len(commands)}"
        )
    effort = {name: float(value) for name, value in zip(motors, commands, strict=True) if value}
    name, share = command.action_name, command.percentage
    if command.action_type == command.PRIMITIVE:
        items = tuple(command.selectable_items)
        what = Named(name_here(name), items, ActionKind.PRIMITIVE)
    # In ROS End-Effector, these two are the same.
    elif command.action_type in (command.GENERIC, command.COMPOSED):
        what = Named(name)
    elif command.action_type == command.TIMED:
        what, share = Named(name, kind=ActionKind.TIMED), 1.0
    else:
        raise GoalRejected(f"action_type {command.action_type} is unknown; it must be 0 to 3")
    to = Intensity(share, tolerance=command.error_norm or _TOLERANCE)
    return Goal(what, to, effort=effort)
