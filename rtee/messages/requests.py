"""The requests that a hand answers on the network, with the types of question and answer.

A client asks by a Zenoh query on ``rtee/<hand>/<group>/<name>``. The answer is a message of the
reply's type, or, as a Zenoh error, a ``rtee_msgs/Reply`` that says why not.

What steers the hand may also be put on that key, with the attachment ``<number> <client>``. The
answer is put on ``rtee/<hand>/answers/<client>``, with the attachment ``+<number>``, or
``-<number>`` with a ``rtee_msgs/Reply`` that says why not.
"""

from __future__ import annotations

from dataclasses import dataclass

from rtee.messages.schema import MessageType, message_type
from rtee.messages.topics import PREFIX

STOP = "stop"
"""Group of the one request that is always taken, from everybody, before all others."""

CONTROL = "control"
"""Group of the requests that steer the hand."""

ASK = "ask"
"""Group of the requests that only want to know, or that change the actions."""

CLIENTS = "clients"
"""Part of the keys of clients' liveliness tokens."""

ALIVE = "alive"
"""Last part of the key of a hand's liveliness token."""

STATES = "states"
"""Part of the keys of streams of states."""

ANSWERS = "answers"
"""Part of the keys on which clients get the answers to what they have put, not asked."""

PUT = ("do", "jog", "sample")
"""Requests that clients put: those that are in a hurry. A query costs Zenoh a tenth of a
millisecond more."""


@dataclass(frozen=True, slots=True)
class Request:
    """A request.

    Attributes:
        group: Its group.
        name: Its name.
        question: Type of the question.
        answer: Type of the answer.
        text: What it does, in one sentence.
    """

    group: str
    name: str
    question: MessageType
    answer: MessageType
    text: str

    def key(self, hand: str) -> str:
        """Return its key on the network; ``*`` as the hand stands for all."""
        return f"{PREFIX}/{hand}/{self.group}/{self.name}"


def _request(group: str, name: str, question: str, answer: str, text: str) -> Request:
    return Request(
        group,
        name,
        message_type(f"rtee_msgs/msg/{question}"),
        message_type(f"rtee_msgs/msg/{answer}" if answer != "String" else "std_msgs/msg/String"),
        text,
    )


_ALL = (
    _request(STOP, "stop", "ClientRequest", "StopReply", "Stop all devices now; needs no lease."),
    _request(CONTROL, "hello", "ClientRequest", "Reply", "Answered once the client is known."),
    _request(CONTROL, "do", "Goal", "Reply", "Execute an action; feedback and a result follow."),
    _request(CONTROL, "cancel", "GoalReference", "Reply", "Cancel a goal; the hand holds."),
    _request(CONTROL, "hold", "ClientRequest", "Reply", "Hold the measured posture."),
    _request(CONTROL, "jog", "NamedValues", "Reply", "Move actuators to positions."),
    _request(CONTROL, "begin_stream", "StreamBegin", "Reply", "Be ready for a stream."),
    _request(
        CONTROL, "sample", "StreamTargets", "Reply", "Put a sample; only a refusal is answered."
    ),
    _request(CONTROL, "end_stream", "StreamEnd", "Reply", "End a stream; the hand brakes, holds."),
    _request(CONTROL, "gains", "NamedValues", "Reply", "Change gains of a device."),
    _request(CONTROL, "recover", "ClientRequest", "Reply", "Bring devices out of a fault."),
    _request(
        CONTROL,
        "acquire",
        "ClientRequest",
        "Reply",
        "Acquire the lease: nobody else may move the hand.",
    ),
    _request(CONTROL, "release", "ClientRequest", "Reply", "Release the lease."),
    _request(ASK, "stream", "StreamRequest", "Reply", "Have states published at a rate."),
    _request(ASK, "state", "Empty", "State", "The newest state."),
    _request(ASK, "status", "Empty", "Status", "The loop and its devices."),
    _request(ASK, "object_description", "Empty", "Object", "What a simulated hand grasps."),
    _request(ASK, "info", "PostureRequest", "HandInfo", "The hand, for a grasp planner."),
    _request(ASK, "robot_description", "Empty", "String", "The URDF."),
    _request(ASK, "actions", "ActionFilter", "ActionList", "The actions that pass a filter."),
    _request(ASK, "openings", "Empty", "OpeningList", "Openings and forces of the actions."),
    _request(ASK, "primitives", "Empty", "PrimitiveGroups", "The primitives, by name."),
    _request(ASK, "partners", "ActionName", "Names", "What an element can be paired with."),
    _request(ASK, "trials", "Empty", "String", "What trials of the actions found, as YAML."),
    _request(ASK, "grasp_plan", "GraspRequest", "String", "Grasps of an object, ranked, as JSON."),
    _request(ASK, "reach", "ReachRequest", "String", "How a planner's grasp is reached, as JSON."),
    _request(ASK, "record", "RecordRequest", "Reply", "Start, stop or mark the recording."),
    _request(ASK, "add", "NewAction", "Reply", "Add an action."),
    _request(ASK, "store", "ActionName", "Reply", "Write an action to the hand's folder."),
    _request(ASK, "remove", "ActionName", "Reply", "Remove an action."),
    _request(ASK, "rename", "ActionName", "Reply", "Rename an action."),
)

REQUESTS: dict[str, Request] = {request.name: request for request in _ALL}
"""The requests by name."""
