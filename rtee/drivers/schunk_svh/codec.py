"""The SVH's packets on the wire, their data, and a resynchronising parser. No I/O."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Self

from rtee.buses.parser import CodecError, FramedParser, Framing
from rtee.drivers.packed import Packed, part, text

BAUDRATE = 921_600  # [baud]; the hand has no other
NAME = "SVH"  # with which a genuine hand identifies itself
CHANNELS = 9  # motors of the hand
SYNC = b"\x4c\xaa"  # begins every packet
PAYLOAD = 64
"""Data bytes in every packet of the host, padded with zeros."""
_OVERHEAD = 8
"""Bytes of a packet besides its data: header of six, two checksums."""
PACKET = PAYLOAD + _OVERHEAD
"""Bytes of a padded packet on the wire."""
GAP = 782e-6
"""Pause that the hand needs after each packet of the host [s]."""
TURNAROUND = 5e-4
"""Time from a request to its reply besides that on the wire [s]; an assumption."""


class Command(IntEnum):
    """The low nibble of a packet's address."""

    GET_CONTROL_FEEDBACK = 0x0
    SET_CONTROL_COMMAND = 0x1
    GET_CONTROL_FEEDBACK_ALL = 0x2
    SET_CONTROL_COMMAND_ALL = 0x3
    GET_POSITION_SETTINGS = 0x4
    SET_POSITION_SETTINGS = 0x5
    GET_CURRENT_SETTINGS = 0x6
    SET_CURRENT_SETTINGS = 0x7
    GET_CONTROLLER_STATE = 0x8
    SET_CONTROLLER_STATE = 0x9
    GET_ENCODER_VALUES = 0xA
    SET_ENCODER_VALUES = 0xB
    GET_FIRMWARE_INFO = 0xC


def checksums(data: bytes | bytearray) -> tuple[int, int]:
    """Return the sum modulo 256 and the exclusive-or of the data bytes."""
    folded = int.from_bytes(data, "little")  # whole words at once, since every cycle needs it
    for bits in (256, 128, 64, 32, 16, 8):
        folded ^= folded >> bits
    return sum(data) & 0xFF, folded & 0xFF


_FRAMING = Framing(SYNC, 2, lambda raw: bytes(checksums(raw[6:])), PAYLOAD, size=2, tail=2)
"""Index and address, then the length of the data; the checksums cover only the data."""


@dataclass(frozen=True, slots=True)
class Packet:
    """A request or a reply.

    Attributes:
        channel: Its channel; 0 if the command has none.
        index: The host's packet counter, 0 to 254; a reply carries that of its request.
    """

    command: Command
    channel: int = 0
    data: bytes = b""
    index: int = 0

    def to_bytes(self, *, pad: bool = True) -> bytes:
        """Return the packet as sent; the host always pads its data to 64 bytes."""
        if not 0 <= self.channel <= 0xF:
            raise CodecError(f"a packet cannot carry {self}")
        data = self.data.ljust(PAYLOAD, b"\x00") if pad else self.data
        return _FRAMING.sealed((self.index, self.command | self.channel << 4), data)

    @classmethod
    def from_bytes(cls, raw: bytes) -> Self:
        """Decode ``raw``, which must be exactly one packet; raises `CodecError`."""
        (index, address), data = _FRAMING.opened(raw)
        # Three of the sixteen values are not commands.
        command = address & 0xF
        if command > Command.GET_FIRMWARE_INFO:
            raise CodecError(f"there is no command {command:#x}")
        return cls(Command(command), address >> 4, data, index)


class Parser(FramedParser[Packet]):
    """Finds packets in a stream; a damaged packet does not cost the one that follows."""

    FRAMING = _FRAMING
    FRAME = Packet
    INSIDE = 9


# --- data of the packets ---------------------------------------------------------------------


class Fields(Packed):
    """Base class of data that follow a header; padding may follow them."""

    LONGER = True


class Feedback(Fields):
    """Position [ticks] and current [mA] of one channel."""

    WHAT = "a channel's feedback"

    position: int = part("i")
    current_ma: int = part("h")


class FeedbackAll(Fields):
    """Positions [ticks] and currents [mA] of all channels."""

    WHAT = "feedback of all channels"

    positions: tuple[int, ...] = part("i", CHANNELS)
    currents_ma: tuple[int, ...] = part("h", CHANNELS)


class PositionSettings(Fields):
    """The position controller of one channel.

    Attributes:
        minimum: Smallest reference [ticks].
        maximum: Largest reference [ticks].
        max_rate: Fastest change of the reference [ticks/s].
        filter: Reference filter ``ky``.
        period: Time base of the controller [s].
        integral_min: Lower bound of the integral part.
        integral_max: Upper bound of the integral part.
        kp: Proportional gain.
        ki: Integral gain.
        kd: Derivative gain.
    """

    WHAT = "position settings"

    minimum: float = part("f")
    maximum: float = part("f")
    max_rate: float = part("f")
    filter: float = part("f")
    period: float = part("f")
    integral_min: float = part("f")
    integral_max: float = part("f")
    kp: float = part("f")
    ki: float = part("f")
    kd: float = part("f")


class CurrentSettings(Fields):
    """The current controller of one channel.

    Attributes:
        minimum: Smallest current [mA].
        maximum: Largest current [mA].
        filter: Reference filter ``ky``.
        period: Time base of the controller [s].
        integral_min: Lower bound of the integral part.
        integral_max: Upper bound of the integral part.
        kp: Proportional gain.
        ki: Integral gain.
        output_min: Smallest PWM output.
        output_max: Largest PWM output.
    """

    WHAT = "current settings"

    minimum: float = part("f")
    maximum: float = part("f")
    filter: float = part("f")
    period: float = part("f")
    integral_min: float = part("f")
    integral_max: float = part("f")
    kp: float = part("f")
    ki: float = part("f")
    output_min: float = part("f")
    output_max: float = part("f")


class ControllerState(Fields):
    """Power stages and controllers of the whole hand.

    Attributes:
        pwm_fault: Latched driver faults; written as 0x1F to clear them.
        pwm_otw: Latched over-temperature warnings; written as 0x1F to clear them.
        pwm_reset: Power stages out of reset: bits 0 to 8 the channels, bit 9 the 12 V supply.
        pwm_active: Power stages on, the same bits.
        position_control: 1 if the position controllers run.
        current_control: 1 if the current controllers run.
    """

    WHAT = "the controller state"
    CLEAR: ClassVar[int] = 0x1F  # clears all latched bits of a word
    SUPPLY: ClassVar[int] = 0x0200  # the 12 V supply, in both words above

    pwm_fault: int = part("H", default=0)
    pwm_otw: int = part("H", default=0)
    pwm_reset: int = part("H", default=0)
    pwm_active: int = part("H", default=0)
    position_control: int = part("H", default=0)
    current_control: int = part("H", default=0)

    @property
    def enabled(self) -> int:
        """Bit mask of the channels that are powered."""
        return self.pwm_reset & self.pwm_active & 0x1FF


class FirmwareInfo(Fields):
    """The hand's identification; the name of a genuine one is `NAME`."""

    WHAT = "firmware information"

    name: str = part("4s", kind=text)
    major: int = part("H")
    minor: int = part("H")
    text: str = part("48s", kind=text)

    @property
    def version(self) -> tuple[int, int]:
        """Major and minor version."""
        return self.major, self.minor


class Targets(Fields):
    """The targets [ticks] of all channels."""

    WHAT = "targets of all channels"

    ticks: Sequence[int] = part("i", CHANNELS)


class Target(Fields):
    """The target [ticks] of one channel."""

    WHAT = "a target"

    ticks: int = part("i")


class Encoders(Fields):
    """The encoder scalings of all channels."""

    WHAT = "encoder scalings"

    scalings: tuple[int, ...] = part("I", CHANNELS)
