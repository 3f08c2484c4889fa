"""Registers and units of Robotiq's three-finger gripper; no I/O.

Sources: the gripper's instruction manuals (register map, bits, fault codes, example frames) and,
for the conversion to joints, published drivers. Every two bytes make a register, the first in its
high half. The order of the status bits differs from that of the two-finger grippers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Self

from rtee.drivers.robotiq_common import COUNTS, Fault, Progress, RobotiqCommand, RobotiqStatus
from rtee.drivers.scale import LinearScale
from rtee.errors import FrameError

COUNT = 8
"""Registers of either block."""

AXES = ("a", "b", "c", "scissor")
"""The four motors, in the order of their bytes."""


class Mode(IntEnum):
    """rMOD and gMOD: the arrangement of the fingers."""

    BASIC = 0
    PINCH = 1
    WIDE = 2
    SCISSOR = 3


class Motion(IntEnum):
    """gSTA: the motion of all fingers together."""

    MOVING = 0
    SOME_SHORT = 1
    ALL_SHORT = 2
    ALL_REACHED = 3


class Contact(IntEnum):
    """gDTA to gDTS: the contact of one motor."""

    MOVING = 0
    OPENING = 1
    CLOSING = 2
    AT_REQUEST = 3


FAULTS: dict[int, Fault] = {
    0x05: Fault("the action waits for the activation", "wait", warning=True),
    0x06: Fault("the action waits for the change of mode", "wait", warning=True),
    0x07: Fault("not activated", "activate it: all fingers then move"),
    0x09: Fault("the communication chip is not ready", "wait", warning=True),
    0x0A: Fault("the scissor is obstructed", "open the fingers and free the scissor", warning=True),
    0x0B: Fault("automatic release under way", "wait until it ends, then recover", major=True),
    0x0D: Fault("activation failed", "free the fingers, then recover and activate", major=True),
    0x0E: Fault("change of mode failed", "free the scissor, then recover", major=True),
    0x0F: Fault("automatic release completed", "recover and activate", major=True),
}
"""The fault codes of gFLT."""


@dataclass(frozen=True, slots=True)
class Request:
    """The request to one motor.

    Attributes:
        position: 0 open to 255 closed.
        speed: 0 slowest (not stopped) to 255.
        force: 0 weakest (not none) to 255.
    """

    position: int = 0
    speed: int = 0
    force: int = 0


@dataclass(frozen=True, slots=True)
class Command(RobotiqCommand):
    """The output block, written by the host.

    Attributes:
        mode: rMOD.
        individual: rICF: the three fingers follow their own requests, else all that of ``a``.
        scissor: rICS: the scissor follows its own request in every mode.
        axes: Requests of the four motors, in the order of `AXES`.
    """

    mode: Mode = Mode.BASIC
    individual: bool = False
    scissor: bool = False
    axes: tuple[Request, Request, Request, Request] = (Request(),) * 4

    def to_registers(self) -> tuple[int, ...]:
        """Return the eight registers."""
        action = self.activate | self.mode << 1 | self.go << 3 | self.release << 4
        options = self.individual << 2 | self.scissor << 3
        data = [action, options, 0]
        for axis in self.axes:
            data += [axis.position, axis.speed, axis.force]
        return _packed([*data, 0])

    @classmethod
    def from_registers(cls, registers: Sequence[int]) -> Self:
        """Read it from eight registers."""
        data = _unpacked(registers)
        axes = tuple(Request(*data[at : at + 3]) for at in (3, 6, 9, 12))
        return cls(
            activate=bool(data[0] & 0x01),
            mode=Mode(data[0] >> 1 & 3),
            go=bool(data[0] & 0x08),
            release=bool(data[0] & 0x10),
            individual=bool(data[1] & 0x04),
            scissor=bool(data[1] & 0x08),
            axes=(axes[0], axes[1], axes[2], axes[3]),
        )


@dataclass(frozen=True, slots=True)
class AxisStatus:
    """The state of one motor.

    Attributes:
        contact: gDTx.
        requested: gPRx, echo of the accepted position; 0 where the motor has no own request.
        position: gPOx, measured.
        raw_current: gCUx.
    """

    contact: Contact = Contact.MOVING
    requested: int = 0
    position: int = 0
    raw_current: int = 0


@dataclass(frozen=True, slots=True)
class Status(RobotiqStatus):
    """The input block, written by the gripper.

    Attributes:
        mode: gMOD.
        motion: gSTA.
        axes: The four motors, in the order of `AXES`.
    """

    mode: Mode = Mode.BASIC
    motion: Motion = Motion.MOVING
    axes: tuple[AxisStatus, ...] = (AxisStatus(),) * 4

    def to_registers(self) -> tuple[int, ...]:
        """Return the eight registers."""
        state = self.activated | self.mode << 1 | self.going << 3
        state |= self.progress << 4 | self.motion << 6
        contacts = sum(axis.contact << 2 * i for i, axis in enumerate(self.axes))
        data = [state, contacts, self.fault]
        for axis in self.axes:
            data += [axis.requested, axis.position, axis.raw_current]
        return _packed([*data, 0])

    @classmethod
    def from_registers(cls, registers: Sequence[int], bus: str = "") -> Self:
        """Read it from eight registers; raises `FrameError` for bits that are always clear."""
        data = _unpacked(registers)
        if data[2] & 0xF0 or data[15]:
            raw = bytes(data)
            raise FrameError(bus, f"no status of a 3-finger gripper: {raw.hex(' ')}", raw)
        axes = tuple(
            AxisStatus(Contact(data[1] >> 2 * i & 3), *data[3 + 3 * i : 6 + 3 * i])
            for i in range(4)
        )
        return cls(
            activated=bool(data[0] & 0x01),
            mode=Mode(data[0] >> 1 & 3),
            going=bool(data[0] & 0x08),
            progress=Progress(data[0] >> 4 & 3),
            motion=Motion(data[0] >> 6),
            fault=data[2],
            axes=axes,
        )


STROKE = 0.155
"""Change of the fingertips' opening over all counts [m]."""

SPEED = (0.022, 0.110)
"""Slowest and fastest fingertip [m/s]."""

FORCE = (15.0, 60.0)
"""Weakest and strongest fingertip [N]."""


class Scale:
    """Converts between the counts of a motor and its joint's units.

    Speed and force are those of the fingertips; at the joint they follow by virtual work from the
    stroke.

    Attributes:
        position: The joint's angle [rad] by the counts of gPOx and rPRx.
        velocity: rSPx to [rad/s].
        effort: rFRx to [N·m].
    """

    def __init__(self, position: LinearScale) -> None:
        self.position = position
        way = STROKE / 255 / abs(position.gain)  # of the fingertip per angle of the joint [m/rad]
        self.velocity = LinearScale(COUNTS, (SPEED[0] / way, SPEED[1] / way))
        self.effort = LinearScale(COUNTS, (FORCE[0] * way, FORCE[1] * way))

    def angle(self, count: float) -> float:
        """Return the joint's angle for a count, which may lie beyond its end stops [rad]."""
        low, high = sorted(self.position.ends or self.position.raw)
        return self.position.to_si(min(max(count, low), high))


# A finger's first joint turns by the same angle per count all the way: the published driver's 200
# counts per radian. The scissor turns linearly between its end counts, and no further.
FINGERS = 3
"""Axes ahead of the scissor, a to c."""
_FINGER = Scale(LinearScale((0.0, 200.0), (0.0, 1.0), ends=COUNTS))
_SCISSOR = Scale(LinearScale((15.0, 240.0), (0.192, -0.192)))

SCALES = {"fingers": _FINGER, "a": _FINGER, "b": _FINGER, "c": _FINGER, "scissor": _SCISSOR}
"""The scales of the motors, and of all fingers together."""


def _packed(data: Sequence[int]) -> tuple[int, ...]:
    return tuple(data[i] << 8 | data[i + 1] for i in range(0, 2 * COUNT, 2))


def _unpacked(registers: Sequence[int]) -> list[int]:
    return [byte for register in registers[:COUNT] for byte in (register >> 8, register & 0xFF)]
