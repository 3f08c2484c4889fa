"""CiA 402: states, controlwords, modes, objects, process data and units. No I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, IntEnum, IntFlag
from typing import ClassVar

from rtee.drivers.packed import Packed, part

DEVICE_TYPE = 402  # the low word of object 1000h


class Object(IntEnum):
    """Objects by index."""

    DEVICE_TYPE = 0x1000
    ERROR_REGISTER = 0x1001
    DEVICE_NAME = 0x1008
    CONSUMER_HEARTBEAT = 0x1016
    PRODUCER_HEARTBEAT = 0x1017
    IDENTITY = 0x1018
    ABORT_CONNECTION = 0x6007
    ERROR_CODE = 0x603F
    CONTROLWORD = 0x6040
    STATUSWORD = 0x6041
    MODE = 0x6060
    MODE_DISPLAY = 0x6061
    POSITION = 0x6064
    VELOCITY = 0x606C
    MAX_TORQUE = 0x6072
    RATED_CURRENT = 0x6075
    RATED_TORQUE = 0x6076
    TORQUE = 0x6077
    CURRENT = 0x6078
    TARGET_POSITION = 0x607A
    PROFILE_VELOCITY = 0x6081
    PROFILE_ACCELERATION = 0x6083
    PROFILE_DECELERATION = 0x6084
    ENCODER_RESOLUTION = 0x608F
    GEAR_RATIO = 0x6091
    FEED_CONSTANT = 0x6092
    HOMING_METHOD = 0x6098
    HOMING_SPEEDS = 0x6099
    HOMING_ACCELERATION = 0x609A
    INTERPOLATION_TIME = 0x60C2
    SUPPORTED_MODES = 0x6502


class Mode(IntEnum):
    """Modes of operation."""

    PROFILE_POSITION = 1
    HOMING = 6
    CYCLIC_POSITION = 8

    @property
    def bit(self) -> int:
        """Bit of the mode in the supported modes."""
        return 1 << (self - 1)


class State(Enum):
    """States of a drive, each with the mask and the value of its statusword."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    ENABLED = (0x6F, 0x27)
    QUICK_STOP = (0x6F, 0x07)
    FAULT_REACTION = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @classmethod
    def of(cls, statusword: int) -> State:
        """Return the state in a statusword; an invalid one counts as not ready."""
        for state in cls:
            mask, value = state.value
            # Each state has its own mask, as some bits do not matter in some states.
            if statusword & mask == value:
                return state
        return cls.NOT_READY


class StatusBit(IntFlag):
    """Bits of the statusword besides the state."""

    VOLTAGE = 1 << 4
    WARNING = 1 << 7
    REMOTE = 1 << 9
    REACHED = 1 << 10
    LIMIT = 1 << 11
    ACKNOWLEDGED = 1 << 12
    FOLLOWING_ERROR = 1 << 13
    HOMING_ERROR = 1 << 13


class Control(IntEnum):
    """Controlwords that change the state."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE = 0x0F
    FAULT_RESET = 0x80


# Further bits of the controlword; 4 to 6 depend on the mode of operation (CiA 402-2).
NEW_SET_POINT = 0x10
CHANGE_NOW = 0x20
RELATIVE = 0x40
HALT = 0x100
HOMING_START = 0x10


def next_control(state: State) -> Control | None:
    """Return the controlword for the next transition towards the enabled state.

    ``None``: the drive is enabled, in fault (whose reset is a separate decision), or in transition.
    """
    return {
        State.SWITCH_ON_DISABLED: Control.SHUTDOWN,
        State.READY: Control.SWITCH_ON,
        State.SWITCHED_ON: Control.ENABLE,
        # Back to the first state, since not every drive can continue from a quick stop.
        State.QUICK_STOP: Control.DISABLE_VOLTAGE,
    }.get(state)


class Pdo(Packed):
    """Base class of the four PDOs, whose fields are the mapped objects in their order.

    Attributes:
        MAP: The mapped objects as index, subindex and bits, as in objects 1600h and 1A00h.
    """

    WHAT = "the data of a PDO"
    MAP: ClassVar[tuple[int, ...]]


class Command(Pdo):
    """The first receive PDO: controlword, target position, mode."""

    MAP = (0x6040_0010, 0x607A_0020, 0x6060_0008)

    controlword: int = part("H")
    target: int = part("i")
    mode: int = part("b")


class Limits(Pdo):
    """The second receive PDO: maximal torque [0.1 %] and profile velocity [drive's unit]."""

    MAP = (0x6072_0010, 0x6081_0020)

    torque: int = part("H")
    velocity: int = part("I")


class Status(Pdo):
    """The first transmit PDO: statusword, position [counts], mode."""

    MAP = (0x6041_0010, 0x6064_0020, 0x6061_0008)

    statusword: int = part("H")
    position: int = part("i")
    mode: int = part("b")

    @property
    def state(self) -> State:
        """The drive's state."""
        return State.of(self.statusword)


class Motion(Pdo):
    """The second transmit PDO: velocity [drive's unit], torque [0.1 %], error code."""

    MAP = (0x606C_0020, 0x6077_0010, 0x603F_0010)

    velocity: int = part("i")
    torque: int = part("h")
    error: int = part("H")


@dataclass(frozen=True, slots=True)
class DriveScale:
    """The units of one drive.

    Attributes:
        counts: Signed counts per rad or m of the actuator.
        zero: The drive's position where the actuator is at 0 [counts].
        rated_torque: The motor's rated torque at the actuator [N·m | N]; ``NaN``: not known.
        velocity_unit: The drive's unit of velocity [counts/s].
    """

    counts: float
    zero: int = 0
    rated_torque: float = math.nan
    velocity_unit: float = 1.0

    def to_position(self, counts: int) -> float:
        """Return the actuator's position [rad | m]."""
        return (counts - self.zero) / self.counts

    def to_counts(self, position: float) -> int:
        """Return the drive's position [counts]."""
        return round(position * self.counts) + self.zero

    def to_velocity(self, raw: int) -> float:
        """Return the actuator's velocity [rad/s | m/s]."""
        return raw * self.velocity_unit / self.counts

    def to_velocity_limit(self, velocity: float) -> int:
        """Return a speed limit in the drive's unit, at least 1."""
        return max(1, round(abs(velocity * self.counts) / self.velocity_unit))

    def to_effort(self, permille: int) -> float:
        """Return the actuator's effort [N·m | N]."""
        return math.copysign(1.0, self.counts) * permille / 1000.0 * self.rated_torque

    def to_permille(self, effort: float) -> int:
        """Return a torque limit [0.1 % of the rated torque]."""
        return max(0, round(abs(effort) / self.rated_torque * 1000.0))


def counts_per_rad(increments: int, turns: int, motor: int, shaft: int) -> float:
    """Return counts per rad of the driven shaft, from objects 608F and 6091.

    Args:
        increments: Encoder increments.
        turns: Motor turns in which the encoder counts them.
        motor: Motor turns of the gear.
        shaft: Shaft turns of the gear.

    Raises:
        ValueError: unless all are positive.
    """
    if min(increments, turns, motor, shaft) <= 0:
        raise ValueError("encoder resolution and gear ratio must be positive")
    return increments / turns * motor / shaft / (2.0 * math.pi)
