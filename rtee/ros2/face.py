"""What the parts of a hand's node of ROS 2 are given: the hand, its model, and the node."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

from rtee.hand.config_schema import Ros2Settings, ThermalSettings
from rtee.hand.model import Hand
from rtee.messages.state import State
from rtee.remote.client import RemoteHand
from rtee.remote.monitoring import HandStatus
from rtee.remote.openings import OpeningRange
from rtee.remote.planner import HandInfo
from rtee.ros2.node import Node
from rtee.ros2.parameters import Parameter, Parameters


@dataclass(eq=False)
class Face:
    """A running hand and its node; there is a new one each time that the hand comes.

    Attributes:
        hand: The hand, as every client has it.
        model: Its model: names, limits and the transmission of all joints.
        info: Its description at rest.
        openings: Openings and forces that goals may ask for.
        node: Its node, to which the parts add topics, services and actions.
        settings: The section ``ros2`` of hand.yaml, with what the command line overrides.
        latest: The newest state, at the rate of ``joint_states``.
        thermal: At which temperatures the hand warns.
        on_status: Called with the hand's status, once a second.
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
        """Offer the parameters of the node; called once, when all parts are made."""
        self._parameters = Parameters(self.node, parameters)

    @property
    def parameters(self) -> Parameters:
        """The node's parameters, of all parts; there when the parts run."""
        if self._parameters is None:
            raise RuntimeError("the parameters are declared when all parts are made")
        return self._parameters

    def number(self, name: str) -> float:
        """Return the value of a parameter that is a number."""
        value = self.parameters.values[name]
        if not isinstance(value, int | float):
            raise TypeError(f"the parameter '{name}' is {value!r}, no number")
        return float(value)

    def message(self, name: str) -> Any:
        """Return the class of a message; raises `MessageError` if there is no such type."""
        return self.node.context.interfaces.message(name)

    @property
    def actuators(self) -> tuple[str, ...]:
        """The actuators, in the hand's order."""
        return self.model.actuator_names


class Part(Protocol):
    """A part of a hand's node: some of its topics, services or actions.

    It adds them when it is made, so that a node that is seen is complete.
    """

    def parameters(self) -> Iterable[Parameter]:
        """Return the node's parameters that this part reads."""

    async def run(self) -> None:
        """Do its work until cancelled.

        Raises:
            NoHand: if the hand goes.
        """
