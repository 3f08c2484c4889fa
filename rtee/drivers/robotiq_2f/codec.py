"""Registers and units of Robotiq's two-finger grippers; no I/O.

Sources: the grippers' instruction manuals (register map, bits, fault codes, example frames) and,
for speeds and end counts, published drivers. Every two bytes make a register, the first in its high
half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Self

from rtee.drivers.robotiq_common import COUNTS, Fault, Progress, RobotiqCommand, RobotiqStatus
from rtee.drivers.scale import LinearScale
from rtee.errors import FrameError

COUNT = 3
"""Registers in use of either block; the gripper leaves the rest 0."""

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
class Model:
    """The differences between the models.

    Attributes:
        stroke: Distance of the fingertips when open [m].
        speed: Slowest and fastest closing, of one fingertip relative to the other [m/s].
        force: Weakest and strongest grip [N].
        gap: Silence that its coupling needs between frames [s]; ``None``: the line's default.
    """

    name: str
    stroke: float
    speed: tuple[float, float]
    force: tuple[float, float]
    gap: float | None = None


MODELS: dict[str, Model] = {
    "2f_85": Model("2F-85", 0.085, (0.020, 0.150), (20.0, 235.0)),
    "2f_140": Model("2F-140", 0.140, (0.030, 0.250), (10.0, 125.0)),
    "hand_e": Model("Hand-E", 0.050, (0.020, 0.150), (20.0, 130.0)),
    "hand_e_c10": Model("Hand-E C10", 0.050, (0.020, 0.150), (20.0, 185.0), gap=0.010),
}
"""The models by the name in the options.

The manual gives the Hand-E's strongest grip, 130 N, but not its weakest: that of the 2F-85 is
assumed. The forces of the C10 are those of newer texts of the vendor.
"""


@dataclass(frozen=True, slots=True)
class Command(RobotiqCommand):
    """The output block, written by the host.

    Attributes:
        direction: rARD, the direction of the automatic release.
        position: rPR, 0 open to 255 closed.
        speed: rSP, 0 slowest (not stopped) to 255.
        force: rFR, 0 weakest (not none) to 255.
    """

    direction: bool = False
    position: int = 0
    speed: int = 0
    force: int = 0

    def to_registers(self) -> tuple[int, int, int]:
        """Return the three registers."""
        action = self.activate | self.go << 3 | self.release << 4 | self.direction << 5
        return action << 8, self.position, self.speed << 8 | self.force

    @classmethod
    def from_registers(cls, registers: Sequence[int]) -> Self:
        """Read it from three registers."""
        action = registers[0] >> 8
        return cls(
            activate=bool(action & 0x01),
            go=bool(action & 0x08),
            release=bool(action & 0x10),
            direction=bool(action & 0x20),
            position=registers[1] & 0xFF,
            speed=registers[2] >> 8,
            force=registers[2] & 0xFF,
        )


@dataclass(frozen=True, slots=True)
class Status(RobotiqStatus):
    """The input block, written by the gripper.

    Attributes:
        grasp: gOBJ.
        controller_fault: kFLT, of the optional controller.
        requested: gPR, echo of the accepted position.
        position: gPO, measured.
        raw_current: gCU.
    """

    grasp: Grasp = Grasp.MOVING
    controller_fault: int = 0
    requested: int = 0
    position: int = 0
    raw_current: int = 0

    @property
    def current(self) -> float:
        """Motor current [A]."""
        return self.raw_current * _CURRENT

    def to_registers(self) -> tuple[int, int, int]:
        """Return the three registers."""
        state = self.activated | self.going << 3 | self.progress << 4 | self.grasp << 6
        faults = self.fault | self.controller_fault << 4
        return state << 8, faults << 8 | self.requested, self.position << 8 | self.raw_current

    @classmethod
    def from_registers(cls, registers: Sequence[int], bus: str = "") -> Self:
        """Read it from three registers; raises `FrameError` for bits that are always clear."""
        state = registers[0] >> 8
        if registers[0] & 0xFF or state & 0x06:
            raw = b"".join(r.to_bytes(2, "big") for r in registers)
            raise FrameError(bus, f"no status of a 2-finger gripper: {raw.hex(' ')}", raw)
        return cls(
            activated=bool(state & 0x01),
            going=bool(state & 0x08),
            progress=Progress(state >> 4 & 3),
            grasp=Grasp(state >> 6 & 3),
            fault=registers[1] >> 8 & 0x0F,
            controller_fault=registers[1] >> 12,
            requested=registers[1] & 0xFF,
            position=registers[2] >> 8,
            raw_current=registers[2] & 0xFF,
        )


class Scale:
    """Converts between counts and the actuator's units.

    Position is linear in the counts between the fully open and the fully closed gripper. Speed and
    force are those of the fingertips; at the actuator they follow from the virtual work of the
    linear width, so that force times change of width is effort times change of position.

    Args:
        model: The gripper.
        opened: Position of the actuator when fully open [rad | m].
        closed: Position of the actuator when fully closed [rad | m].

    Attributes:
        open_count: gPO when fully open.
        closed_count: gPO when fully closed.
        position: gPO or rPR to [rad | m].
        velocity: rSP to [rad/s | m/s].
        effort: rFR to [N·m | N].
    """

    def __init__(
        self,
        model: Model,
        opened: float,
        closed: float,
        open_count: int = 3,
        closed_count: int = 230,
    ) -> None:
        self.open_count, self.closed_count = open_count, closed_count
        self.position = LinearScale((open_count, closed_count), (opened, closed), ends=COUNTS)
        width = model.stroke / abs(closed - opened)  # [m/rad | 1]
        (slow, fast), (weak, strong) = model.speed, model.force
        self.velocity = LinearScale(COUNTS, (slow / width, fast / width))
        self.effort = LinearScale(COUNTS, (weak * width, strong * width))
