"""The context of the parts of a hand's ROS 2 node: the hand, its model, and the node."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Protocol

from rtee.hand.config_schema import Ros2Settings, ThermalSettings
from rtee.hand.model import Hand
from rtee.messages.state import State
from rtee.remote.client import RemoteHand
from rtee.remote.hand_info import HandInfo
from rtee.remote.monitoring import HandStatus
from rtee.remote.openings import OpeningRange
from rtee.ros2.actions import time_fields
from rtee.ros2.message import Message
from rtee.ros2.node import Node
from rtee.ros2.parameters import Parameter, Parameters


@dataclass(eq=False)
class ServedHand:
    """A running hand and its node; created each time the hand starts.

    Attributes:
        model: Model of the hand: names, limits and the transmission of all joints.
        info: Description of the hand at rest.
        openings: Openings and forces that goals may ask for.
        node: Node to which the parts add topics, services and actions.
        settings: Section ``ros2`` of hand.yaml, with the overrides of the command line.
        latest: Newest state, at the rate of ``joint_states``.
        thermal: Temperatures at which the hand warns and disables.
        on_status: Functions to call with the hand's status, once per second.
    """

    hand: RemoteHand
    model: Hand
    info: HandInfo
    openings: tuple[OpeningRange, ...]
    node: Node
    settings: Ros2Settings
    latest: State
    thermal: ThermalSettings = field(default_factory=ThermalSettings)
    on_status: list[Callable[[HandStatus], object]] = field(default_factory=list)
    _parameters: Parameters | None = field(default=None, repr=False)

    def declare(self, parameters: Iterable[Parameter]) -> None:
        """Offer the parameters of the node; call it once, after all parts are made."""
        self._parameters = Parameters(self.node, parameters)

    @property
    def parameters(self) -> Parameters:
        """The parameters of all parts; available when the parts run."""
        if self._parameters is None:
            raise RuntimeError("declare the parameters after all parts exist")
        return self._parameters

    def number(self, name: str) -> float:
        """Return the value of a numeric parameter."""
        value = self.parameters.values[name]
        if not isinstance(value, int | float):
            raise TypeError(f"the parameter '{name}' is {value!r}, not a number")
        return float(value)

    def message(self, name: str) -> type[Message]:
        """Return the class of a message type; raise `MessageError` if there is none."""
        kind: type[Message] = self.node.context.interfaces.message(name)
        return kind

    def header(self, wall_ns: int) -> Message:
        """Return a ``std_msgs/msg/Header`` for a time since 1970 [ns]."""
        stamp = self.message("builtin_interfaces/msg/Time")(**time_fields(wall_ns))
        return self.message("std_msgs/msg/Header")(stamp=stamp)

    @property
    def actuators(self) -> tuple[str, ...]:
        """The actuators, in the hand's order."""
        return self.model.actuator_names


class Part(Protocol):
    """A part of a hand's node: some of its topics, services or actions.

    Its constructor adds them, so that a node in the graph is complete.
    """

    def parameters(self) -> Iterable[Parameter]:
        """Return the node's parameters that this part reads; none by default."""
        return ()

    async def run(self) -> None:
        """Work until cancelled; raise `NoHand` if the hand ends."""
