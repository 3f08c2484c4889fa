"""Registers and units of Robotiq's three-finger gripper; no I/O.

Sources: the gripper's instruction manuals (register map, bits, fault codes, example frames) and,
for the conversion to joints, published drivers. Every two bytes make a register, the first in its
high half. The order of the status bits differs from that of the two-finger grippers.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from rtee.drivers.registers import RegisterField, at, each, flag
from rtee.drivers.robotiq_common import COUNTS, Fault, RobotiqCommand, RobotiqStatus
from rtee.drivers.scale import FingerScale, LinearScale

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


def _bytes(first: int) -> list[RegisterField]:
    """Return the places of three consecutive bytes in a block."""
    return [RegisterField(i // 2, 0 if i % 2 else 8, 8, int) for i in range(first, first + 3)]


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


class Command(RobotiqCommand):
    """The output block, written by the host.

    Attributes:
        mode: rMOD.
        individual: rICF: each finger follows its own request; otherwise all follow that of ``a``.
        scissor: rICS: the scissor follows its own request in every mode.
        axes: Requests of the four motors, in the order of `AXES`.
    """

    mode: Mode = at(0, 9, 2, Mode)
    individual: bool = flag(0, 2)
    scissor: bool = flag(0, 3)
    axes: tuple[Request, ...] = each(Request, *(_bytes(first) for first in (3, 6, 9, 12)))


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


class Status(RobotiqStatus):
    """The input block, written by the gripper.

    Attributes:
        mode: gMOD.
        motion: gSTA.
        axes: The four motors, in the order of `AXES`.
    """

    WHAT = "status of a 3-finger gripper"
    STRICT = True

    mode: Mode = at(0, 9, 2, Mode)
    motion: Motion = at(0, 14, 2, Motion)
    axes: tuple[AxisStatus, ...] = each(
        AxisStatus,
        *([RegisterField(0, 2 * axis, 2, Contact), *_bytes(3 + 3 * axis)] for axis in range(4)),
    )


STROKE = 0.155
"""Change of the fingertips' opening over all counts [m]."""

SPEED = (0.022, 0.110)
"""Slowest and fastest fingertip [m/s]."""

FORCE = (15.0, 60.0)
"""Weakest and strongest fingertip [N]."""


def _scale(position: LinearScale) -> FingerScale:
    """Return the scale of a motor: gPOx and rPRx to the joint's angle [rad], and rSPx, rFRx."""
    # The fingertip's travel per angle of the joint.
    return FingerScale(position, STROKE / 255 / abs(position.gain), COUNTS, FORCE, SPEED)


# A finger's first joint turns by the same angle per count all the way: the published driver's 200
# counts per radian. The scissor turns linearly between its end counts, and no further.
FINGERS = 3
"""Number of fingers; their axes, a to c, precede the scissor."""
_FINGER = _scale(LinearScale((0.0, 200.0), (0.0, 1.0), ends=COUNTS))
_SCISSOR = _scale(LinearScale((15.0, 240.0), (0.192, -0.192)))

SCALES = {"fingers": _FINGER, "a": _FINGER, "b": _FINGER, "c": _FINGER, "scissor": _SCISSOR}
"""The scales of the motors, and of all fingers together."""
