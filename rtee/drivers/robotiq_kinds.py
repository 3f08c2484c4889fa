"""What all of Robotiq's grippers say, and the options that all of them have."""

from __future__ import annotations

from typing import Literal, Protocol

from rtee.drivers.blocks import ExchangeKind


class RobotiqStatus(Protocol):
    """What all of Robotiq's grippers say."""

    @property
    def activated(self) -> bool:
        """GACT."""
        ...

    @property
    def ready(self) -> bool:
        """Whether it is activated and takes commands."""
        ...

    @property
    def reset(self) -> bool:
        """Whether it is not activated, nor about to be."""
        ...

    @property
    def fault(self) -> int:
        """GFLT."""
        ...


class RobotiqSettings(Protocol):
    """The options that all of Robotiq's grippers have."""

    @property
    def port(self) -> str:
        """The address."""
        ...

    @property
    def unit(self) -> int:
        """The gripper's Modbus number."""
        ...

    @property
    def baudrate(self) -> int:
        """Bits per second."""
        ...

    @property
    def home(self) -> Literal["on_demand", "on_connect"]:
        """When it is activated."""
        ...

    @property
    def exchange(self) -> ExchangeKind:
        """How it is exchanged with."""
        ...

    @property
    def activation_timeout(self) -> float:
        """Longest time of an activation [s]."""
        ...
