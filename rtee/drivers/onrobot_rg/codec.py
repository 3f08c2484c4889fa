"""Registers, units and linkage of OnRobot's RG2 and RG6; no I/O.

Sources: published drivers and the vendor's ROS 2 packages, which agree on addresses, control codes
and status bits; the linkage is that of the vendor's model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from rtee.drivers.onrobot_common import TENTH_MM
from rtee.drivers.registers import RegisterField, Registers, at, each, flag
from rtee.drivers.scale import LinearScale

OFFSET = 0x0102
"""Fingertip offset, signed [0.1 mm]."""

STATE = 0x010B
"""Width without the fingertips' offset [0.1 mm]; the status is in the next register."""

TIPS_WIDTH = 0x0113
"""Width with the fingertips' offset [0.1 mm]."""

SET_OFFSET = 0x0407
"""Sets the fingertip offset [0.1 mm]."""

_TENTH_NEWTON = 0.1  # unit of the force register [N]


class Control(IntEnum):
    """Values of register 2, the command."""

    NONE = 0
    GRIP = 1
    """Grip to a width without the fingertips' offset."""
    STOP = 8
    GRIP_WITH_OFFSET = 16
    """Grip to a width between the fingertips' surfaces."""


@dataclass(frozen=True, slots=True)
class Model:
    """The differences between the models.

    Attributes:
        stroke: Largest width without fingertips [m].
        force: Largest force [N].
        link: Length of a finger's links, from pivot to pivot [m].
        rise: Offset of the outer pivot from the axis of the link's frame [m].
        gap: Width between the faces of the outer links' carriers with upright links [m].
        speed: Largest speed of the links [rad/s].
    """

    name: str
    stroke: float
    force: float
    link: float
    rise: float
    gap: float
    speed: float

    @property
    def phase(self) -> float:
        """Angle of the joint at which the links are upright [rad]."""
        return math.asin(self.rise / self.link)

    def width(self, angle: float) -> float:
        """Return the width without fingertips [m] at a joint angle [rad]; positive angles open."""
        return 2.0 * self.link * math.sin(angle - self.phase) + self.gap

    def angle(self, width: float) -> float:
        """Return the joint angle [rad] at a width without fingertips [m]."""
        sine = (width - self.gap) / (2.0 * self.link)
        # A reading beyond the links must not leave the range of the arc sine.
        return self.phase + math.asin(min(max(sine, -1.0), 1.0))

    def lever(self, angle: float) -> float:
        """Return the change of the width with the joint's angle [m/rad]."""
        return 2.0 * self.link * math.cos(angle - self.phase)


FINGERTIP = 0.0049
"""Thickness of the fingertips from the factory [m]; a published driver's default for the RG2."""

MODELS: dict[str, Model] = {
    "rg2": Model("RG2", 0.110, 40.0, 0.055, 0.0025, 2 * FINGERTIP - 0.0039, math.radians(67.35)),
    "rg6": Model("RG6", 0.160, 120.0, 0.080, 0.0042, 2 * FINGERTIP - 0.0016, math.radians(48.65)),
}
"""The models by the name in the options.

The vendor's model gives gaps of -3.9 and -1.6 mm, with which neither gripper could open to its
stroke: its links would have to be longer. So the gaps are assumed to be measured between fingertips
of `FINGERTIP`; without fingertips both models then open to their stroke at about 1.3 rad.
"""


class Command(Registers):
    """A command: registers 0 to 2, best written in one frame.

    Attributes:
        force: Target force [0.1 N].
        width: Target width [0.1 mm].
        control: The kind of command.
    """

    WHAT = "command of an RG"

    force: int = at(0)
    width: int = at(1)
    control: Control = at(2, kind=Control)


class Status(Registers):
    """The gripper's state: registers 010B and 010C.

    Attributes:
        width: Width without the fingertips' offset [0.1 mm].
        busy: Whether it moves or builds up force, and ignores all commands but *stop*.
        grip_detected: Whether it holds something, from outside or from inside.
        pushed: Whether safety switches 1 and 2 are pushed.
        triggered: Whether they were pushed during a motion.
        safety_error: Whether one of them was pushed at power-up.
    """

    WHAT = "status of an RG"
    STRICT = True

    width: int = at(0, signed=True)
    busy: bool = flag(1, 0)
    grip_detected: bool = flag(1, 1)
    pushed: tuple[bool, bool] = each(None, *([RegisterField(1, bit, 1, bool)] for bit in (2, 4)))
    triggered: tuple[bool, bool] = each(None, *([RegisterField(1, bit, 1, bool)] for bit in (3, 5)))
    safety_error: bool = flag(1, 6)


class LinkageScale:
    """Converts between registers and the actuator's units.

    The position of the actuator is the angle of a finger's links, as in `Model.angle`. The gripper
    controls the force at the fingertips, at any width; so effort is proportional to force, with the
    factor from the virtual work over the whole stroke.

    Args:
        model: The gripper.
        lower: Lower limit of the actuator, where the fingertips meet [rad].
        upper: Its upper limit, open [rad].

    Attributes:
        effort: Scale between the force [0.1 N] and the effort [N·m].
    """

    def __init__(self, model: Model, lower: float, upper: float) -> None:
        self._model = model
        # Virtual work: effort times the change of the angle is force times that of the width.
        most = model.force * (model.width(upper) - model.width(lower)) / (upper - lower)
        self.effort = LinearScale((0.0, model.force / _TENTH_NEWTON), (0.0, most))

    def position(self, width: int) -> float:
        """Return the actuator's position [rad] at a width [0.1 mm]."""
        return self._model.angle(width * TENTH_MM)

    def width(self, position: float) -> int:
        """Return the width [0.1 mm] at a position [rad], within the stroke."""
        width = self._model.width(position)
        return round(min(max(width, 0.0), self._model.stroke) / TENTH_MM)
