"""The interfaces of a distribution of ROS 2: messages, services and actions by name.

``interfaces("jazzy").message("sensor_msgs/msg/JointState")`` returns the class of a message,
``.service("std_srvs/srv/Trigger")`` the two messages and the hash of a service, and
``.action("control_msgs/action/GripperCommand")`` all messages, services and topics of an action.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from rtee.errors import MessageError, suggestion
from rtee.ros2.hashes import NO_HASH, Description, description, type_hash
from rtee.ros2.message import Message, message_class
from rtee.ros2.notation import Many, Member, Structure, definitions, full_name, parse, split

_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
_UUID = "unique_identifier_msgs/msg/UUID"
_TIME = "builtin_interfaces/msg/Time"


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
        self._structures: dict[str, Structure] = {}
        self._classes: dict[str, type[Message]] = {}
        self._topics: dict[str, TopicType] = {}
        self._services: dict[str, ServiceType] = {}
        self._actions: dict[str, ActionType] = {}

    def structure(self, name: str) -> Structure:
        """Return a structure by its full name; derive those of services and actions.

        Raises:
            MessageError: if there is no such type.
        """
        name = full_name(name)
        if name not in self._structures:
            if name in self.texts and "/msg/" in name:
                self._structures[name] = parse(name, self.texts[name])
            else:
                self._derive(name)
        if name not in self._structures:
            raise MessageError(f"there is no type '{name}'; {suggestion(name, self.texts)}")
        return self._structures[name]

    def _derive(self, name: str) -> None:
        """Add all structures of the service or action to which a name belongs."""
        package, _, rest = name.partition("/")
        kind, _, last = rest.partition("/")
        if kind == "action":
            # Names of actions have no underscore.
            base = f"{package}/action/{last.partition('_')[0]}"
            if base in self.texts:
                self._add_action(base)
        elif kind == "srv":
            base = f"{package}/srv/{last.partition('_')[0]}"
            if base in self.texts:
                request, response = split(base, self.texts[base])
                self._add_service(
                    base, parse(f"{base}_Request", request), parse(f"{base}_Response", response)
                )

    def _add(self, name: str, *members: Member) -> Structure:
        structure = self._structures[name] = Structure(name, members)
        return structure

    def _add_service(self, name: str, request: Structure, response: Structure) -> None:
        self._structures |= {request.name: request, response.name: response}
        # Service events are never sent here, but are part of the service's hash, without which no
        # client would find the service.
        self._add(
            f"{name}_Event",
            Member("info", _EVENT_INFO),
            Member("request", request.name, Many.BOUNDED, 1),
            Member("response", response.name, Many.BOUNDED, 1),
        )
        self._add(
            name,
            Member("request_message", request.name),
            Member("response_message", response.name),
            Member("event_message", f"{name}_Event"),
        )

    def _add_action(self, name: str) -> None:
        parts = zip(("Goal", "Result", "Feedback"), split(name, self.texts[name]), strict=True)
        for part, text in parts:
            self._structures[f"{name}_{part}"] = parse(f"{name}_{part}", text)
        goal_id = Member("goal_id", _UUID)
        self._add_service(
            f"{name}_SendGoal",
            Structure(f"{name}_SendGoal_Request", (goal_id, Member("goal", f"{name}_Goal"))),
            Structure(
                f"{name}_SendGoal_Response", (Member("accepted", "bool"), Member("stamp", _TIME))
            ),
        )
        self._add_service(
            f"{name}_GetResult",
            Structure(f"{name}_GetResult_Request", (goal_id,)),
            Structure(
                f"{name}_GetResult_Response",
                (Member("status", "int8"), Member("result", f"{name}_Result")),
            ),
        )
        self._add(f"{name}_FeedbackMessage", goal_id, Member("feedback", f"{name}_Feedback"))
        # rosidl leaves the service that cancels and the topic of states out of an action's type,
        # since they are the same for all actions.
        self._add(
            name,
            Member("goal", f"{name}_Goal"),
            Member("result", f"{name}_Result"),
            Member("feedback", f"{name}_Feedback"),
            Member("send_goal_service", f"{name}_SendGoal"),
            Member("get_result_service", f"{name}_GetResult"),
            Member("feedback_message", f"{name}_FeedbackMessage"),
        )

    def hash(self, name: str) -> str:
        """Return the hash of a type, `NO_HASH` in Humble; raise `MessageError` if there is none."""
        return type_hash(self.structure(name), self.structure) if self._hashed else NO_HASH

    def description(self, name: str) -> Description:
        """Return the description of a type; raise `MessageError` if there is none."""
        return description(self.structure(name), self.structure)

    def message(self, name: str) -> Any:
        """Return the class of a message; raise `MessageError` if there is no such type."""
        name = full_name(name)
        if name not in self._classes:
            self._classes[name] = message_class(self.structure(name), self.message)
        return self._classes[name]

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
