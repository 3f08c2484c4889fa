"""The SVH's messages: what the data of its packets says. No I/O."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import ClassVar, Self

from rtee.drivers.schunk_svh.packets import (
    BAUDRATE,
    CHANNELS,
    GAP,
    PACKET,
    PAYLOAD,
    SYNC,
    TURNAROUND,
    Command,
    Packet,
    Parser,
    SvhFrameError,
    checksums,
)

__all__ = [
    "BAUDRATE",
    "CHANNELS",
    "GAP",
    "PACKET",
    "PAYLOAD",
    "SYNC",
    "TURNAROUND",
    "Command",
    "ControllerState",
    "CurrentSettings",
    "Feedback",
    "FeedbackAll",
    "FirmwareInfo",
    "Packet",
    "Parser",
    "PositionSettings",
    "SvhFrameError",
    "checksums",
    "encoders",
    "read_encoders",
    "read_target",
    "read_targets",
    "target",
    "targets",
]

_FEEDBACK = struct.Struct("<ih")
_FEEDBACK_ALL = struct.Struct("<9i9h")
_TARGETS = struct.Struct("<9i")
_TEN_FLOATS = struct.Struct("<10f")
_STATE = struct.Struct("<6H")
_ENCODERS = struct.Struct("<9I")
_FIRMWARE = struct.Struct("<4sHH48s")


def _unpack(form: struct.Struct, packet: Packet, what: str) -> tuple[float, ...]:
    if len(packet.data) < form.size:
        raise SvhFrameError(f"{what} needs {form.size} bytes, not {len(packet.data)}")
    return form.unpack_from(packet.data)


def _clip(value: float, bits: int) -> int:
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
        position, current = _unpack(_FEEDBACK, packet, "a channel's feedback")
        return cls(int(position), int(current))

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
        if len(packet.data) < _FEEDBACK_ALL.size:
            raise SvhFrameError(f"feedback of all channels needs {_FEEDBACK_ALL.size} bytes")
        values = _FEEDBACK_ALL.unpack_from(packet.data)
        return cls(values[:CHANNELS], values[CHANNELS:])

    def to_bytes(self) -> bytes:
        """Return the data of the answer."""
        return _FEEDBACK_ALL.pack(
            *(_clip(p, 32) for p in self.positions), *(_clip(c, 16) for c in self.currents_ma)
        )


@dataclass(frozen=True, slots=True)
class PositionSettings:
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

    @classmethod
    def from_bytes(cls, packet: Packet) -> Self:
        """Read the settings from an answer; raises `SvhFrameError`."""
        return cls(*_unpack(_TEN_FLOATS, packet, "position settings"))

    def to_bytes(self) -> bytes:
        """Return the data of the settings."""
        return _TEN_FLOATS.pack(
            self.minimum, self.maximum, self.max_rate, self.filter, self.period,
            self.integral_min, self.integral_max, self.kp, self.ki, self.kd,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class CurrentSettings:
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

    @classmethod
    def from_bytes(cls, packet: Packet) -> Self:
        """Read the settings from an answer; raises `SvhFrameError`."""
        return cls(*_unpack(_TEN_FLOATS, packet, "current settings"))

    def to_bytes(self) -> bytes:
        """Return the data of the settings."""
        return _TEN_FLOATS.pack(
            self.minimum, self.maximum, self.filter, self.period, self.integral_min,
            self.integral_max, self.kp, self.ki, self.output_min, self.output_max,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class ControllerState:
    """Power stages and controllers of the whole hand.

    Attributes:
        pwm_fault: Latched driver faults; written as 0x1F to clear them.
        pwm_otw: Latched over-temperature warnings; written as 0x1F to clear them.
        pwm_reset: Power stages out of reset: bits 0 to 8 the channels, bit 9 the 12 V supply.
        pwm_active: Power stages on, the same bits.
        position_control: 1 when the position controllers run.
        current_control: 1 when the current controllers run.
    """

    CLEAR: ClassVar[int] = 0x1F
    SUPPLY: ClassVar[int] = 0x0200

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

    @classmethod
    def from_bytes(cls, packet: Packet) -> Self:
        """Read the state from an answer; raises `SvhFrameError`."""
        return cls(*(int(v) for v in _unpack(_STATE, packet, "the controller state")))

    def to_bytes(self) -> bytes:
        """Return the data of the state."""
        return _STATE.pack(
            self.pwm_fault, self.pwm_otw, self.pwm_reset, self.pwm_active,
            self.position_control, self.current_control,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class FirmwareInfo:
    """What the hand says about itself; a genuine one says ``SVH``."""

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
        if len(packet.data) < _FIRMWARE.size:
            raise SvhFrameError(f"firmware information needs {_FIRMWARE.size} bytes")
        name, major, minor, text = _FIRMWARE.unpack_from(packet.data)
        return cls(
            name.split(b"\x00")[0].decode("ascii", "replace"),
            major,
            minor,
            text.split(b"\x00")[0].decode("ascii", "replace"),
        )

    def to_bytes(self) -> bytes:
        """Return the data of the answer."""
        return _FIRMWARE.pack(
            self.name.encode("ascii"), self.major, self.minor, self.text.encode("ascii", "replace")
        )


def targets(positions: tuple[int, ...] | list[int]) -> bytes:
    """Return the data that sets the targets [ticks] of all channels."""
    try:
        return _TARGETS.pack(*positions)
    except struct.error:
        return _TARGETS.pack(*(_clip(p, 32) for p in positions))


def read_targets(packet: Packet) -> tuple[int, ...]:
    """Return the targets [ticks] of all channels; raises `SvhFrameError`."""
    return tuple(int(v) for v in _unpack(_TARGETS, packet, "targets of all channels"))


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
    return tuple(int(v) for v in _unpack(_ENCODERS, packet, "encoder scalings"))
