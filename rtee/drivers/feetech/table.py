"""The families of Feetech's serial bus servos: their registers, byte orders and units.

Signed words are a sign bit and a magnitude, never two's complement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

FamilyName = Literal["scs", "sts", "sms", "hls"]

BAUD_RATES: Final = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""Baud rate for each value of the register, in the vendor's order."""
MOST_GAIN = 254
"""Largest gain [counts]."""
CURRENT_UNIT = 6.5e-3
"""Current per count [A]."""
FULL = 1000
"""Counts of full torque, full load and the full torque limit; a count is 0.1 %."""
RAM = 40
"""First address that does not survive a power cycle."""
END = 87
"""First address after the table; its last registers are for the factory only."""
_RPM = 2.0 * math.pi / 60.0


class Register(NamedTuple):
    """A value in the table.

    Attributes:
        address: Its first byte.
        size: Its bytes.
        sign: Number of its sign bit; ``None``: unsigned.
    """

    address: int
    size: int
    sign: int | None = None


FIRMWARE = Register(0, 2)
ORDER = Register(2, 1)
MODEL = Register(3, 2)
ID = Register(5, 1)
BAUD_RATE = Register(6, 1)
RETURN_DELAY = Register(7, 1)
RESPONSE_LEVEL = Register(8, 1)
MIN_ANGLE = Register(9, 2)
MAX_ANGLE = Register(11, 2)
MAX_TEMPERATURE = Register(13, 1)
MAX_VOLTAGE = Register(14, 1)
MIN_VOLTAGE = Register(15, 1)
MAX_TORQUE = Register(16, 2)
PHASE = Register(18, 1)
UNLOAD = Register(19, 1)
ALARM = Register(20, 1)
P = Register(21, 1)
D = Register(22, 1)
I = Register(23, 1)  # noqa: E741 - the gain's usual letter
PROTECTION_CURRENT = Register(28, 2)
MODE = Register(33, 1)
TORQUE = Register(40, 1)
ACCELERATION = Register(41, 1)
GOAL_POSITION = Register(42, 2, 15)
GOAL_TIME = Register(44, 2)
GOAL_SPEED = Register(46, 2, 15)
TORQUE_LIMIT = Register(48, 2)
PRESENT_POSITION = Register(56, 2, 15)
PRESENT_SPEED = Register(58, 2, 15)
PRESENT_LOAD = Register(60, 2, 10)
PRESENT_VOLTAGE = Register(62, 1)
PRESENT_TEMPERATURE = Register(63, 1)
PENDING = Register(64, 1)
STATUS = Register(65, 1)
MOVING = Register(66, 1)
PRESENT_CURRENT = Register(69, 2, 15)

MEASURED = (
    PRESENT_POSITION, PRESENT_SPEED, PRESENT_LOAD, PRESENT_CURRENT, PRESENT_TEMPERATURE,
    PRESENT_VOLTAGE,
)  # fmt: skip
"""Measurements of a servo, in the order in which they are returned."""

SLOW_UNIT = 0x04
"""Bit of the phase register (STS, SMS) that is set if speeds are in steps per second."""
REVERSE = 0x81
"""Bits of the phase register that reverse the direction of rotation."""


@dataclass(frozen=True, slots=True)
class Family:
    """Common properties of the servos of a family.

    Attributes:
        name: Its name in hand.yaml.
        order: Byte order of words.
        counts: Number of positions in the range.
        span: Angle of the range [rad].
        center: Position in the middle of the range.
        lock: The register that prevents settings from being stored.
        offset: Register of the position offset; ``None``: there is none.
        state: Number of bytes of the state, from the present position on.
        sync_read: Whether the servos answer a sync read.
        torque_time: Time of the overload protection per count of its register [s].
        protection: Registers of protective torque, protection time and overload torque; ``None``:
            there is no overload protection.
    """

    name: FamilyName
    order: Literal["big", "little"]
    counts: int
    span: float
    center: int
    lock: Register
    offset: Register | None
    state: int
    sync_read: bool
    torque_time: float = 0.01
    protection: tuple[Register, Register, Register] | None = (
        Register(34, 1),
        Register(35, 1),
        Register(36, 1),
    )

    @property
    def rad_per_count(self) -> float:
        """Angle per position count [rad]."""
        return self.span / self.counts

    @property
    def has_current(self) -> bool:
        """Whether the state includes the current."""
        return self.state > PRESENT_CURRENT.address - PRESENT_POSITION.address

    @property
    def limits_torque(self) -> Literal["", "share", "current"]:
        """How torque is limited in operation: not at all, by a share of it, or by a current."""
        if self.name == "hls":
            return "current"
        return "" if self.name == "scs" else "share"

    def pack(self, register: Register, value: int) -> bytes:
        """Convert a value to the bytes of its register."""
        if value < 0 and register.sign is not None:
            value = 1 << register.sign | -value
        return int(value).to_bytes(register.size, self.order)

    def unpack(self, register: Register, data: bytes | bytearray, start: int = 0) -> int:
        """Return the value of a register in ``data``, which begins at the address ``start``."""
        at = register.address - start
        value = int.from_bytes(data[at : at + register.size], self.order)
        sign = 0 if register.sign is None else 1 << register.sign
        return sign - value if value & sign else value

    def measured(self, data: bytes) -> list[int]:
        """Return the `MEASURED` values in the `state` bytes from the position on.

        Load in 0.1 % of the supply, current in 6.5 mA, voltage in 0.1 V; 0 for missing values.
        """
        return [self.unpack(register, data, PRESENT_POSITION.address) for register in MEASURED]

    def speed_unit(self, phase: int) -> float:
        """Return the speed per speed count [rad/s], given the phase register."""
        if self.name == "hls" or (self.name in ("sts", "sms") and not phase & SLOW_UNIT):
            return 0.732 * _RPM
        return self.rad_per_count


_TURN = 2.0 * math.pi

FAMILIES: Final[dict[FamilyName, Family]] = {
    "scs": Family(
        "scs", "big", 1024, math.radians(300.0), 511, Register(48, 1), None, 11, False,
        torque_time=0.04, protection=(Register(37, 1), Register(38, 1), Register(39, 1)),
    ),
    "sts": Family(
        "sts", "little", 4096, _TURN, 2048, Register(55, 1), Register(31, 2, 11), 15, True
    ),
    "sms": Family(
        "sms", "little", 4096, _TURN, 2048, Register(55, 1), Register(31, 2, 11), 15, True
    ),
    "hls": Family(
        "hls", "little", 4096, _TURN, 2048, Register(55, 1), Register(31, 2, 15), 15, True,
        protection=None,
    ),
}  # fmt: skip
"""The families by name."""


@dataclass(frozen=True, slots=True)
class Model:
    """A known model.

    Attributes:
        stall_torque: Largest torque at its rated voltage [N·m]; ``NaN``: several variants share the
            model number.
    """

    name: str
    family: FamilyName
    stall_torque: float = math.nan


MODELS: Final[dict[int, Model]] = {
    # 2.3 kg·cm at 6 V
    1284: Model("SCS0009", "scs", 0.23),
    777: Model("STS3215", "sts"),
    2825: Model("STS3250", "sts"),
    11272: Model("SM8512BL", "sms"),
    4106: Model("HLS3930", "hls"),
    6922: Model("HLS3915", "hls"),
    5130: Model("HLS3915", "hls"),
}
"""Models by number, read in the byte order of their family."""


def model_name(number: int | None) -> str:
    """Return the name of the model with a number."""
    if number is None:
        return "unknown"
    return MODELS[number].name if number in MODELS else f"model {number}"
