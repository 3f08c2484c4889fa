"""The interfaces of a distribution of ROS 2: messages, services and actions by name.

``interfaces("jazzy").message("sensor_msgs/msg/JointState")`` returns the class of a message,
``.service("std_srvs/srv/Trigger")`` the two messages and the hash of a service, and
``.action("control_msgs/action/GripperCommand")`` all messages, services and topics of an action.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any, Final

from rtee.errors import MessageError, suggestion
from rtee.messages.cdr import SCALARS
from rtee.messages.schema import DEFINITIONS, Field, Many, MessageType, full_name, parse, sections
from rtee.ros2.message import Message, message_class

PREFIX: Final = "RIHS01_"
"""Prefix of every hash: the version of the algorithm."""

NO_HASH: Final = "TypeHashNotSupported"
"""Text that Humble, which has no hashes, writes instead of one."""

_PRIMITIVES: Final = {
    "int8": 2,
    "uint8": 3,
    "int16": 4,
    "uint16": 5,
    "int32": 6,
    "uint32": 7,
    "int64": 8,
    "uint64": 9,
    "float32": 10,
    "float64": 11,
    "char": 3,
    "bool": 15,
    "byte": 16,
    "string": 17,
}
"""Numbers of primitive types in ``type_description_interfaces/msg/FieldType``; a ``char`` counts as
``uint8`` (REP 2016). Wide strings are missing, since no message for hands has one."""

_NESTED: Final = 1
_BOUNDED_STRING: Final = 21

Description = dict[str, Any]
"""Description of a type: a tree of mappings, lists, texts and integers."""


def _describe(kind: MessageType) -> Description:
    """Return a type as an ``IndividualTypeDescription``."""
    # rosidl leaves default values out of the hash.
    fields = [
        {
            "name": field.name,
            "type": {
                "type_id": _number(field) + field.many.value,
                "capacity": field.capacity,
                "string_capacity": field.longest,
                "nested_type_name": field.kind if field.nested else "",
            },
        }
        for field in kind.fields
    ]
    return {"type_name": kind.name, "fields": fields}


def _number(field: Field) -> int:
    return _BOUNDED_STRING if field.longest else _PRIMITIVES.get(field.kind, _NESTED)


def referred(kind: MessageType) -> list[MessageType]:
    """Return all types that a type refers to, directly or indirectly, sorted by name."""
    return sorted(kind.parts, key=lambda part: part.name)


def description(kind: MessageType) -> Description:
    """Return the ``TypeDescription`` of a type, with all types that it refers to."""
    others = [_describe(other) for other in referred(kind)]
    return {"type_description": _describe(kind), "referenced_type_descriptions": others}


def type_hash(kind: MessageType) -> str:
    """Return the hash of a type: ``RIHS01_`` and 64 hexadecimal digits."""
    # Separators and order are hashed, too, and must be those of rosidl.
    text = json.dumps(description(kind), separators=(", ", ": "))
    return PREFIX + hashlib.sha256(text.encode()).hexdigest()


_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
_UUID = "unique_identifier_msgs/msg/UUID"
_TIME = "builtin_interfaces/msg/Time"


_PARTS = {"msg": 1, "srv": 2, "action": 3}
"""Number of parts of a definition: request and response; goal, result and feedback."""

_NEWER = {"kilted": "control_msgs_6", "rolling": "control_msgs_6"}
"""Files of definitions that differ from those of Jazzy, by distribution: control_msgs 6.3 added the
index of the current point to FollowJointTrajectory's feedback."""


def split(name: str, text: str) -> list[str]:
    """Return the parts of a definition, separated by ``---``.

    Raises `MessageError` if their number is wrong.
    """
    parts = re.split(r"^\s*---\s*$", text, flags=re.M)
    if len(parts) != _PARTS[name.split("/")[1]]:
        raise MessageError(f"{name}: {len(parts)} parts separated by ---")
    return parts


@cache
def definitions(distro: str = "jazzy") -> dict[str, str]:
    """Return the definitions of all interfaces of a distribution, by full name.

    They are in ``rtee/ros2/interfaces``, with one file per package, except those of recordings,
    which include rtee's own package ``rtee_msgs``.
    """
    texts = dict(DEFINITIONS)
    folder = files("rtee.ros2").joinpath("interfaces")
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        # A file of newer distributions would replace definitions of Jazzy.
        if file.name.endswith(".txt") and file.name.removesuffix(".txt") not in _NEWER.values():
            texts |= sections(file.read_text("utf-8"))
    if distro in _NEWER:
        texts |= sections(folder.joinpath(f"{_NEWER[distro]}.txt").read_text("utf-8"))
    return texts


@dataclass(frozen=True, slots=True)
class TopicType:
    """The type of a topic.

    Attributes:
        name: Full name, such as ``sensor_msgs/msg/JointState``.
        hash: Hash of the type, or `NO_HASH`.
        message: Class of its messages.
    """

    name: str
    hash: str
    message: type[Message]


@dataclass(frozen=True, slots=True)
class ServiceType:
    """The type of a service.

    Attributes:
        name: Full name, such as ``std_srvs/srv/Trigger``.
        hash: Hash of the type, or `NO_HASH`.
        request: Class of requests.
        response: Class of responses.
    """

    name: str
    hash: str
    request: type[Message]
    response: type[Message]


@dataclass(frozen=True, slots=True)
class ActionType:
    """The type of an action.

    Attributes:
        name: Full name, such as ``control_msgs/action/GripperCommand``.
        goal: The class of goals.
        result: The class of results.
        feedback: The class of feedback.
        send_goal: Service that sends a goal: a request has ``goal_id`` and ``goal``, a response
            ``accepted`` and ``stamp``.
        get_result: Service that waits for a result: a request has ``goal_id``, a response
            ``status`` and ``result``.
        cancel_goal: Service that cancels goals.
        feedback_message: Type of the topic of feedback: ``goal_id`` and ``feedback``.
        status: Type of the topic of the goals' status.
    """

    name: str
    goal: type[Message]
    result: type[Message]
    feedback: type[Message]
    send_goal: ServiceType
    get_result: ServiceType
    cancel_goal: ServiceType
    feedback_message: TopicType
    status: TopicType


class Interfaces:
    """The interfaces of a distribution; made by `interfaces`.

    Args:
        distro: The distribution: jazzy, kilted, rolling or humble.
    """

    def __init__(self, distro: str) -> None:
        self.distro = distro
        self.texts = definitions(distro)
        self._hashed = distro != "humble"
        self._structures: dict[str, MessageType] = {}
        self._topics: dict[str, TopicType] = {}
        self._services: dict[str, ServiceType] = {}
        self._actions: dict[str, ActionType] = {}

    def structure(self, name: str) -> MessageType:
        """Return a message, service or action, or a part of these, as a type, by its full name.

        Raises:
            MessageError: if there is no such type.
        """
        name = full_name(name)
        if name not in self._structures:
            if name in self.texts and "/msg/" in name:
                self._parse(name, self.texts[name])
            else:
                self._derive(name)
        if name not in self._structures:
            # Of services and actions, the first part is asked for first.
            name = name.removesuffix("_Request").removesuffix("_Goal")
            raise MessageError(f"there is no type '{name}'; {suggestion(name, self.texts)}")
        return self._structures[name]

    def _derive(self, name: str) -> None:
        """Add all structures of the service or action to which a name belongs."""
        package, _, rest = name.partition("/")
        kind, _, last = rest.partition("/")
        # Names of services and actions have no underscore.
        base = f"{package}/{kind}/{last.partition('_')[0]}"
        if base in self.texts and kind == "action":
            self._add_action(base)
        elif base in self.texts and kind == "srv":
            for part, text in zip(
                ("Request", "Response"), split(base, self.texts[base]), strict=True
            ):
                self._parse(f"{base}_{part}", text)
            self._add_service(base)

    def _parse(self, name: str, text: str) -> None:
        self._structures[name] = parse(name, text, self.structure, message_class)

    def _add(self, name: str, *fields: Field) -> None:
        """Add a structure, with the types of its nested messages."""
        nested = tuple(
            field if field.kind in SCALARS else replace(field, inner=self.structure(field.kind))
            for field in fields
        )
        self._structures[name] = MessageType(name, nested, makes=message_class)

    def _add_service(self, name: str) -> None:
        """Add a service, whose request and response are there already."""
        # Service events are never sent here, but are part of the service's hash, without which no
        # client would find the service.
        self._add(
            f"{name}_Event",
            Field("info", _EVENT_INFO),
            Field("request", f"{name}_Request", Many.BOUNDED, 1),
            Field("response", f"{name}_Response", Many.BOUNDED, 1),
        )
        self._add(
            name,
            Field("request_message", f"{name}_Request"),
            Field("response_message", f"{name}_Response"),
            Field("event_message", f"{name}_Event"),
        )

    def _add_action(self, name: str) -> None:
        parts = zip(("Goal", "Result", "Feedback"), split(name, self.texts[name]), strict=True)
        for part, text in parts:
            self._parse(f"{name}_{part}", text)
        goal_id = Field("goal_id", _UUID)
        send, get = f"{name}_SendGoal", f"{name}_GetResult"
        self._add(f"{send}_Request", goal_id, Field("goal", f"{name}_Goal"))
        self._add(f"{send}_Response", Field("accepted", "bool"), Field("stamp", _TIME))
        self._add(f"{get}_Request", goal_id)
        self._add(f"{get}_Response", Field("status", "int8"), Field("result", f"{name}_Result"))
        self._add_service(send)
        self._add_service(get)
        self._add(f"{name}_FeedbackMessage", goal_id, Field("feedback", f"{name}_Feedback"))
        # rosidl leaves the service that cancels and the topic of states out of an action's type,
        # since they are the same for all actions.
        self._add(
            name,
            Field("goal", f"{name}_Goal"),
            Field("result", f"{name}_Result"),
            Field("feedback", f"{name}_Feedback"),
            Field("send_goal_service", send),
            Field("get_result_service", get),
            Field("feedback_message", f"{name}_FeedbackMessage"),
        )

    def hash(self, name: str) -> str:
        """Return the hash of a type, `NO_HASH` in Humble; raise `MessageError` if there is none."""
        return type_hash(self.structure(name)) if self._hashed else NO_HASH

    def description(self, name: str) -> Description:
        """Return the description of a type; raise `MessageError` if there is none."""
        return description(self.structure(name))

    def message(self, name: str) -> Any:
        """Return the class of a message; raise `MessageError` if there is no such type."""
        return self.structure(name).message

    def topic(self, name: str) -> TopicType:
        """Return the type of a topic; raise `MessageError` if there is none."""
        name = full_name(name)
        if name not in self._topics:
            self._topics[name] = TopicType(name, self.hash(name), self.message(name))
        return self._topics[name]

    def service(self, name: str) -> ServiceType:
        """Return the type of a service; raise `MessageError` if there is none."""
        name = full_name(name, "srv")
        if name not in self._services:
            request, response = (self.message(f"{name}_{part}") for part in ("Request", "Response"))
            self._services[name] = ServiceType(name, self.hash(name), request, response)
        return self._services[name]

    def action(self, name: str) -> ActionType:
        """Return the type of an action; raise `MessageError` if there is none."""
        name = full_name(name, "action")
        if name not in self._actions:
            goal, result, feedback = (
                self.message(f"{name}_{part}") for part in ("Goal", "Result", "Feedback")
            )
            self._actions[name] = ActionType(
                name,
                goal,
                result,
                feedback,
                self.service(f"{name}_SendGoal"),
                self.service(f"{name}_GetResult"),
                self.service("action_msgs/srv/CancelGoal"),
                self.topic(f"{name}_FeedbackMessage"),
                self.topic("action_msgs/msg/GoalStatusArray"),
            )
        return self._actions[name]


# Cached, since services check requests and responses by their class.
@cache
def interfaces(distro: str = "jazzy") -> Interfaces:
    """Return the interfaces of a distribution."""
    return Interfaces(distro)
