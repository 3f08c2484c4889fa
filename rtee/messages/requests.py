"""The requests that a hand answers on the network, with the types of question and answer.

A client sends a Zenoh query on ``rtee/<hand>/<group>/<name>``, with an attachment that proves its
identity, see `rtee.messages.identity`. The answer is a message of the reply's type, or, as a Zenoh
error, a ``rtee_msgs/Reply`` with the reason for the refusal.

Samples of streams are published on ``rtee/<hand>/put/<access path>/sample/<client>``, since nobody
waits for an answer to them. A refusal, a ``rtee_msgs/Reply`` with the attachment ``-<number>``, is
published on ``rtee/<hand>/answers/<client>``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from rtee.messages.schema import MessageType, message_type
from rtee.messages.topics import PREFIX

HELLO = "hello"
"""Group of the request with which a client introduces itself. The name of the request is the
access path of the connection: `HERE`, `PLAIN`, or the common name in the client's certificate."""

HERE = "here"
"""Access path of clients on the hand's own computer, through its Unix socket."""

PLAIN = "plain"
"""Access path of clients through an endpoint without certificates."""

STOP = "stop"
"""Group of the request that is always accepted, from any client, before all others."""

CONTROL = "control"
"""Group of the requests that control the hand."""

ASK = "ask"
"""Group of queries, and of the requests that change the actions."""

CLIENTS = "clients"
"""Part of the keys of clients' liveliness tokens."""

WATCHES = "00000000"
"""Beginning of the name of a token whose client only watches: a router need not wait for it."""

ALIVE = "alive"
"""Last part of the key of a hand's liveliness token."""

CLAIMS = "claims"
"""Part of the keys of the liveliness tokens by which hands of one name find each other."""

WATCH = "watch"
"""Part of the keys on which the hand publishes to the clients of one certificate."""

STATES = "states"
"""Part of the keys of streams of states."""

ANSWERS = "answers"
"""Part of the keys on which the hand publishes the refusals of samples."""

INBOX = "put"
"""Part of the keys on which clients publish the samples of streams."""

SAMPLE = "sample"
"""Name of the request that is published: a sample of a stream."""


def inbox_key(hand: str, access_path: str, client: str) -> str:
    """Return the key on which a client publishes samples; for the access path, see `HELLO`."""
    return f"{PREFIX}/{hand}/{INBOX}/{access_path}/{SAMPLE}/{client}"


def topic_for(access_path: str, topic: str) -> str:
    """Return the part of a topic's key after the hand, for clients of an access path; see `HELLO`.

    Each certificate has its own keys, on which the hand publishes nothing once it is revoked.
    """
    return topic if access_path in (HERE, PLAIN) else f"{WATCH}/{access_path}/{topic}"


# Numbers, since a role is compared with the lowest one that a request needs.
class Role(IntEnum):
    """Permissions of a client; each role includes those before it."""

    OBSERVER = 1
    """May watch, and stop the hand."""
    OPERATOR = 2
    """May move the hand."""
    MAINTAINER = 3
    """May change actions and gains, and control the recording."""


@dataclass(frozen=True, slots=True)
class Request:
    """A kind of request, and the lowest role that may send it; the text describes it."""

    group: str
    name: str
    question: MessageType
    answer: MessageType
    text: str
    role: Role

    def key(self, hand: str) -> str:
        """Return the key on the network; the hand ``*`` matches all hands."""
        return f"{PREFIX}/{hand}/{self.group}/{self.name}"

    def refusal(self, role: Role) -> str:
        """Return why a client with a role may not send the request; ``""`` if it may."""
        if role >= self.role:
            return ""
        least, given = self.role.name.lower(), role.name.lower()
        return f"'{self.name}' needs the role {least}; this client has the role {given}"


REPLY: Final = message_type("rtee_msgs/msg/Reply")
"""The answer to most commands, and every refusal."""


def _request(
    group: str, name: str, question: str, answer: str, text: str, role: Role | None = None
) -> Request:
    if role is None:
        # An observer may watch, query and stop; all requests that change something name a role.
        role = Role.OPERATOR if group == CONTROL else Role.OBSERVER
    return Request(
        group,
        name,
        message_type(f"rtee_msgs/msg/{question}"),
        message_type(f"rtee_msgs/msg/{answer}" if answer != "String" else "std_msgs/msg/String"),
        text,
        role,
    )


_M = Role.MAINTAINER

_ALL = (
    _request(STOP, "stop", "ClientRequest", "StopReply", "Stop all devices now; needs no lease."),
    _request(HELLO, "hello", "ClientRequest", "Reply", "Introduce a client: its secret and role."),
    _request(CONTROL, "do", "Goal", "Reply", "Execute an action; feedback and a result follow."),
    _request(CONTROL, "cancel", "GoalReference", "Reply", "Cancel a goal; the hand holds."),
    _request(CONTROL, "hold", "ClientRequest", "Reply", "Hold the measured posture."),
    _request(CONTROL, "jog", "NamedValues", "Reply", "Move actuators to positions."),
    _request(CONTROL, "begin_stream", "StreamBegin", "Reply", "Be ready for a stream."),
    _request(
        CONTROL, SAMPLE, "StreamTargets", "Reply", "Put a sample; only a refusal is answered."
    ),
    _request(CONTROL, "end_stream", "StreamEnd", "Reply", "End a stream; the hand brakes, holds."),
    _request(CONTROL, "gains", "NamedValues", "Reply", "Change gains of a device.", _M),
    _request(CONTROL, "recover", "ClientRequest", "Reply", "Bring devices out of a fault."),
    _request(
        CONTROL,
        "acquire",
        "ClientRequest",
        "Reply",
        "Acquire the lease: nobody else may move the hand.",
    ),
    _request(CONTROL, "release", "ClientRequest", "Reply", "Release the lease."),
    _request(
        CONTROL, "admit", "ClientRequest", "Reply", "Let agents move the hand again after a stop."
    ),
    _request(ASK, "stream", "StreamRequest", "Reply", "Have states published at a rate."),
    _request(ASK, "state", "Empty", "State", "The newest state."),
    _request(ASK, "goal", "GoalReference", "GoalStatus", "Whether a goal runs, and its result."),
    _request(ASK, "touch", "Empty", "TouchReply", "The touch sensors and what they measure."),
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
    _request(ASK, "record", "RecordRequest", "Reply", "Start, stop or mark the recording.", _M),
    _request(ASK, "add", "NewAction", "Reply", "Add an action.", _M),
    _request(ASK, "store", "ActionName", "Reply", "Write an action to the hand's folder.", _M),
    _request(ASK, "remove", "ActionName", "Reply", "Remove an action.", _M),
    _request(ASK, "rename", "ActionName", "Reply", "Rename an action.", _M),
)

REQUESTS: dict[str, Request] = {request.name: request for request in _ALL}
"""The requests by name."""
