"""Registers and units of OnRobot's three-finger grippers; no I/O.

Sources: register tables published with third-party drivers, four of which agree on addresses,
control codes and status bits; the vendor prints no example frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from rtee.drivers.onrobot_common import TENTH_MM
from rtee.drivers.registers import Registers, at, flag
from rtee.drivers.scale import FingerScale, LinearScale

STATE = 0x0100
"""First of the registers that report the state."""

GEOMETRY = 0x010E
"""First of four registers: finger length, an unnamed one, finger position, fingertip offset."""

LIMITS = 0x0201
"""First of two registers: smallest and largest raw diameter."""

_HUNDREDTH_MM = 1e-5  # unit of the registers of offsets [m]


class Control(IntEnum):
    """Values of register 3, the command."""

    NONE = 0
    GRIP = 1
    MOVE = 2
    STOP = 4
    FLEXIBLE_GRIP = 5


class GripType(IntEnum):
    """Register 2: the kind of grip, from outside or from inside."""

    EXTERNAL = 0
    INTERNAL = 1

    @property
    def sign(self) -> int:
        """-1 if the fingertips' surfaces are closer together than their centres, otherwise +1."""
        return -1 if self is GripType.EXTERNAL else 1


class Command(Registers):
    """A command of the host: registers 0 to 3, best written in one frame.

    Attributes:
        force: Part of the largest force, 0 to 1000 [0.1 %].
        diameter: Target diameter [0.1 mm].
        grip_type: From outside or from inside.
        control: The kind of command.
    """

    WHAT = "command of a 3FG"

    force: int = at(0)
    diameter: int = at(1)
    grip_type: GripType = at(2, kind=GripType)
    control: Control = at(3, kind=Control)


class Status(Registers):
    """The gripper's state: registers 0100 to 0103.

    Attributes:
        busy: Whether it moves or builds up force.
        grip_detected: Whether it has met an object.
        force_grip: Whether it holds with the target force.
        calibrated: Whether its calibration is valid.
        raw_diameter: Diameter through the fingertips' centres [0.1 mm].
        diameter: Diameter with the fingertips' offset, signed [0.1 mm].
        force: Force applied [0.1 %].
    """

    WHAT = "status of a 3FG"
    STRICT = True

    busy: bool = flag(0, 0)
    grip_detected: bool = flag(0, 1)
    force_grip: bool = flag(0, 2)
    calibrated: bool = flag(0, 3)
    raw_diameter: int = at(1)
    # The only signed register: an internal grip's offset may exceed the raw diameter.
    diameter: int = at(2, signed=True)
    force: int = at(3)


@dataclass(frozen=True, slots=True)
class Fingers:
    """Mounting of the fingers; converts the angle of their pivots to the diameter between the tips.

    Each finger is a lever on a pivot at 37 mm from the axis; the formula comes from a published
    simulator of the larger model, not from the vendor.

    Attributes:
        length: Length of a finger [m].
        position: Mounting hole, 1 to 3.
        offset: Distance from a fingertip's centre to its surface [m].
    """

    length: float = 0.049
    position: int = 2
    offset: float = 0.0063

    @property
    def lever(self) -> float:
        """Length of the lever from pivot to fingertip's centre [m]."""
        return self.length + {1: -0.018, 2: -0.006, 3: 0.006}[self.position]

    def raw_diameter(self, angle: float) -> float:
        """Return the diameter through the fingertips' centres [m] for a pivot's angle [rad]."""
        return 2.0 * math.sqrt(
            _PIVOT**2 + self.lever**2 + 2.0 * _PIVOT * self.lever * math.cos(angle)
        )

    def angle(self, raw_diameter: float) -> float:
        """Return the angle of the pivots for a raw diameter [rad], within the levers' reach."""
        radius = raw_diameter / 2.0
        cosine = (radius**2 - _PIVOT**2 - self.lever**2) / (2.0 * _PIVOT * self.lever)
        # Rounding, or a diameter beyond the levers, must not leave the range of the arc cosine.
        return math.acos(min(max(cosine, -1.0), 1.0))

    def leverage(self, raw_diameter: float) -> float:
        """Return the share of the largest force that the fingers exert at a raw diameter.

        The manual plots the total force over the angle of the fingers: the lower the angle, the
        greater the force, and an external grip begins at 30°. It gives no numbers; this assumes
        the virtual work of a motor of constant torque on the lever, which behaves like that.
        """
        angle = max(self.angle(raw_diameter), _LOWEST)
        return min(1.0, self._radius_slope(_LOWEST) / max(self._radius_slope(angle), 1e-9))

    def _radius_slope(self, angle: float) -> float:
        """Return the decrease of the radius per angle of the pivots [m/rad]."""
        radius = self.raw_diameter(angle) / 2.0
        return _PIVOT * self.lever * math.sin(angle) / max(radius, 1e-9)

    def diameter(self, raw_diameter: float, grip_type: GripType) -> float:
        """Return the diameter of the space between (or around) the fingertips [m]."""
        return raw_diameter + grip_type.sign * 2.0 * self.offset


_PIVOT = 0.037  # radius of the fingers' pivots [m], from published geometry; no manual gives it

_LOWEST = math.radians(30.0)
"""Lowest angle of the fingers in an external grip; the manual's range is 30° to 165°."""


def scale_of(
    lower: float,
    upper: float,
    largest: float = 0.150,
    smallest: float = 0.0346,
    force: float = 240.0,
) -> FingerScale:
    """Return the scales of position (raw diameter [0.1 mm] to [rad]) and effort (from [0.1 %]).

    The actuator's position is linear in the raw diameter.

    Args:
        lower: Position of the actuator at the largest diameter [rad].
        upper: Position of the actuator at the smallest diameter [rad].
        largest: Largest raw diameter [m].
        smallest: Smallest raw diameter [m].
        force: Largest force [N].
    """
    position = LinearScale((largest / TENTH_MM, smallest / TENTH_MM), (lower, upper))
    return FingerScale(
        position, (largest - smallest) / (upper - lower), (0.0, 1000.0), (0.0, force)
    )


def offset_metres(hundredth_mm: int) -> float:
    """Convert the value of the fingertip offset's register [0.01 mm] to metres."""
    return hundredth_mm * _HUNDREDTH_MM
