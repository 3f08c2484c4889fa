"""What all of Robotiq's grippers say, and the options that all of them have."""

from __future__ import annotations

import math
from typing import Literal, Protocol

from rtee.drivers.register_blocks import ExchangeKind

SAME = 2
"""Positions this near to each other are the same [counts]."""


class Grip:
    """A motor's word about contact, made steady.

    A gripper takes its word back at every new request and says it again when it has found that the
    fingers do not move. While a request moves on, that word comes and goes, though the fingers
    stand on the object all the time. So it stands for as long as the gripper is about to move on in
    the same direction and the fingers are where they were.
    """

    def __init__(self) -> None:
        self._side = 0.0
        self._position = math.nan

    def steady(self, contact: bool, moving: bool, position: float, requested: float) -> bool:
        """Return whether the motor is in contact.

        Args:
            contact: It says so.
            moving: It says that it moves, or is about to.
            position: Where it is [counts].
            requested: Where it is asked to go [counts].
        """
        side = (requested > position) - (requested < position)
        if contact:
            self._side, self._position = side, position
            return True
        if moving and side == self._side and abs(position - self._position) <= SAME:
            return True
        self._side, self._position = 0.0, math.nan
        return False


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
