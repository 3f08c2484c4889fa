"""CANopen's frames (CiA 301): identifiers, NMT, SDO, heartbeat, emergency. No I/O."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Self

from rtee.buses.emulator import CanFrame
from rtee.buses.parser import CodecError
from rtee.drivers.packed import Packed, part

# Identifiers of the predefined connection set, to which the node id is added (CiA 301, 7.3.3).
SYNC = 0x080
EMERGENCY = 0x080
NMT = 0x000
HEARTBEAT = 0x700
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
TPDO = (0x180, 0x280, 0x380, 0x480)
RPDO = (0x200, 0x300, 0x400, 0x500)
NODES = 127
"""Largest node id; the smallest is 1."""
FULL = 8
"""Data bytes of a full classic CAN frame, such as all SDO and emergency frames."""
UPLOAD = 0x40
"""Command that reads a value, in the highest three bits of the request and of its answer."""
DISABLED = 0x8000_0000
"""Bit of a PDO's COB-ID that disables the PDO."""


class NmtCommand(IntEnum):
    """Commands that change a node's state."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """The state that a node reports in its heartbeat."""

    BOOT = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


def nmt(command: NmtCommand, node: int = 0) -> CanFrame:
    """Return the frame that commands a node, or all nodes (0)."""
    return CanFrame(NMT, bytes([command, node]))


def heartbeat(node: int, state: NmtState) -> CanFrame:
    """Return a node's heartbeat; with `NmtState.BOOT`, its boot-up message."""
    return CanFrame(HEARTBEAT + node, bytes([state]))


def read_heartbeat(data: bytes) -> NmtState:
    """Return the state in a heartbeat; raises `CodecError`."""
    try:
        # The top bit is not part of the state: it toggles in the older node guarding.
        return NmtState(data[0] & 0x7F)
    except (IndexError, ValueError) as error:
        raise CodecError("this is not a heartbeat") from error


class Emergency(Packed):
    """An emergency message.

    Attributes:
        code: The error code; 0: the error has ended.
        register: The error register.
        vendor: Five manufacturer-specific bytes.
    """

    WHAT = "an emergency message"

    code: int = part("H")
    register: int = part("B", default=0)
    vendor: bytes = part("5s", default=bytes(5))

    def to_frame(self, node: int) -> CanFrame:
        """Return the frame that a node sends."""
        return CanFrame(EMERGENCY + node, self.to_bytes())


class AbortCode(IntEnum):
    """Abort codes: reasons why a node refuses an SDO transfer."""

    UNSUPPORTED = 0x0601_0000
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    PDO_LENGTH = 0x0604_0042
    LENGTH = 0x0607_0010
    NO_SUBINDEX = 0x0609_0011
    RANGE = 0x0609_0030


class Sdo(Packed):
    """The data of an SDO frame: command, object, and four bytes.

    Attributes:
        command: Its first byte.
        index: Index of the object.
        subindex: Subindex of the object.
        data: Four bytes: the value, the length or the abort code.
    """

    WHAT = "an SDO frame"

    command: int = part("B")
    index: int = part("H")
    subindex: int = part("B")
    data: bytes = part("4s", default=bytes(4))

    @property
    def size(self) -> int:
        """Number of bytes of an expedited transfer's value."""
        # If bit 0 is set, bits 2 and 3 are the number of unused bytes.
        return 4 - (self.command >> 2 & 0x3) if self.command & 0x1 else 4

    @classmethod
    def upload(cls, index: int, subindex: int = 0) -> Self:
        """Return the request that reads an object."""
        return cls(UPLOAD, index, subindex)


EMERGENCIES: dict[int, str] = {
    0x2310: "overcurrent",
    0x3210: "overvoltage",
    0x3220: "undervoltage",
    0x4310: "over-temperature of the drive",
    0x5000: "hardware",
    0x6000: "software",
    0x7121: "motor blocked",
    0x7300: "sensor",
    0x8110: "CAN overrun",
    0x8120: "CAN in error passive mode",
    0x8130: "the host's heartbeat was lost",
    0x8140: "recovered from bus-off",
    0x8210: "PDO of a wrong length",
    0x8611: "following error",
}
# Meanings of the first digit of an error code, for unknown codes.
_CLASSES: dict[int, str] = {
    0x1: "generic", 0x2: "current", 0x3: "voltage", 0x4: "temperature", 0x5: "hardware",
    0x6: "software", 0x7: "additional modules", 0x8: "monitoring", 0x9: "external",
    0xF: "additional functions",
}  # fmt: skip


_VENDOR = 0xFF00
"""First of the manufacturer-specific error codes (CiA 301, table of emergency error codes)."""


def emergency_name(code: int) -> str:
    """Return the meaning of an error code in words."""
    if code >= _VENDOR:
        return "manufacturer-specific"
    return EMERGENCIES.get(code) or _CLASSES.get(code >> 12, "unknown")


_FREE = "free the fingers"
_CURES: dict[int, str] = {
    0x7121: _FREE,
    0x7300: "check the encoder's cable",
    0x8130: "see why this program fell silent",
    0x8611: f"{_FREE}, or lower the velocity",
}
# By the first digit, for all other codes.
_CLASS_CURES: dict[int, str] = {
    0x2: f"{_FREE}, and check the motor's cable",
    0x3: "check the motor's supply",
    0x4: "let it cool down",
    0x5: "switch it off and on; it needs service if the error comes back",
    0x8: "check the bus: cable, termination and bit rate",
}


def emergency_cure(code: int) -> str:
    """Return what removes the cause of an error, in words."""
    return _CURES.get(code) or _CLASS_CURES.get(code >> 12, "remove the cause")


class ErrorRegister(IntFlag):
    """Bits of the error register (object 1001h)."""

    GENERIC = 1 << 0
    CURRENT = 1 << 1
    VOLTAGE = 1 << 2
    TEMPERATURE = 1 << 3
    COMMUNICATION = 1 << 4
    PROFILE = 1 << 5


_REGISTERS: dict[int, ErrorRegister] = {
    0x2: ErrorRegister.CURRENT,
    0x3: ErrorRegister.VOLTAGE,
    0x4: ErrorRegister.TEMPERATURE,
}


def error_register(code: int) -> int:
    """Return the error register for an error code; 0 if the code is 0."""
    if not code:
        return 0
    register = ErrorRegister.GENERIC | _REGISTERS.get(code >> 12, ErrorRegister(0))
    # The second digit distinguishes communication errors.
    if code >> 8 in (0x81, 0x82):
        register |= ErrorRegister.COMMUNICATION
    elif code >> 8 in (0x84, 0x85, 0x86):  # velocity, torque and position control
        register |= ErrorRegister.PROFILE
    return int(register)
