"""The SVH's packets on the wire, their data, and a resynchronising parser. No I/O."""

from __future__ import annotations

import struct
from dataclasses import astuple, dataclass
from enum import IntEnum
from typing import Any, ClassVar, Self

from rtee.buses.parser import FramedParser

BAUDRATE = 921_600  # [baud]; the hand has no other
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
"""Time from a request to its reply beside that on the wire [s]; an assumption."""

_HEADER = struct.Struct("<2sBBH")


class SvhFrameError(ValueError):
    """Bytes that are not a packet, or a packet whose data does not fit its command."""


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
        if len(self.data) > PAYLOAD or not 0 <= self.channel <= 0xF or not 0 <= self.index <= 0xFF:
            raise SvhFrameError(f"no packet can carry {self}")
        data = self.data.ljust(PAYLOAD, b"\x00") if pad else self.data
        address = self.command | self.channel << 4
        return _HEADER.pack(SYNC, self.index, address, len(data)) + data + bytes(checksums(data))

    @classmethod
    def from_bytes(cls, raw: bytes) -> Self:
        """Return the packet that ``raw`` is, without other bytes; raises `SvhFrameError`."""
        if len(raw) < _OVERHEAD:
            raise SvhFrameError(f"{len(raw)} bytes are too few for a packet")
        sync, index, address, length = _HEADER.unpack_from(raw)
        if sync != SYNC:
            raise SvhFrameError("a packet begins with 4C AA")
        if length > PAYLOAD or len(raw) != length + _OVERHEAD:
            raise SvhFrameError(f"a data length of {length} does not fit {len(raw)} bytes")
        data = raw[6:-2]
        if bytes(checksums(data)) != raw[-2:]:
            raise SvhFrameError("the checksums do not match")
        # Three of the sixteen values are no command.
        command = address & 0xF
        if command > Command.GET_FIRMWARE_INFO:
            raise SvhFrameError(f"there is no command {command:#x}")
        return cls(Command(command), address >> 4, data, index)


class Parser(FramedParser[Packet]):
    """Finds packets in a stream; a damaged packet does not cost the one that follows."""

    HEADER = SYNC
    HEAD = 6
    PIECE = PACKET
    LIMIT = 4 * PACKET
    INSIDE = 9

    def _length(self, at: int) -> int:
        length = self._buffer[at + 4] | self._buffer[at + 5] << 8
        return length + 8 if length <= PAYLOAD else 0

    def _decode(self, raw: bytes) -> Packet:
        return Packet.from_bytes(raw)


# --- data of the packets ---------------------------------------------------------------------

_FEEDBACK = struct.Struct("<ih")
_FEEDBACK_ALL = struct.Struct("<9i9h")
_TARGETS = struct.Struct("<9i")
_ENCODERS = struct.Struct("<9I")
_FIRMWARE = struct.Struct("<4sHH48s")


def _unpack(form: struct.Struct, packet: Packet, what: str) -> tuple[Any, ...]:
    if len(packet.data) < form.size:
        raise SvhFrameError(f"{what} needs {form.size} bytes, not {len(packet.data)}")
    return form.unpack_from(packet.data)


def _clip(value: float, bits: int) -> int:
    # Saturated, so that a value out of range does not wrap to the other end.
    edge = 1 << (bits - 1)
    return min(max(int(value), -edge), edge - 1)


@dataclass(frozen=True, slots=True)
class Feedback:
    """Position [ticks] and current [mA] of one channel."""

    position: int
    current_ma: int

    @classmethod
    def from_bytes(cls, packet: Packet) -> Self:
        """Read the answer to a single-channel command; raises `SvhFrameError`."""
        return cls(*_unpack(_FEEDBACK, packet, "a channel's feedback"))

    def to_bytes(self) -> bytes:
        """Return the data of the answer."""
        return _FEEDBACK.pack(_clip(self.position, 32), _clip(self.current_ma, 16))


@dataclass(frozen=True, slots=True)
class FeedbackAll:
    """Positions [ticks] and currents [mA] of all channels."""

    positions: tuple[int, ...]
    currents_ma: tuple[int, ...]

    @classmethod
    def from_bytes(cls, packet: Packet) -> Self:
        """Read the answer to an all-channel command; raises `SvhFrameError`."""
        values = _unpack(_FEEDBACK_ALL, packet, "feedback of all channels")
        return cls(values[:CHANNELS], values[CHANNELS:])

    def to_bytes(self) -> bytes:
        """Return the data of the answer."""
        return _FEEDBACK_ALL.pack(
            *(_clip(p, 32) for p in self.positions), *(_clip(c, 16) for c in self.currents_ma)
        )


@dataclass(frozen=True, slots=True)
class Fields:
    """Base class of data that are the fields of a dataclass in their order.

    Attributes:
        FORM: Their layout; by default that of the ten settings of a controller.
        WHAT: Their name in messages.
    """

    FORM: ClassVar[struct.Struct] = struct.Struct("<10f")
    WHAT: ClassVar[str]

    @classmethod
    def from_bytes(cls, packet: Packet) -> Self:
        """Read them from an answer; raises `SvhFrameError`."""
        return cls(*_unpack(cls.FORM, packet, cls.WHAT))

    def to_bytes(self) -> bytes:
        """Return their bytes."""
        return self.FORM.pack(*astuple(self))


@dataclass(frozen=True, slots=True)
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

    minimum: float
    maximum: float
    max_rate: float
    filter: float
    period: float
    integral_min: float
    integral_max: float
    kp: float
    ki: float
    kd: float


@dataclass(frozen=True, slots=True)
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

    minimum: float
    maximum: float
    filter: float
    period: float
    integral_min: float
    integral_max: float
    kp: float
    ki: float
    output_min: float
    output_max: float


@dataclass(frozen=True, slots=True)
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

    FORM: ClassVar[struct.Struct] = struct.Struct("<6H")
    WHAT = "the controller state"
    CLEAR: ClassVar[int] = 0x1F  # clears all latched bits
    SUPPLY: ClassVar[int] = 0x0200  # bit of the 12 V supply in both PWM words

    pwm_fault: int = 0
    pwm_otw: int = 0
    pwm_reset: int = 0
    pwm_active: int = 0
    position_control: int = 0
    current_control: int = 0

    @property
    def enabled(self) -> int:
        """Bit mask of the channels that are powered."""
        return self.pwm_reset & self.pwm_active & 0x1FF


@dataclass(frozen=True, slots=True)
class FirmwareInfo:
    """The hand's identification; the name of a genuine one is ``SVH``."""

    name: str
    major: int
    minor: int
    text: str

    @property
    def version(self) -> tuple[int, int]:
        """Major and minor version."""
        return self.major, self.minor

    @classmethod
    def from_bytes(cls, packet: Packet) -> Self:
        """Read it from an answer; raises `SvhFrameError`."""
        name, major, minor, text = _unpack(_FIRMWARE, packet, "firmware information")
        return cls(_text(name), major, minor, _text(text))

    def to_bytes(self) -> bytes:
        """Return the data of the answer."""
        return _FIRMWARE.pack(
            self.name.encode("ascii"), self.major, self.minor, self.text.encode("ascii", "replace")
        )


def _text(raw: bytes) -> str:
    return raw.split(b"\x00")[0].decode("ascii", "replace")


def targets(positions: tuple[int, ...] | list[int]) -> bytes:
    """Return the data that sets the targets [ticks] of all channels."""
    # Clipped only if packing fails, since almost all targets fit and this runs in every cycle.
    try:
        return _TARGETS.pack(*positions)
    except struct.error:
        return _TARGETS.pack(*(_clip(p, 32) for p in positions))


def read_targets(packet: Packet) -> tuple[int, ...]:
    """Return the targets [ticks] of all channels; raises `SvhFrameError`."""
    return _unpack(_TARGETS, packet, "targets of all channels")


def target(position: int) -> bytes:
    """Return the data that sets the target [ticks] of one channel."""
    return struct.pack("<i", _clip(position, 32))


def read_target(packet: Packet) -> int:
    """Return the target [ticks] of one channel; raises `SvhFrameError`."""
    return int(_unpack(struct.Struct("<i"), packet, "a target")[0])


def encoders(scalings: tuple[int, ...]) -> bytes:
    """Return the data of the encoder scalings of all channels."""
    return _ENCODERS.pack(*scalings)


def read_encoders(packet: Packet) -> tuple[int, ...]:
    """Return the encoder scalings of all channels; raises `SvhFrameError`."""
    return _unpack(_ENCODERS, packet, "encoder scalings")
