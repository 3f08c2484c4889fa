"""Common parts of the emulated OnRobot grippers: the registers of the Compute Box, and time."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from rtee.buses.modbus_slave import ILLEGAL_ADDRESS, Framing, ModbusEmulator, Refused
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Grasps
from rtee.drivers.onrobot_common import FIRMWARE, PRODUCT, SERIAL, SERIAL_COUNT
from rtee.drivers.properties import Byte, Positive, Rate

_GATEWAY_NO_TARGET = 0x0B  # Modbus exception: the target device does not answer the gateway
_VERSION, _BUILD = 0x0105, 7  # firmware 1.5, build 7, as of no gripper in particular

Window = tuple[int, int]
"""First and last register of a block that can be read or written."""

IDENTITY: Window = (PRODUCT, SERIAL + SERIAL_COUNT - 1)
"""What the gripper says about itself."""


@dataclass(frozen=True, slots=True)
class OnRobotProperties:
    """Properties of an emulated gripper.

    Attributes:
        unit: Its number behind the Compute Box or on the line.
        framing: ``tcp`` or ``rtu``.
        baudrate: Bits per second.
        haste: How much faster than the real one it moves.
    """

    unit: Byte = 65
    framing: Framing = "tcp"
    baudrate: Rate = 1_000_000
    haste: Positive = 1.0


class OnRobotEmulator(ModbusEmulator, Grasps):
    """An emulated gripper; its subclasses define what is in the registers and how it moves.

    Attributes:
        READABLE: Blocks that can be read.
        WRITABLE: Blocks that can be written.
        axis: Its fingers.
        moves: Times a motion was started.
    """

    FAULTS: ClassVar[frozenset[str]] = ModbusEmulator.FAULTS | {"no_tool"}
    FUNCTIONS: ClassVar[frozenset[int]] = frozenset({0x03, 0x06, 0x10, 0x17})
    EXCEPTIONS: ClassVar[bool] = True
    READABLE: ClassVar[Sequence[Window]]
    WRITABLE: ClassVar[Sequence[Window]]
    axis: Axis

    def __init__(self, properties: OnRobotProperties) -> None:
        made = self._made = properties
        super().__init__(made.unit, made.framing, baudrate=made.baudrate)
        # Over TCP, too: behind a Compute Box the unit tells the tools of a dual changer apart.
        self.any_unit = False
        self.moves = 0
        self._now: float | None = None

    @abstractmethod
    def registers(self) -> Mapping[int, int]:
        """Return what is in the registers."""

    @abstractmethod
    def _set(self, address: int, values: Sequence[int]) -> None:
        """Set registers of one block, and obey; raises `Refused`."""

    @abstractmethod
    def _advance_by(self, dt: float) -> None:
        """Let ``dt`` seconds pass."""

    def on_faults(self) -> None:
        """Block the motor while it is stuck."""
        self.axis.stuck = "stuck" in self.faults

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int]:
        """Return registers; those inside a block that no document names are 0."""
        self._reachable()
        self.advance(now)
        if not _within(self.READABLE, address, count):
            raise Refused(ILLEGAL_ADDRESS)
        known = self.registers()
        return [known.get(address + i, 0) & 0xFFFF for i in range(count)]

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        """Set targets or settings; writing control starts what it names."""
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
        dt = 0.0 if self._now is None else max(0.0, now - self._now)
        self._now = now
        if dt > 0.0:
            self._advance_by(dt * self._made.haste)


def identity(product: int, serial: str) -> dict[int, int]:
    """Return the registers of a product code and a serial number."""
    text = serial.encode("ascii").ljust(2 * SERIAL_COUNT, b"\0")
    known = {SERIAL + i: text[2 * i] << 8 | text[2 * i + 1] for i in range(SERIAL_COUNT)}
    return known | {PRODUCT: product, FIRMWARE: _VERSION, FIRMWARE + 1: _BUILD}


def fitting(options: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """Return the properties that follow from a driver's options: ``names`` and the framing."""
    found = {name: options[name] for name in names if options.get(name) is not None}
    # Without a port, the driver reaches the Compute Box by its host, which is Modbus TCP.
    port = str(options.get("port") or "tcp://")
    return {**found, "framing": "tcp" if port.startswith("tcp://") else "rtu"}


def _within(blocks: Sequence[Window], address: int, count: int) -> bool:
    return any(low <= address and address + count - 1 <= high for low, high in blocks)
