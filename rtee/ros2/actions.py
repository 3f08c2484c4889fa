"""Names, states and outcomes of goals, common to servers and clients of actions.

An action ``/hand/gripper_cmd`` is three services and two topics below ``/hand/gripper_cmd/_action``
(see `names`). A goal has an identifier of 16 bytes, chosen by its client.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

from rtee.ros2.message import Message
from rtee.ros2.types import ActionType, interfaces

NO_GOAL: Final = bytes(16)
"""Identifier that means all goals in a request to cancel."""

_NANO = 1_000_000_000
"""Nanoseconds of a second."""


class GoalState(IntEnum):
    """State of a goal, with the numbers of ``action_msgs/msg/GoalStatus``."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6

    @property
    def ended(self) -> bool:
        """Whether the goal has ended."""
        return self >= GoalState.SUCCEEDED


class Refusal(IntEnum):
    """Answer to a request to cancel goals, with the codes of ``action_msgs/srv/CancelGoal``."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL = 2
    ENDED = 3


@dataclass(frozen=True, slots=True)
class ActionOutcome:
    """Outcome of a goal, with the reason for an abort, for the log."""

    state: GoalState
    result: Message
    reason: str = ""


class Names(NamedTuple):
    """Names of the services and topics of an action."""

    send_goal: str
    get_result: str
    cancel_goal: str
    feedback: str
    status: str


def names(action: str) -> Names:
    """Return the names of the services and topics of an action."""
    return Names(*(f"{action}/_action/{part}" for part in Names._fields))


def versions(kind: ActionType, distro: str) -> tuple[ActionType, ...]:
    """Return an action's type in all versions that differ in their feedback.

    The distribution's own version comes first. The feedback of FollowJointTrajectory changed with
    control_msgs 6.3, which a robot of any distribution may have. Humble has no hashes, and so only
    one version.
    """
    by_hash = {kind.feedback_message.hash: kind}
    if distro != "humble":
        for other in ("jazzy", "rolling"):
            version = interfaces(other).action(kind.name)
            # `setdefault` keeps the robot's own version of the same hash.
            by_hash.setdefault(version.feedback_message.hash, version)
    return tuple(by_hash.values())


def nanoseconds(stamp: Message) -> int:
    """Return a ``Time`` or ``Duration`` of ROS 2 in nanoseconds."""
    fields = stamp.to_dict()
    return int(fields["sec"]) * _NANO + int(fields["nanosec"])


def time_fields(nanoseconds: int) -> dict[str, int]:
    """Return the fields of a ``Time`` or ``Duration`` of ROS 2."""
    sec, nanosec = divmod(nanoseconds, _NANO)
    return {"sec": sec, "nanosec": nanosec}
