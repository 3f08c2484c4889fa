"""The Allegro Hand's CAN frames, versions 4 and 5. No I/O."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from rtee.buses.emulator import CanFrame
from rtee.buses.parser import CodecError
from rtee.drivers.packed import Packed, part

BITRATE = 1_000_000  # [bit/s]; the hand's only rate
FINGERS = 4  # per hand, four joints each
PER_FINGER = 4  # joints of each finger
JOINTS = FINGERS * PER_FINGER

_INT16 = struct.Struct("<4h")


class Command(IntEnum):
    """Commands: the identifier of a frame without the two bits of the hand's number."""

    FINGER_POSE = 0x20
    IMU = 0x30
    TEMPERATURE = 0x38
    SYSTEM_ON = 0x40
    SYSTEM_OFF = 0x41
    SET_TORQUE = 0x60
    HAND_INFO = 0x80
    SET_PERIOD = 0x81
    SERIAL = 0x88


def identifier(command: int, hand: int = 0) -> int:
    """Return the CAN identifier of a command for a hand, 0 to 3."""
    return command << 2 | hand


def split(can_id: int) -> tuple[int, int]:
    """Return command and hand of a CAN identifier."""
    return can_id >> 2, can_id & 0x3


def request(command: Command, hand: int = 0) -> CanFrame:
    """Return the frame that requests data from a hand."""
    return CanFrame(identifier(command, hand), remote=True)


def order(command: Command, hand: int = 0) -> CanFrame:
    """Return a command frame without data."""
    return CanFrame(identifier(command, hand))


class Periods(Packed):
    """Periods at which the hand sends data unasked [ms]; 0: never."""

    WHAT = "periods"

    joints: int = part("H", default=0)
    imu: int = part("H", default=0)
    temperature: int = part("H", default=0)

    def to_frame(self, hand: int = 0) -> CanFrame:
        """Return the frame that sets these periods."""
        return CanFrame(identifier(Command.SET_PERIOD, hand), self.to_bytes())


class Status(IntFlag):
    """The status byte of a hand."""

    SERVO_ON = 0x01
    OVER_TEMPERATURE = 0x02
    COMMUNICATION = 0x04


class HandInfo(Packed):
    """The identity and status that a hand reports.

    Attributes:
        hardware: Hardware version; its high byte is the hand's version.
        firmware: Firmware version.
        handedness: 0: right, otherwise left; valid only in version 4.
        temperature: Temperature [°C].
        status: Servo, over-temperature, internal communication.
    """

    WHAT = "hand information"
    LONGER = True

    hardware: int = part("H")
    firmware: int = part("H")
    handedness: int = part("B")
    temperature: int = part("B")
    # No source gives the other bits of the status a meaning.
    status: Status = part("B", kind=lambda bits: Status(bits & 0x07))

    @property
    def version(self) -> int:
        """The hand's version, 4 or 5."""
        return self.hardware >> 8


def side_of(info: HandInfo, serial: str) -> str:
    """Return ``left`` or ``right``; empty if the hand does not report it.

    Version 4 reports it in its information, version 5 in its serial number.
    """
    if info.version == 4:
        return "left" if info.handedness else "right"
    # The fourth character, as the vendor's program reads it.
    return {"L": "left", "R": "right"}.get(serial[3:4], "")


def pack_counts(values: Sequence[float]) -> bytes:
    """Return four joints' values as the hand's 16-bit counts, clamped into their range."""
    # int() rounds towards zero, so that the torque is never greater than commanded.
    return _INT16.pack(*(min(max(int(v), -32768), 32767) for v in values))


def read_counts(data: bytes) -> tuple[int, int, int, int]:
    """Return four joints' counts; raises `CodecError`."""
    if len(data) != _INT16.size:
        raise CodecError(f"four joints take eight bytes, not {len(data)}")
    first, second, third, fourth = _INT16.unpack(data)
    return first, second, third, fourth


@dataclass(frozen=True, slots=True)
class JointScale:
    """The units of a version.

    Attributes:
        version: 4 or 5.
        rad_per_count: Angle per count [rad].
        pwm_per_torque: Counts of torque per N·m, with a 12 V supply.
        period_ms: Period of the joints' frames [ms].
    """

    version: int
    rad_per_count: float
    pwm_per_torque: float
    period_ms: int

    def to_rad(self, count: int) -> float:
        """Convert a count to an angle [rad]."""
        return count * self.rad_per_count

    def to_count(self, angle: float) -> int:
        """Convert an angle [rad] to a count."""
        return round(angle / self.rad_per_count)


SCALES: dict[int, JointScale] = {
    4: JointScale(4, math.radians(333.3 / 65536.0), 1200.0, 3),
    5: JointScale(5, math.radians(0.088), 1200.0, 2),
}
"""Units by version."""

LIMITS_PWM: tuple[int, ...] = (375, 675, 450, 285) * 3 + (525, 405, 270, 270)
"""Largest torque of each joint [counts], as the vendor's programs clamp it."""

NAMES: tuple[str, ...] = ("index", "middle", "ring", "thumb")
"""The fingers, in the order of the frames."""
