"""The RH56's registers, its serial frames and the tables in its registers; no I/O.

Sources: registers, frames, error and status codes from published clients, which quote the maker's
manuals. Addresses count bytes; a 16-bit value takes two, the low byte first. Over Modbus, the same
numbers address registers, and the tables keep their order.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import STRICT, IntEnum, IntFlag
from typing import ClassVar, Self

from rtee.buses.parser import CodecError, FramedParser, Framing
from rtee.drivers.packed import Packed, part

BAUDRATES = (115_200, 57_600, 19_200, 921_600)
"""Baud rates of a hand, by their code in `Register.BAUD`."""
FINGERS = ("little", "ring", "middle", "index", "thumb_bend", "thumb_rotate")
"""The six motors, in the order of every table."""
COUNT = len(FINGERS)
WORDS = 2 * COUNT  # bytes of a table of 16-bit values
OPEN = 1000
"""Angle count of an open finger; 0 is closed."""
KEEP = -1
"""A value that leaves the motor's present set-point unchanged."""
MOST = 1000
"""Largest speed, and largest force limit of a hand without tactile sensors [g]."""
MOST_TACTILE = 3000
"""Largest force limit of a hand with tactile sensors [g]."""
OVERHEAD = 8  # bytes of a frame without its data

_INSIDE = 3
"""Bytes that a frame's length counts in addition to the data: command and address."""
MOST_DATA = 0xFF - _INSIDE
"""Largest number of data bytes in a frame, which has one length byte."""

_BELOW, _ABOVE = -100, 2000
"""Range of plausible angle counts: from a tenth of the travel below 0 to the value in an example
frame of the manual."""
_TABLE = struct.Struct(f"<{COUNT}h")


REQUEST = Framing(
    b"\xeb\x90",
    1,
    lambda raw: bytes([sum(raw[2:]) & 0xFF]),
    0xFF,
    _INSIDE + 1,
)
"""Framing of requests: the hand's number, then the length of command, address and data."""
REPLY = replace(REQUEST, header=b"\x90\xeb")
"""Framing of replies, which have another header."""


class Command(IntEnum):
    """Command of a frame."""

    READ = 0x11
    WRITE = 0x12


class Register(IntEnum):
    """Addresses of registers."""

    HAND_ID = 1000
    BAUD = 1002
    CLEAR_ERROR = 1004
    SAVE = 1005
    RESET = 1006
    FORCE_CALIBRATION = 1009
    CURRENT_LIMIT = 1020
    INITIAL_SPEED = 1032
    INITIAL_FORCE = 1044
    VOLTAGE = 1472
    STROKE_SET = 1474
    ANGLE_SET = 1486
    FORCE_SET = 1498
    SPEED_SET = 1522
    STROKE = 1534
    ANGLE = 1546
    FORCE = 1582
    CURRENT = 1594
    ERROR = 1606
    STATUS = 1612
    TEMPERATURE = 1618


REPORT = 42
"""Bytes from `Register.FORCE` to the last temperature."""
GAP = bytes(Register.FORCE - Register.ANGLE - WORDS)
"""The bytes between the angles and the `REPORT`, which have no meaning."""
BLOCK = WORDS + len(GAP) + REPORT
"""Bytes from the angles to the last temperature."""


class Error(IntFlag, boundary=STRICT):
    """Bits of a motor's error byte; the other three have no meaning."""

    LOCKED = 1
    TOO_HOT = 2
    CURRENT = 4
    ABNORMAL = 8
    COMMUNICATION = 16


ERRORS = {
    Error.LOCKED: "rotor locked",
    Error.TOO_HOT: "too hot",
    Error.CURRENT: "over-current",
    Error.ABNORMAL: "abnormal",
    Error.COMMUNICATION: "no communication with its motor",
}
"""Names of the bits of an error byte."""


class State(IntEnum):
    """Values of a motor's status byte.

    After power-up and until its first command, a motor is `UNSET` and has no angle set-point. A
    value without a published meaning is `OTHER`: one motor must not make all measurements invalid.
    """

    OPENING = 0
    CLOSING = 1
    AT_TARGET = 2
    AT_FORCE = 3
    CURRENT_PROTECTION = 5
    LOCKED = 6
    FAULT = 7
    OTHER = 0xFE
    UNSET = 0xFF

    @classmethod
    def _missing_(cls, value: object) -> State:
        return cls.OTHER


@dataclass(frozen=True, slots=True)
class Frame:
    """A request or a reply; they differ by the header.

    Attributes:
        hand: Number of the hand.
        command: Read or write.
        address: First register.
        data: Contents of the registers; in a read request the number of bytes, in the reply to a
            write 1 if it was accepted.
    """

    hand: int
    command: int
    address: int
    data: bytes

    def to_bytes(self, framing: Framing) -> bytes:
        """Return the frame as sent: a `REQUEST` or a `REPLY`."""
        body = bytes([self.command]) + self.address.to_bytes(2, "little") + self.data
        return framing.sealed((self.hand,), body)

    @classmethod
    def from_bytes(cls, raw: bytes) -> Self:
        """Return the frame that ``raw`` holds, a request or a reply; raises `CodecError`."""
        [hand], body = (REQUEST if raw.startswith(REQUEST.header) else REPLY).opened(raw)
        return cls(hand, body[0], int.from_bytes(body[1:3], "little"), body[3:])


class RequestParser(FramedParser[Frame]):
    """Finds requests in a stream, for a hand."""

    FRAMING = REQUEST
    FRAME = Frame


class ReplyParser(RequestParser):
    """Finds replies in a stream, for a host."""

    FRAMING = REPLY


class SetPoints(Packed):
    """The set-points of a hand: from `Register.ANGLE_SET` to the last speed.

    Attributes:
        angles: Angles [counts]; `KEEP`: a motor has none yet.
        forces: Force limits [g].
        speeds: Speeds [0.1 %].
    """

    WHAT = "set-points of an RH56"
    SIZE: ClassVar[int] = Register.SPEED_SET + WORDS - Register.ANGLE_SET

    angles: tuple[int, ...] = part("h", COUNT)
    forces: tuple[int, ...] = part("h", COUNT)
    speeds: tuple[int, ...] = part("h", COUNT, skip=WORDS)


def words(data: bytes) -> tuple[int, ...]:
    """Return the six values of a table; raises `CodecError` if the length is wrong."""
    if len(data) != WORDS:
        raise CodecError(f"{len(data)} bytes are not a table of six values")
    return _TABLE.unpack(data)


def table(values: Sequence[int]) -> bytes:
    """Return the bytes of a table of six values."""
    return _TABLE.pack(*values)


def _angle(count: int) -> int:
    # A checksum of one byte does not detect all damage, so impossible values are refused.
    if not _BELOW <= count <= _ABOVE:
        raise ValueError(f"angle {count}")
    return count


class Report(Packed):
    """The measurements of a hand, in the order of `FINGERS`: the `BLOCK` from the angles on.

    Attributes:
        angles: Angles, 0 closed to 1000 open [counts].
        forces: Forces, positive against the closing finger [g].
        currents_ma: Motor currents [mA].
        errors: Error bits of the motors.
        states: States of the motors.
        temperatures: Motor temperatures [°C].
    """

    WHAT = "a report of an RH56"

    angles: tuple[int, ...] = part("h", COUNT, kind=_angle)
    forces: tuple[int, ...] = part("h", COUNT, skip=len(GAP))
    currents_ma: tuple[int, ...] = part("h", COUNT)
    errors: tuple[Error, ...] = part("B", COUNT, kind=Error)
    states: tuple[State, ...] = part("B", COUNT, kind=State)
    temperatures: tuple[int, ...] = part("B", COUNT)
