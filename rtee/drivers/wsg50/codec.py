"""The WSG 50's binary frames, commands and state; no I/O.

Sources: three published drivers, whose enumerations agree, and notes with the maker's example
frames. Numbers are little-endian, lengths in mm, forces in N.
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Self

from rtee.buses.parser import CodecError, FramedParser, Framing
from rtee.drivers.packed import Packed, part

PREAMBLE = b"\xaa\xaa\xaa"
"""The first bytes of every frame."""

PORT = 1000
"""Default TCP port."""

_LONGEST = 256
"""Bytes of the longest payload that is accepted: the device's tag is a text of any length."""
_STATUS = 2
"""Bytes of the status that every answer's payload begins with."""
_ACKNOWLEDGE = b"ack"  # payload that clears a fast stop
_STOP_ON_BLOCK = 0x02  # flag of a pre-position; 1: the width is relative


class Command(IntEnum):
    """The commands of frames."""

    LOOP = 0x06
    DISCONNECT = 0x07
    HOME = 0x20
    MOVE = 0x21
    STOP = 0x22
    FAST_STOP = 0x23
    ACKNOWLEDGE = 0x24
    GRASP = 0x25
    RELEASE = 0x26
    SET_ACCELERATION = 0x30
    ACCELERATION = 0x31
    SET_FORCE = 0x32
    FORCE_LIMIT = 0x33
    SET_SOFT_LIMITS = 0x34
    SOFT_LIMITS = 0x35
    CLEAR_SOFT_LIMITS = 0x36
    TARE = 0x38
    STATE = 0x40
    GRASPING = 0x41
    WIDTH = 0x43
    SPEED = 0x44
    FORCE = 0x45
    TEMPERATURE = 0x46
    INFO = 0x50
    LIMITS = 0x53


MOTIONS = frozenset({Command.HOME, Command.MOVE, Command.GRASP, Command.RELEASE})
"""Commands that are answered twice: at once as pending, later with their result."""


class Status(IntEnum):
    """The first two bytes of every answer."""

    OK = 0x00
    NOT_AVAILABLE = 0x01
    NO_SENSOR = 0x02
    NOT_REFERENCED = 0x03
    ALREADY_RUNNING = 0x04
    NOT_SUPPORTED = 0x05
    INCONSISTENT = 0x06
    TIMEOUT = 0x07
    READ_ERROR = 0x08
    WRITE_ERROR = 0x09
    MEMORY = 0x0A
    CHECKSUM = 0x0B
    NO_PARAMETER_EXPECTED = 0x0C
    TOO_FEW_PARAMETERS = 0x0D
    UNKNOWN_COMMAND = 0x0E
    FORMAT = 0x0F
    ACCESS_DENIED = 0x10
    ALREADY_OPEN = 0x11
    FAILED = 0x12
    ABORTED = 0x13
    HANDLE = 0x14
    NOT_FOUND = 0x15
    NOT_OPEN = 0x16
    IO = 0x17
    PARAMETER = 0x18
    INDEX = 0x19
    PENDING = 0x1A
    OVERRUN = 0x1B
    RANGE = 0x1C
    AXIS_BLOCKED = 0x1D
    EXISTS = 0x1E


class State(IntFlag):
    """Bits of the system's state."""

    REFERENCED = 1 << 0
    MOVING = 1 << 1
    BLOCKED_MINUS = 1 << 2
    BLOCKED_PLUS = 1 << 3
    SOFT_LIMIT_MINUS = 1 << 4
    SOFT_LIMIT_PLUS = 1 << 5
    STOPPED = 1 << 6
    REACHED = 1 << 7
    OVERDRIVE = 1 << 8
    FORCE_CONTROL = 1 << 9
    FAST_STOP = 1 << 12
    TEMPERATURE_WARNING = 1 << 13
    TEMPERATURE_ERROR = 1 << 14
    POWER_ERROR = 1 << 15
    CURRENT_ERROR = 1 << 16
    FINGER_ERROR = 1 << 17
    COMMAND_ERROR = 1 << 18
    SCRIPT_RUNNING = 1 << 19
    SCRIPT_ERROR = 1 << 20


class Grasping(IntEnum):
    """State of a grasp."""

    IDLE = 0
    CLOSING = 1
    NO_PART = 2
    PART_LOST = 3
    HOLDING = 4
    RELEASING = 5
    POSITIONING = 6
    ERROR = 7


_TABLE = tuple(crc_hqx(bytes([byte]), 0) for byte in range(256))


def crc(data: bytes) -> int:
    """Return the checksum of bytes; it is 0 for a whole frame.

    The table is that of CRC-16-CCITT, most significant bit first, but the register is shifted
    right, with 0xFFFF as its initial value: not a standard form.
    """
    value = 0xFFFF
    for byte in data:
        value = _TABLE[(value ^ byte) & 0xFF] ^ value >> 8
    return value


_FRAMING = Framing(
    PREAMBLE, 1, lambda raw: crc(raw).to_bytes(2, "little"), _LONGEST, size=2, tail=2,
)  # fmt: skip
"""The command, and the length of the payload."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A request or an answer.

    Attributes:
        command: The command it belongs to.
        payload: Its data; in an answer, the status comes first.
    """

    command: int
    payload: bytes = b""

    def to_bytes(self) -> bytes:
        """Return the bytes."""
        return _FRAMING.sealed((self.command,), self.payload)

    @classmethod
    def from_bytes(cls, raw: bytes) -> Self:
        """Read a frame; raises `CodecError` if it is not one."""
        [command], payload = _FRAMING.opened(raw)
        return cls(command, payload)

    @property
    def status(self) -> Status:
        """The status of an answer; raises `CodecError` where it has none."""
        if len(self.payload) < _STATUS:
            raise CodecError("the answer has no status")
        try:
            return Status(int.from_bytes(self.payload[:2], "little"))
        except ValueError as error:
            raise CodecError(str(error)) from None


class FrameParser(FramedParser[Frame]):
    """Finds frames in a stream of bytes."""

    FRAMING = _FRAMING
    FRAME = Frame


# --- requests --------------------------------------------------------------------------------


def asking(command: Command) -> Frame:
    """Return the request for one answer, for commands that can also answer periodically."""
    return Frame(command, bytes(3))


def home(direction: int = 0) -> Frame:
    """Return the request to home; direction 0 is the device's own, 1 positive, 2 negative."""
    return Frame(Command.HOME, bytes([direction]))


def move(width: float, speed: float, *, stop_on_block: bool) -> Frame:
    """Return the request to go to a width [mm] at a speed [mm/s]."""
    return Frame(Command.MOVE, struct.pack("<Bff", stop_on_block * _STOP_ON_BLOCK, width, speed))


def grasp(width: float, speed: float) -> Frame:
    """Return the request to grasp a part of a width [mm] at a speed [mm/s]."""
    return Frame(Command.GRASP, struct.pack("<ff", width, speed))


def release(width: float, speed: float) -> Frame:
    """Return the request to release a part by opening to a width [mm] at a speed [mm/s]."""
    return Frame(Command.RELEASE, struct.pack("<ff", width, speed))


def setting(command: Command, *values: float) -> Frame:
    """Return the request to set values, such as an acceleration [mm/s²] or a force [N]."""
    return Frame(command, struct.pack(f"<{len(values)}f", *values))


def acknowledge() -> Frame:
    """Return the request that clears a fast stop."""
    return Frame(Command.ACKNOWLEDGE, _ACKNOWLEDGE)


# --- answers ---------------------------------------------------------------------------------


def answer(command: int, status: Status, data: bytes = b"") -> Frame:
    """Return an answer."""
    return Frame(command, status.to_bytes(2, "little") + data)


def number(frame: Frame) -> float:
    """Return the one number of an answer; raises `CodecError`."""
    return numbers(frame, 1)[0]


def numbers(frame: Frame, count: int) -> tuple[float, ...]:
    """Return the ``count`` finite numbers of an answer; raises `CodecError` for anything else."""
    data = frame.payload[2:]
    if len(data) != 4 * count:
        raise CodecError(f"{len(data)} bytes of numbers instead of {4 * count}")
    values = struct.unpack(f"<{count}f", data)
    # NaN minus itself is not 0, nor is infinity minus itself.
    if any(value - value != 0.0 for value in values):
        raise CodecError("a number that is not finite")
    return values


class Info(Packed):
    """The identity that the gripper reports.

    Attributes:
        kind: Kind of device.
        hardware: Revision of the hardware.
        firmware: Version, such as 0x4000 for 4.0.
        serial: Serial number.
    """

    WHAT = "the information of a WSG"

    kind: int = part("B")
    hardware: int = part("B")
    firmware: int = part("H")
    serial: int = part("I")

    @property
    def version(self) -> str:
        """The firmware's version as text: a digit in each half byte, the last two as one."""
        return f"{self.firmware >> 12}.{self.firmware >> 8 & 0xF}.{self.firmware & 0xFF}"


class Limits(Packed):
    """The gripper's own limits.

    Attributes:
        stroke: Largest width [mm].
        speed: Least and greatest [mm/s].
        acceleration: Least and greatest [mm/s²].
        force: Least, nominal and with overdrive [N].
    """

    WHAT = "the limits of a WSG"

    stroke: float = part("f", default=110.0)
    speed: tuple[float, float] = part("f", 2, default=(5.0, 420.0))
    acceleration: tuple[float, float] = part("f", 2, default=(100.0, 5000.0))
    force: tuple[float, float, float] = part("f", 3, default=(5.0, 80.0, 120.0))

    @classmethod
    def from_frame(cls, frame: Frame) -> Self:
        """Read the limits from an answer; raises `CodecError`."""
        stroke, slow, fast, weak, strong, least, nominal, most = numbers(frame, 8)
        if not (stroke > 0.0 and 0.0 <= slow < fast and weak < strong and least < nominal):
            raise CodecError("not valid limits")
        return cls(stroke, (slow, fast), (weak, strong), (least, nominal, most))


def state_of(frame: Frame) -> State:
    """Return the system state in an answer; raises `CodecError`."""
    if len(frame.payload) != _STATUS + 4:
        raise CodecError("the answer carries no state")
    return State(int.from_bytes(frame.payload[2:], "little"))


def grasping_of(frame: Frame) -> Grasping:
    """Return the grasping state in an answer; raises `CodecError`."""
    if len(frame.payload) != _STATUS + 1 or frame.payload[2] > max(Grasping):
        raise CodecError("the answer carries no grasping state")
    return Grasping(frame.payload[2])
