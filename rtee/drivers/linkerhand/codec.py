"""The LinkerHands' registers, CAN properties, fault codes and version block; no I/O.

Sources: register numbers, CAN properties and ranges from the maker's Python SDK; for the O6, also
from an independent client. Every register and every byte on CAN holds one value from 0 to 255.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from rtee.buses.emulator import CanFrame
from rtee.buses.parser import CodecError
from rtee.drivers.registers import Registers, at

RIGHT, LEFT = 0x27, 0x28
"""Modbus number, and identifier on CAN, of a right and of a left hand."""
BAUDRATE = 115_200  # RS-485 [baud]; the hands' only rate
VERSION_CODES = frozenset({0x64, 0xC2})
"""CAN properties with the version; newer firmware answers the second. They are assumed to contain
the version block of RS-485."""
BITRATE = 1_000_000  # CAN [bit/s]
MOST = 255
"""Largest value of a register."""


class Fault(IntEnum):
    """A motor's fault code."""

    NONE = 0
    OVER_CURRENT = 1
    OVER_TEMPERATURE = 2
    ENCODER = 3
    SUPPLY = 4


FAULT_NAMES: Mapping[int, str] = {
    Fault.OVER_CURRENT: "over-current",
    Fault.OVER_TEMPERATURE: "over-temperature",
    Fault.ENCODER: "encoder error",
    Fault.SUPPLY: "supply too high or too low",
}
"""Names of the fault codes, from the maker's interface document."""


class Table(IntEnum):
    """Tables with a value for each motor, numbered by the CAN property of the first values."""

    POSITION = 0x01
    TORQUE = 0x02
    SPEED = 0x05
    TEMPERATURE = 0x33
    FAULT = 0x35


class Block(NamedTuple):
    """The place of a table.

    Attributes:
        register: Its first input register; the holding registers have the same numbers.
        properties: Its CAN properties in the order of its values: code and count.
    """

    register: int
    properties: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Model:
    """A kind of hand.

    Attributes:
        motors: Its motors, in the order of every table.
        ranges: Positions of each motor at 255 and at 0, from the maker's SDK [rad].
        tables: The places of its tables.
        version: First register of its version block.
        spacing: Silence that the maker's SDK leaves between two frames on RS-485 [s].
        joint_write: Whether positions, torques and speeds may be written in one frame.
    """

    name: str
    motors: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]
    tables: Mapping[Table, Block]
    version: int
    spacing: float
    joint_write: bool

    @property
    def count(self) -> int:
        """Number of its motors."""
        return len(self.motors)


O6 = Model(
    "O6",
    ("thumb_bend", "thumb_yaw", "index", "middle", "ring", "little"),
    ((0.0, 0.58), (0.0, 1.36), (0.0, 1.60), (0.0, 1.60), (0.0, 1.60), (0.0, 1.60)),
    {
        table: Block(first, ((table, 6),))
        for table, first in zip(Table, (0, 6, 12, 18, 24), strict=True)
    },
    30,
    spacing=0.030,
    joint_write=True,
)
L10 = Model(
    "L10",
    # The maker's lists swap the names of the second and the last motor; according to its range, the
    # second motor rotates the thumb in front of the palm.
    (
        "thumb_bend", "thumb_yaw", "index", "middle", "ring", "little",
        "index_roll", "ring_roll", "little_roll", "thumb_roll",
    ),
    (
        (0.0, 0.75), (0.0, 1.43), (0.0, 1.62), (0.0, 1.62), (0.0, 1.62), (0.0, 1.62),
        (0.21, -0.26), (0.21, 0.0), (0.34, 0.0), (-0.52, 1.01),
    ),
    {
        table: Block(first, ((table, 5), (table + 1, 5)))
        for table, first in zip(Table, (0, 10, 20, 40, 50), strict=True)
    }
    # The SDK sends the second part of the positions first.
    | {Table.POSITION: Block(0, ((0x01, 6), (0x04, 4)))},
    158,
    spacing=0.005,
    joint_write=False,
)  # fmt: skip
MODELS: Mapping[str, Model] = {"o6": O6, "l10": L10}
"""The models by their names in hand.yaml."""


class Side(IntEnum):
    """The side of a hand, as the initial letter of its name."""

    LEFT = ord("L")
    RIGHT = ord("R")


class Version(Registers):
    """The version block of a hand.

    Attributes:
        motors: Number of its degrees of freedom.
        hand: Version of the hand.
        serial: Serial number or lot.
        side: Its side.
        software: Version of its software, major and minor in a nibble each.
        hardware: Version of its hardware, in the same form.
    """

    WHAT = "version block of a LinkerHand"

    motors: int = at(0)
    hand: int = at(1)
    serial: int = at(2)
    side: Side = at(3, kind=Side, default=Side.RIGHT)
    software: int = at(4)
    hardware: int = at(5)


def dotted(version: int) -> str:
    """Return a version of two nibbles as text."""
    return f"{version >> 4 & 0xF}.{version & 0xF}"


VALUES, FAULTS = frozenset(range(MOST + 1)), frozenset(int(fault) for fault in Fault)
"""What a register can hold, and the published fault codes."""


def checked(
    registers: Sequence[int], count: int, known: Collection[int] = VALUES
) -> tuple[int, ...]:
    """Return the values of a table; raises `CodecError` for a wrong number or a bad value.

    Args:
        registers: The registers.
        count: The expected number of them.
        known: Values that they can have.
    """
    if len(registers) != count or not all(value in known for value in registers):
        raise CodecError(f"not {count} values of a LinkerHand: {list(registers)}")
    return tuple(registers)


# --- CAN -----------------------------------------------------------------------------------------


def query(unit: int, code: int) -> CanFrame:
    """Return the frame that asks a hand for a property."""
    return CanFrame(unit, bytes([code]))


def property_frame(unit: int, code: int, values: Sequence[int]) -> CanFrame:
    """Return the frame that sets or reports a property."""
    return CanFrame(unit, bytes((code, *values)))


def answers(frame: CanFrame, unit: int, code: int, count: int) -> bool:
    """Return whether a frame reports a property with at least ``count`` values."""
    fits = frame.id == unit and not (frame.remote or frame.extended)
    return fits and len(frame.data) > count and frame.data[0] == code
