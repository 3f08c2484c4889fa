"""Common parts of OnRobot's grippers: registers, options, and the codes of the tools.

Sources: the vendor's ROS 2 packages, its connectivity guide and published drivers, which agree on
the addresses and units named here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from rtee.drivers.options import DeviceOptions, Pause, Positive, Rate
from rtee.drivers.packed import text
from rtee.drivers.register_blocks import ExchangeKind

TARGETS = 0x0000
"""First of the target registers."""

PRODUCT = 0x0600  # register of the product code
FIRMWARE = 0x0604  # register of the firmware's version
SERIAL = 0x0609  # first register of the serial number
SERIAL_COUNT = 16  # its registers, two characters each

TENTH_MM = 1e-4  # unit of the registers of widths and diameters [m]

PRODUCTS: dict[int, str] = {0x20: "RG2", 0x21: "RG6", 0xC0: "2FG7", 0xC1: "2FG14"}
"""Product codes from the vendor's own packages; sources disagree about that of the 3FG."""


class OnRobotOptions(DeviceOptions, frozen=True):
    """Options of all of OnRobot's grippers."""

    host: str = "192.168.1.1"
    """The Compute Box's address (Modbus TCP)."""
    port: str | None = None
    """Instead of ``host``: tty, socket://, rfc2217:// (RTU) or tcp://host:port."""
    unit: Annotated[int, Meta(ge=0, le=255)] = 65
    """Modbus number: 65; 66 and 67 on a dual quick changer."""
    baudrate: Rate = 1_000_000
    """Rate of a direct line (8E1) [baud]."""
    exchange: ExchangeKind = "auto"
    """How registers are exchanged: function 23, or 16 and 3."""
    rate: Positive = 50.0
    """Exchanges per second through the Compute Box."""
    settle: Pause = 0.1
    """Time after which the driver grips with force at a resting reference [s]."""

    @property
    def address(self) -> str:
        """The address of the bus."""
        return self.port or f"tcp://{self.host}"


def signed(register: int) -> int:
    """Return the value of a signed register."""
    return register - 0x10000 if register & 0x8000 else register


def metres(tenth_mm: int) -> float:
    """Convert the value of a length register [0.1 mm] to metres."""
    return tenth_mm * TENTH_MM


def version(register: int) -> str:
    """Return the firmware's version: major in the high byte, minor in the low one."""
    return f"{register >> 8}.{register & 0xFF}"


def serial_number(registers: Sequence[int]) -> str:
    """Return the serial number from its registers, two characters each."""
    return text(b"".join(register.to_bytes(2, "big") for register in registers))
