"""Common parts of the emulated OnRobot grippers: the registers of the Compute Box, and time."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any, ClassVar

from rtee.buses.modbus_slave import ILLEGAL_ADDRESS, ILLEGAL_VALUE, Framing, ModbusEmulator, Refused
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Grasps
from rtee.drivers.onrobot_common import FIRMWARE, PRODUCT, SERIAL, SERIAL_COUNT
from rtee.drivers.options import Byte, Duration, Positive, Rate
from rtee.hand.validation import Section

_GATEWAY_NO_TARGET = 0x0B  # Modbus exception: the target device does not answer the gateway
_VERSION, _BUILD = 0x0105, 7  # firmware 1.5, build 7: chosen arbitrarily

Window = tuple[int, int]
"""First and last register of a block that can be read or written."""

IDENTITY: Window = (PRODUCT, SERIAL + SERIAL_COUNT - 1)
"""The registers of product code, firmware and serial number."""


class OnRobotProperties(Section, frozen=True):
    """Properties of an emulated gripper.

    Attributes:
        unit: Its number behind the Compute Box or on the line.
        framing: ``tcp`` or ``rtu``.
        baudrate: Bits per second.
        force_time: Time to build up the force after the contact [s].
        haste: Factor by which it moves faster than the real one.
    """

    unit: Byte = 65
    framing: Framing = "tcp"
    baudrate: Rate = 1_000_000
    force_time: Duration = 0.1
    haste: Positive = 1.0


class OnRobotEmulator(ModbusEmulator, Grasps):
    """An emulated gripper; its subclasses define the registers and the commands.

    Attributes:
        READABLE: Blocks that can be read.
        WRITABLE: Blocks that can be written.
        CONTROL: The commands, values of the last target register.
        NEAR: Distance below which a target counts as reached [units of the axis].
        axis: Its fingers.
        moves: Number of motions started.
    """

    FAULTS = ModbusEmulator.FAULTS | {"no_tool"}
    FUNCTIONS = frozenset({0x03, 0x06, 0x10, 0x17})
    EXCEPTIONS = True
    # Without a port, the driver reaches the Compute Box by its host, which is Modbus TCP.
    PORT = "tcp://"
    READABLE: ClassVar[Sequence[Window]]
    WRITABLE: ClassVar[Sequence[Window]]
    CONTROL: ClassVar[type[IntEnum]]
    NEAR: ClassVar[float]
    axis: Axis

    def __init__(self, properties: OnRobotProperties) -> None:
        made = self._made = properties
        super().__init__(made.unit, made.framing, baudrate=made.baudrate)
        # Also over TCP: behind a Compute Box the unit distinguishes the tools of a dual changer.
        self.any_unit = False
        self.moves = 0

    def power_cycle(self, now: float) -> None:
        """Stop, and forget targets and contact; the encoder is absolute and the gear holds."""
        self.line_reset()
        self._targets = self._idle_targets()
        self._busy = False
        self._contact = False
        self._building = 0.0
        self.halt()

    @abstractmethod
    def _idle_targets(self) -> list[int]:
        """Return the target registers after power-up."""

    @abstractmethod
    def registers(self) -> Mapping[int, int]:
        """Return the values of the registers."""

    @abstractmethod
    def _command(self, control: Any) -> None:
        """Carry out a command, with the targets that are set."""

    @property
    @abstractmethod
    def _can_grip(self) -> bool:
        """Whether the motion under way may end in a grip where it is blocked."""

    @abstractmethod
    def _effort(self, part: float) -> float:
        """Return the effort limit when a part of the force, 0 to 1, has built up."""

    def _set(self, address: int, values: Sequence[int]) -> None:
        """Set target registers, and carry out a command among them; raises `Refused`."""
        self._targets[address : address + len(values)] = values
        # Only a write that includes the control register starts anything, as on the device.
        if address + len(values) == len(self._targets):
            try:
                control = self.CONTROL(values[-1])
            except ValueError:
                raise Refused(ILLEGAL_VALUE) from None
            self._command(control)

    @property
    def _built_up(self) -> float:
        """The part of the force that has built up, 0 to 1."""
        return min(self._building / max(self._made.force_time, 1e-6), 1.0)

    def _advance_by(self, dt: float) -> None:
        """Let ``dt`` seconds pass; at an object, the force builds up."""
        self.axis.advance(dt)
        if not self._busy or self.axis.moving:
            return
        there = abs(self.axis.target - self.axis.position) < self.NEAR
        # A motor that is stuck has met no object, so no force builds up.
        if there or self.axis.stuck or not self._can_grip:
            self._busy = False
            return
        self._contact = True
        self._building += dt
        self.axis.max_effort = self._effort(self._built_up)
        self._busy = self._built_up < 1.0

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int]:
        """Return registers; raises `Refused` if the tool is missing."""
        self._reachable()
        return super().read(function, address, count, now)

    def windows(self, function: int) -> Mapping[int, Sequence[int]]:
        """Return the readable blocks; undocumented registers are 0."""
        known = self.registers()
        return {
            low: [known.get(register, 0) & 0xFFFF for register in range(low, high + 1)]
            for low, high in self.READABLE
        }

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        """Set targets or settings; writing the control register starts a command."""
        self._reachable()
        if not _within(self.WRITABLE, address, len(values)):
            raise Refused(ILLEGAL_ADDRESS)
        self.advance(now)
        self._set(address, values)

    def _reachable(self) -> None:
        if "no_tool" in self.faults:
            raise Refused(_GATEWAY_NO_TARGET)

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``."""
        dt = self._elapsed(now)
        if dt > 0.0:
            self._advance_by(dt * self._made.haste)


def identity(product: int, serial: str) -> dict[int, int]:
    """Return the registers of a product code and a serial number."""
    text = serial.encode("ascii").ljust(2 * SERIAL_COUNT, b"\0")
    known = {SERIAL + i: text[2 * i] << 8 | text[2 * i + 1] for i in range(SERIAL_COUNT)}
    return known | {PRODUCT: product, FIRMWARE: _VERSION, FIRMWARE + 1: _BUILD}


def _within(blocks: Sequence[Window], address: int, count: int) -> bool:
    return any(low <= address and address + count - 1 <= high for low, high in blocks)
