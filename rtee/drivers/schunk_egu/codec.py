"""Parameters, cyclic images and error codes of SCHUNK's EGU and EGK on Modbus RTU; no I/O.

Sources: the maker's own ROS 2 library, simulator and Python tools, which agree on parameters,
images and bits. The first register of a parameter is its number minus one; the registers hold its
bytes in the order of the device's memory, numbers with the low byte first.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum, IntFlag
from typing import Self

from rtee.drivers.packed import Packed, part, text
from rtee.errors import FrameError

IMAGE = 8
"""Number of registers in each cyclic image."""

_FLOAT = struct.Struct("<f")


class Parameter(IntEnum):
    """Numbers of parameters."""

    INPUT = 0x0040
    OUTPUT = 0x0048
    COMMAND = 0x0100
    ERROR = 0x0118
    SET_POSITION = 0x0200
    SET_SPEED = 0x0208
    SET_FORCE = 0x0220
    DIRECTION = 0x0228
    POSITION = 0x0230
    SPEED = 0x0238
    MODULE = 0x0500
    RELEASE_DELTA = 0x0540
    STROKE = 0x0588
    PREPOSITION = 0x05A8
    LEAST_POSITION = 0x0600
    MOST_POSITION = 0x0608
    MOST_SPEED = 0x0630
    MOST_GRIP_SPEED = 0x0650
    MOST_FORCE = 0x0660
    SERIAL = 0x1000
    SOFTWARE = 0x1118
    FIELDBUS = 0x1130

    @property
    def register(self) -> int:
        """Its first register."""
        return self.value - 1


TEXTS = {Parameter.SERIAL: 8, Parameter.SOFTWARE: 11}
"""Number of registers of each parameter that is text."""

MODULES: dict[int, str] = {
    **{6 + i: f"EGU {size} N-B" for i, size in enumerate((50, 60, 70, 80))},
    **{10 + i: f"EGU {size} M-B" for i, size in enumerate((50, 60, 70, 80))},
    **{14 + i: f"EGK {size} N-B" for i, size in enumerate((25, 40, 50))},
    **{17 + i: f"EGK {size} M-B" for i, size in enumerate((25, 40, 50))},
    **{20 + i: "EGU or EGK, SD" for i in range(8)},
}
"""Module types by their number; those with M maintain force and position without power."""


class Control(IntFlag):
    """Bits of the control word."""

    RUN = 1 << 0
    """A cleared bit is a fast stop."""
    STOP = 1 << 1
    ACKNOWLEDGE = 1 << 2
    SHUTDOWN = 1 << 3
    SOFT_RESET = 1 << 4
    EMERGENCY_RELEASE = 1 << 5
    REPEAT = 1 << 6
    """Toggling it repeats the same command."""
    OUTWARD = 1 << 7
    JOG_MINUS = 1 << 8
    JOG_PLUS = 1 << 9
    RELEASE = 1 << 11
    GRIP = 1 << 12
    MOVE = 1 << 13
    MOVE_BY = 1 << 14
    GRIP_AT = 1 << 16
    BRAKE_TEST = 1 << 30
    MAINTAIN = 1 << 31


COMMANDS: dict[int, Control] = {
    0x11: Control.RELEASE,
    0x42: Control.BRAKE_TEST,
    0x8B: Control.ACKNOWLEDGE,
    0x91: Control.STOP,
    0xAF: Control.GRIP_AT,
    0xB0: Control.MOVE,
    0xB4: Control.GRIP,
    0xB8: Control.MOVE_BY,
}
"""Commands by the code that is written to `Parameter.COMMAND`, as the maker's tools do."""

FAST_STOP_CODE = 0x90
"""The code of a fast stop."""


class Status(IntFlag):
    """Bits of the status word."""

    READY = 1 << 0
    AUTHORITY = 1 << 1
    SHUTDOWN_READY = 1 << 2
    NOT_FEASIBLE = 1 << 3
    SUCCESS = 1 << 4
    RECEIVED = 1 << 5
    """Toggles with every accepted command."""
    WARNING = 1 << 6
    ERROR = 1 << 7
    RELEASED = 1 << 8
    SOFT_LIMIT = 1 << 9
    NO_WORKPIECE = 1 << 11
    GRIPPED = 1 << 12
    REACHED = 1 << 13
    PRE_HOLDING = 1 << 14
    MOVING = 1 << 15
    LOST = 1 << 16
    WRONG_WORKPIECE = 1 << 17
    BRAKE = 1 << 31


RESULTS = (
    Status.NOT_FEASIBLE
    | Status.SUCCESS
    | Status.ERROR
    | Status.NO_WORKPIECE
    | Status.GRIPPED
    | Status.REACHED
    | Status.LOST
    | Status.WRONG_WORKPIECE
)
"""Bits of which at least one is set when a command has ended."""

FAST_STOP, SILENT, UNHEARD = 0xD9, 0xEF, 0xF7
"""Errors that are normal after power-up and after a pause: fast stop, and communication lost."""

ERRORS: dict[int, str] = {
    0x03: "no access rights",
    0x28: "brake test failed",
    0x6C: "motor too cold",
    0x6D: "motor too hot",
    0x70: "electronics too cold",
    0x71: "electronics too hot",
    0x72: "supply of the electronics too low",
    0x73: "supply of the electronics too high",
    0x74: "supply of the motor too low",
    0x75: "supply of the motor too high",
    0x7C: "restart required",
    0x7E: "power stage fault",
    0xBA: "position not held",
    0xBB: "position not held",
    0xD4: "invalid command",
    0xD5: "below the smallest position",
    0xD6: "above the largest position",
    FAST_STOP: "fast stop",
    0xDE: "motor current too high",
    0xDF: "motor overloaded (I²t)",
    0xE4: "speed too high",
    SILENT: "communication lost",
    0xF0: "referencing took too long",
    0xF1: "motion took too long",
    0xF2: "not referenced",
    0xF4: "motion blocked",
    UNHEARD: "no communication",
    0xFB: "memory lost",
}
"""Names of the error codes."""

_COLD, _HOT = "let it warm up", "let it cool down"
_SUPPLY = "check the 24 V supply"
_BLOCKED = "free the fingers"
_SILENCE = "check the cable, and that nothing delays this program"
REMEDIES: dict[int, str] = {
    0x03: "end the other program or controller that commands it",
    0x28: "have its brake checked",
    0x6C: _COLD,
    0x6D: _HOT,
    0x70: _COLD,
    0x71: _HOT,
    0x72: _SUPPLY,
    0x73: _SUPPLY,
    0x74: _SUPPLY,
    0x75: _SUPPLY,
    0x7C: "switch its supply off and on",
    0x7E: "switch its supply off and on; if the error comes back, it needs service",
    0xBA: "see what has moved the fingers",
    0xBB: "see what has moved the fingers",
    0xD5: "compare the actuator's limits with those of the gripper",
    0xD6: "compare the actuator's limits with those of the gripper",
    FAST_STOP: "see what has stopped it",
    0xDE: _BLOCKED,
    0xDF: _BLOCKED,
    0xE4: "see what has moved the fingers",
    SILENT: _SILENCE,
    0xF0: _BLOCKED,
    0xF1: _BLOCKED,
    0xF2: "reference it with the maker's program",
    0xF4: _BLOCKED,
    UNHEARD: _SILENCE,
    0xFB: "switch its supply off and on; if the error comes back, it needs service",
}
"""What removes the cause of an error, by its code; the others have no known remedy."""

WARNINGS: dict[int, str] = {
    0x90: "electronics nearly too cold",
    0x91: "electronics nearly too hot",
    0x92: "motor nearly too cold",
    0x93: "motor nearly too hot",
    0x94: "command not feasible",
    0x96: "supply of the electronics low",
    0x97: "supply of the electronics high",
    0x98: "supply of the motor low",
    0x99: "supply of the motor high",
    0xA1: "no workpiece",
}
"""Names of the warning codes."""


class Image(Packed):
    """A cyclic image of eight registers."""

    WHAT = "an image of an EGU or EGK"

    def to_registers(self) -> tuple[int, ...]:
        """Return the eight registers."""
        return registers(self.to_bytes())

    @classmethod
    def from_registers(cls, words: Sequence[int], bus: str = "") -> Self:
        """Decode eight registers; raises `FrameError` for another number of registers."""
        data = data_of(words)
        try:
            return cls.from_bytes(data)
        except ValueError as error:
            raise FrameError(bus, str(error), data) from None


class Output(Image):
    """The registers that the host writes in one frame.

    Attributes:
        control: Control word with at most one command bit.
        position: Target, the distance between the fingers [µm].
        speed: Speed of a motion, of that distance [µm/s]; 0 in a grip: the gripper's default.
        force: Force of a grip [%].
    """

    control: Control = part("I", kind=Control, default=Control.RUN)
    position: int = part("i", default=0)
    speed: int = part("i", default=0)
    force: int = part("i", default=0)


class Input(Image):
    """The gripper's report of every cycle.

    Attributes:
        status: Status word.
        position: Measured [µm].
        error: Error code, 0 for none; see `ERRORS`.
        warning: Warning code, 0 for none; see `WARNINGS`.
        additional: A further code.
    """

    status: Status = part("I", kind=Status, default=Status(0))
    position: int = part("i", default=0)
    # Only the low byte of the error is used.
    error: int = part("H", kind=lambda word: word & 0xFF, skip=4, default=0)
    warning: int = part("B", default=0)
    additional: int = part("B", default=0)


def registers(data: bytes) -> tuple[int, ...]:
    """Return bytes of the device's memory as registers."""
    # Big-endian to keep the order of the bytes: Modbus sends the high one of a register first.
    return struct.unpack(f">{len(data) // 2}H", data)


def data_of(words: Sequence[int]) -> bytes:
    """Return registers as bytes of the device's memory."""
    return struct.pack(f">{len(words)}H", *words)


def float_of(words: Sequence[int]) -> float:
    """Return the value of a parameter that is a number."""
    return float(_FLOAT.unpack(data_of(words))[0])


def float_registers(value: float) -> tuple[int, ...]:
    """Return a number as registers."""
    return registers(_FLOAT.pack(value))


def text_of(words: Sequence[int]) -> str:
    """Return the value of a parameter that is text."""
    return text(data_of(words))
