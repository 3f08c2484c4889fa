"""Common parts of all Robotiq grippers: options, faults, reports of contact.

Sources: the instruction manuals of the 2F-85, 2F-140 and Hand-E, and of the 3-Finger gripper, whose
register names (rACT, gFLT ...) are used here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Literal

from msgspec import Meta

from rtee.drivers.options import DeviceOptions, Positive, Rate
from rtee.drivers.register_blocks import ExchangeKind
from rtee.drivers.registers import Registers, at, flag

OUTPUT = 0x03E8
"""First register of the block that the host writes, on a serial line."""

INPUT = 0x07D0
"""First register of the block that the gripper answers with, on a serial line."""

COUNTS = (0.0, 255.0)
"""Least and greatest position, speed and force that can be sent; each is a byte."""

NOT_ACTIVATED = 0x07
"""The code of gFLT of a gripper that was never activated, or lost its activation."""

SAME = 2
"""Positions that differ by no more than this are the same [counts]; at rest gPO varies by one."""


class Progress(IntEnum):
    """State of the activation: gSTA of the two-finger grippers, gIMC of the 3-Finger."""

    RESET = 0
    ACTIVATING = 1
    CHANGING = 2
    """The mode changes; only the 3-Finger has modes."""
    DONE = 3


@dataclass(frozen=True, slots=True)
class Fault:
    """A code of gFLT.

    Attributes:
        name: Its name for messages.
        hint: What to do.
        warning: Whether the gripper continues in spite of it.
        major: Whether only a reset with a new activation clears it.
    """

    name: str
    hint: str = ""
    warning: bool = False
    major: bool = False


class RobotiqOptions(DeviceOptions, frozen=True):
    """Options of all of Robotiq's grippers."""

    port: str = "/dev/ttyUSB0"
    """A tty, socket://, rfc2217:// (RTU) or tcp://."""
    unit: Annotated[int, Meta(ge=0, le=255)] = 9
    """Modbus number of the gripper."""
    baudrate: Rate = 115200
    home: Literal["on_demand", "on_connect"] = "on_demand"
    """When an inactive gripper is activated, which moves all fingers."""
    exchange: ExchangeKind = "auto"
    """How registers are exchanged: function 23, or 16 and a read."""
    check_fingers: bool = True
    """Refuse a gripper whose registers are those of another number of fingers."""
    activation_timeout: Positive = 15.0
    """Longest time of an activation [s]."""


class RobotiqCommand(Registers):
    """The first byte of every gripper's output block.

    Attributes:
        activate: rACT; clearing it resets the gripper and its faults.
        go: rGTO; clearing it stops.
        release: rATR, the automatic release.
    """

    activate: bool = flag(0, 8)
    go: bool = flag(0, 11)
    release: bool = flag(0, 12)


class RobotiqStatus(Registers):
    """The part common to the input blocks of all grippers.

    Attributes:
        activated: gACT.
        going: gGTO; clear while stopped, activating or releasing.
        progress: State of the activation.
        fault: The code of gFLT, 0 for none; see the gripper's `FAULTS`.
    """

    activated: bool = flag(0, 8)
    going: bool = flag(0, 11)
    progress: Progress = at(0, 12, 2, Progress)
    fault: int = at(1, 8, 4)

    @property
    def ready(self) -> bool:
        """Whether the gripper is activated and takes commands."""
        return self.activated and self.progress is Progress.DONE

    @property
    def reset(self) -> bool:
        """Whether the gripper is neither activated nor about to be."""
        return self.progress is Progress.RESET


class SteadyContact:
    """Contact as one motor reports it, debounced.

    A gripper clears its report of contact at every new request, and sets it again when it has found
    that the fingers do not move. While requests change in every cycle, the report therefore comes
    and goes, although the fingers press on the object all the time. So contact is kept as long as
    the requested motion has the same direction and the fingers have not moved.
    """

    def __init__(self) -> None:
        self._side = 0.0
        self._position = math.nan

    def steady(self, contact: bool, moving: bool, position: float, requested: float) -> bool:
        """Return whether the motor is in contact.

        Args:
            contact: Whether it reports contact.
            moving: Whether it reports that it moves or is about to.
            position: Measured position [counts].
            requested: Requested position [counts].
        """
        side = (requested > position) - (requested < position)
        if contact:
            self._side, self._position = side, position
            return True
        # Compared with the position of the reported contact, so that slow motion adds up.
        if moving and side == self._side and abs(position - self._position) <= SAME:
            return True
        self._side, self._position = 0.0, math.nan
        return False
