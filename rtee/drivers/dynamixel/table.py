"""The control table of X-series servos, and the known models."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

PULSES = 4096
"""Positions per turn."""
CENTER = 2048  # [pulse]; the middle of a turn
RAD_PER_PULSE = 2.0 * math.pi / PULSES  # [rad]
VELOCITY_UNIT = 0.229 * 2.0 * math.pi / 60.0
"""Speed per count [rad/s]: 0.229 rpm."""
WATCHDOG_UNIT = 0.02
"""Time per count of the bus watchdog [s], as in the e-manual."""
MOST_GAIN = 16383
"""Largest gain of the position controllers (addresses 80 to 84)."""
END = 228
"""First address after the table."""

RAM = 64
"""First address of the RAM area; the addresses below are EEPROM."""


@dataclass(frozen=True, slots=True)
class Register:
    """A value in the control table.

    Attributes:
        address: Its first byte.
        size: Its bytes.
        default: Its value after power-up (RAM) or reset (EEPROM).
        signed: Whether it is two's complement.
        writable: Whether it can be written.
        minimum: Smallest accepted value, if limited.
        maximum: Largest accepted value, if limited.
    """

    address: int
    size: int
    default: int = 0
    signed: bool = False
    writable: bool = True
    minimum: int | None = None
    maximum: int | None = None

    @property
    def eeprom(self) -> bool:
        """Whether it keeps its value without power and can be written only with the torque off."""
        return self.address < RAM

    def pack(self, value: int) -> bytes:
        """Convert a value to bytes."""
        return int(value).to_bytes(self.size, "little", signed=value < 0)

    def unpack(self, raw: bytes) -> int:
        """Convert bytes to the value."""
        return int.from_bytes(raw[: self.size], "little", signed=self.signed)


# Addresses, sizes, defaults and ranges as in the e-manual of the XL330-M288.
MODEL = Register(0, 2, 1200, writable=False)
MODEL_INFORMATION = Register(2, 4, writable=False)
FIRMWARE = Register(6, 1, 48, writable=False)
ID = Register(7, 1, 1, minimum=0, maximum=252)
BAUD_RATE = Register(8, 1, 1, minimum=0, maximum=6)
RETURN_DELAY = Register(9, 1, 250, minimum=0, maximum=254)
DRIVE_MODE = Register(10, 1, 0, minimum=0, maximum=13)
OPERATING_MODE = Register(11, 1, 3, minimum=0, maximum=16)
SHADOW_ID = Register(12, 1, 255)
PROTOCOL = Register(13, 1, 2, minimum=1, maximum=22)
HOMING_OFFSET = Register(20, 4, 0, signed=True, minimum=-1_044_479, maximum=1_044_479)
MOVING_THRESHOLD = Register(24, 4, 10, minimum=0, maximum=1023)
TEMPERATURE_LIMIT = Register(31, 1, 70, minimum=0, maximum=100)
MAX_VOLTAGE = Register(32, 2, 70, minimum=31, maximum=70)
MIN_VOLTAGE = Register(34, 2, 35, minimum=31, maximum=70)
PWM_LIMIT = Register(36, 2, 885, minimum=0, maximum=885)
CURRENT_LIMIT = Register(38, 2, 1750, minimum=0, maximum=1750)
VELOCITY_LIMIT = Register(44, 4, 445, minimum=0, maximum=2047)
MAX_POSITION = Register(48, 4, 4095, minimum=0, maximum=4095)
MIN_POSITION = Register(52, 4, 0, minimum=0, maximum=4095)
STARTUP = Register(60, 1, 0)
PWM_SLOPE = Register(62, 1, 140, minimum=1, maximum=255)
SHUTDOWN = Register(63, 1, 0x35)
TORQUE = Register(64, 1, 0, minimum=0, maximum=1)
LED = Register(65, 1, 0, minimum=0, maximum=1)
STATUS_RETURN_LEVEL = Register(68, 1, 2, minimum=0, maximum=2)
REGISTERED = Register(69, 1, writable=False)
HARDWARE_ERROR = Register(70, 1, writable=False)
VELOCITY_I = Register(76, 2, 1600, minimum=0, maximum=16383)
VELOCITY_P = Register(78, 2, 180, minimum=0, maximum=16383)
POSITION_D = Register(80, 2, 0, minimum=0, maximum=16383)
POSITION_I = Register(82, 2, 0, minimum=0, maximum=16383)
POSITION_P = Register(84, 2, 400, minimum=0, maximum=16383)
FEEDFORWARD_2 = Register(88, 2, 0, minimum=0, maximum=16383)
FEEDFORWARD_1 = Register(90, 2, 0, minimum=0, maximum=16383)
BUS_WATCHDOG = Register(98, 1, 0, signed=True, minimum=0, maximum=127)
GOAL_PWM = Register(100, 2, 885, signed=True)
GOAL_CURRENT = Register(102, 2, 1750, signed=True)
GOAL_VELOCITY = Register(104, 4, 445, signed=True)
PROFILE_ACCELERATION = Register(108, 4, 0, minimum=0, maximum=32767)
PROFILE_VELOCITY = Register(112, 4, 0, minimum=0, maximum=32767)
GOAL_POSITION = Register(116, 4, 0, signed=True)
REALTIME_TICK = Register(120, 2, writable=False)
MOVING = Register(122, 1, writable=False)
MOVING_STATUS = Register(123, 1, writable=False)
PRESENT_PWM = Register(124, 2, signed=True, writable=False)
PRESENT_CURRENT = Register(126, 2, signed=True, writable=False)
PRESENT_VELOCITY = Register(128, 4, signed=True, writable=False)
PRESENT_POSITION = Register(132, 4, signed=True, writable=False)
PRESENT_VOLTAGE = Register(144, 2, 50, writable=False)
PRESENT_TEMPERATURE = Register(146, 1, 25, writable=False)
BACKUP_READY = Register(147, 1, writable=False)

REGISTERS: tuple[Register, ...] = tuple(
    value for value in list(globals().values()) if isinstance(value, Register)
)
INDIRECT = range(168, 208, 2)
"""Locations of the twenty indirect addresses."""
INDIRECT_DATA = range(208, 228)
"""Locations of the indirect data; by default each indirect address points to its own byte here."""
POINTABLE = range(64, END)
"""Addresses to which indirect addresses may point."""

STATE = PRESENT_CURRENT.address
"""First address of current, velocity and position, which are adjacent."""
STATE_SIZE = 10  # bytes of these
HEALTH = PRESENT_VOLTAGE.address
"""First address of voltage and temperature, which are adjacent."""
HEALTH_SIZE = 3  # bytes of these

BAUD_RATES: tuple[int, ...] = (
    9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000,
)  # fmt: skip
"""Baud rate of each value of the register."""


class Mode(IntEnum):
    """Operating modes."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


REVERSE = 0x01
"""Bit of the drive mode that reverses the direction of positions."""


@dataclass(frozen=True, slots=True)
class Model:
    """A servo model: its name and the units that differ between models.

    Attributes:
        current_unit: Current per count [A]; ``NaN`` if it measures load instead.
        torque_per_ampere: Stall torque per stall current at its recommended voltage [N·m/A]; a good
            approximation at standstill, too large in motion.
    """

    name: str
    current_unit: float
    torque_per_ampere: float


MODELS: dict[int, Model] = {
    1020: Model("XM430-W350", 0.00269, 4.1 / 2.3),
    1030: Model("XM430-W210", 0.00269, 3.0 / 2.3),
    1060: Model("XL430-W250", math.nan, math.nan),
    1070: Model("XC430-W150", math.nan, math.nan),
    1120: Model("XM540-W270", 0.00269, 10.6 / 4.4),
    1130: Model("XM540-W150", 0.00269, 7.3 / 4.4),
    1190: Model("XL330-M077", 0.001, 0.215 / 1.47),
    1200: Model("XL330-M288", 0.001, 0.52 / 1.47),
    1210: Model("XC330-T181", 0.001, 0.76 / 0.80),
    1220: Model("XC330-T288", 0.001, 0.92 / 0.80),
    1230: Model("XC330-M181", 0.001, 0.60 / 1.80),
    1240: Model("XC330-M288", 0.001, 0.93 / 1.80),
}
"""Models by model number."""


def model_of(number: int) -> Model:
    """Return a model by its number; the units of an unknown one are ``NaN``."""
    return MODELS.get(number, Model(f"model {number}", math.nan, math.nan))
