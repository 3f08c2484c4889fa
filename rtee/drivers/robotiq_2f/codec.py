"""Registers and units of Robotiq's two-finger grippers; no I/O.

Sources: the grippers' instruction manuals (register map, bits, fault codes, example frames) and,
for speeds and end counts, published drivers. Every two bytes make a register, the first in its high
half.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from rtee.drivers.registers import at, flag
from rtee.drivers.robotiq_common import COUNTS, Fault, RobotiqCommand, RobotiqStatus
from rtee.drivers.scale import FingerScale, LinearScale

_CURRENT = 0.01
"""Motor current per count of gCU [A]."""


class Grasp(IntEnum):
    """gOBJ: contact of the fingers; only meaningful while gGTO is set."""

    MOVING = 0
    CONTACT_OPENING = 1
    CONTACT_CLOSING = 2
    AT_REQUEST = 3


FAULTS: dict[int, Fault] = {
    0x05: Fault("the action waits for the activation", "wait", warning=True),
    0x07: Fault("not activated", "activate it: the fingers then close and open once"),
    0x08: Fault("over temperature", "let it cool down"),
    0x09: Fault("no communication for a second", warning=True),
    0x0A: Fault("supply below the minimum voltage", "check the 24 V supply", major=True),
    0x0B: Fault("automatic release under way", "wait until it ends, then recover", major=True),
    0x0C: Fault(
        "internal fault", "recover; if it comes back, the gripper needs service", major=True
    ),
    0x0D: Fault("activation failed", "free the fingers, then recover and activate", major=True),
    0x0E: Fault("overcurrent", "free the fingers, then recover", major=True),
    0x0F: Fault("automatic release completed", "recover and activate", major=True),
}
"""The fault codes."""


@dataclass(frozen=True, slots=True)
class Bars:
    """Parallel bars that carry a gripper's fingertips: the opening is not linear in the counts.

    Attributes:
        length: Their length [m].
        angle: Their angle to the normal of the closing direction when open [rad].
        offset: Distance of the tips when the bars are along that normal [m].
        closed: How far they have turned when closed [rad].
    """

    length: float
    angle: float
    offset: float
    closed: float

    def closure(self, width: float) -> float:
        """Return the share of the travel at which the tips are this far apart [m], or ``inf``."""
        sine = (width - self.offset) / (2.0 * self.length)
        return (self.angle - math.asin(sine)) / self.closed if abs(sine) <= 1.0 else math.inf


@dataclass(frozen=True, slots=True)
class Model:
    """The differences between the models.

    Attributes:
        stroke: Distance of the fingertips when open [m].
        speed: Slowest and fastest closing, of one fingertip relative to the other [m/s].
        force: Weakest and strongest grip [N].
        gap: Silence that its coupling needs between frames [s]; ``None``: the line's default.
        bars: The bars on which its fingertips move; ``None``: they move on rails.
    """

    name: str
    stroke: float
    speed: tuple[float, float]
    force: tuple[float, float]
    gap: float | None = None
    bars: Bars | None = None

    def closure(self, width: float) -> float:
        """Return the share of the travel at which the tips have a distance [m]."""
        return 1.0 - width / self.stroke if self.bars is None else self.bars.closure(width)

    def scale(
        self, opened: float, closed: float, open_count: int = 3, closed_count: int = 230
    ) -> FingerScale:
        """Return the scale, by which position (gPO and rPR), speed and force are linear in counts.

        Args:
            opened: Position of the actuator when fully open [rad | m].
            closed: Position of the actuator when fully closed [rad | m].
            open_count: gPO when fully open.
            closed_count: gPO when fully closed.
        """
        position = LinearScale((open_count, closed_count), (opened, closed), ends=COUNTS)
        lever = self.stroke / abs(closed - opened)
        return FingerScale(position, lever, COUNTS, self.force, self.speed)


MODELS: dict[str, Model] = {
    "2f_85": Model(
        "2F-85", 0.085, (0.020, 0.150), (20.0, 235.0), bars=Bars(0.05711, 0.7181, 0.01085, 0.82)
    ),
    "2f_140": Model(
        "2F-140", 0.140, (0.030, 0.250), (10.0, 125.0), bars=Bars(0.09999, 0.7027, -0.00071, 0.7)
    ),
    "hand_e": Model("Hand-E", 0.050, (0.020, 0.150), (20.0, 130.0)),
    "hand_e_c10": Model("Hand-E C10", 0.050, (0.020, 0.150), (20.0, 185.0), gap=0.010),
}
"""The models by the name in the options.

The bars are those of the vendor's models, within 0.04 mm. The manual gives the Hand-E's strongest
grip, 130 N, but not its weakest: that of the 2F-85 is assumed. The forces of the C10 are those of
newer texts of the vendor.
"""


class Command(RobotiqCommand):
    """The output block, written by the host.

    Attributes:
        direction: rARD, the direction of the automatic release.
        position: rPR, 0 open to 255 closed.
        speed: rSP, 0 slowest (not stopped) to 255.
        force: rFR, 0 weakest (not none) to 255.
    """

    direction: bool = flag(0, 13)
    position: int = at(1, 0, 8)
    speed: int = at(2, 8, 8)
    force: int = at(2, 0, 8)


class Status(RobotiqStatus):
    """The input block, written by the gripper.

    Attributes:
        grasp: gOBJ.
        controller_fault: kFLT, of the optional controller.
        requested: gPR, echo of the accepted position.
        position: gPO, measured.
        raw_current: gCU.
    """

    WHAT = "status of a 2-finger gripper"
    STRICT = True

    grasp: Grasp = at(0, 14, 2, Grasp)
    controller_fault: int = at(1, 12, 4)
    requested: int = at(1, 0, 8)
    position: int = at(2, 8, 8)
    raw_current: int = at(2, 0, 8)

    @property
    def current(self) -> float:
        """Motor current [A]."""
        return self.raw_current * _CURRENT
