"""The Ability Hand's frames, byte stuffing, replies and touch words; no I/O.

Source: the maker's interface document (API frames over UART or RS-485) and its published client.
The two differ in the order of the touch words; this codec follows the client. Frames are stuffed:
``7E``, the frame with ``7E`` and ``7D`` escaped, ``7E``. The checksum is the two's complement of
the sum of all bytes before it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Generic, Self, TypeVar

from rtee.buses.parser import CodecError

MOTORS = ("index", "middle", "ring", "pinky", "thumb_flexor", "thumb_rotator")
"""The six motors, in the order of every frame."""
COUNT = len(MOTORS)
TOUCHING = ("index", "middle", "ring", "pinky", "thumb")
"""The fingers with touch sensors, in the order of the touch words."""
SITES = 6
"""Number of touch sensors per finger."""
SENSORS = SITES * len(TOUCHING)
BAUDRATES = (
    460_800, 1200, 38_400, 56_000, 57_600, 76_800, 115_200, 230_400, 250_000, 921_600, 1_000_000,
)  # fmt: skip
"""Baud rates of a hand, the factory setting first; those between 1200 and 38,400 are not published,
and those above 460,800 need RS-485."""
ADDRESS = 0x50
"""Factory address."""
API_TIME = 0.3
"""Time without a command after which the hand leaves API mode [s]."""

_FLAG, _ESCAPE, _FLIP = 0x7E, 0x7D, 0x20
_LEAST = 2
"""Bytes of the shortest command without its checksum: address and header."""
VELOCITIES, NO_TOUCH = 2, 3
"""Variants of a reply: 2 has velocities instead of currents; 3 has both, and no touch words."""
_TOUCH = 45
"""Bytes of the thirty 12-bit touch words."""
_WORDS = struct.Struct("<6h")
_PAIRS = struct.Struct("<12h")
COUNTS = 32767 / math.radians(150.0)
"""Position counts per radian: full scale is 150 degrees."""
_RATE = 32767 / math.radians(3000.0)
"""Counts per rad/s of a commanded velocity: full scale is 3000 degrees per second."""
_ROTOR = 4.0
"""Counts per rad/s of the rotor in a reported velocity."""
AMPERE = 620.606
"""Current counts per ampere: the client's value, which depends on the hardware."""
DUTY = 3546
"""Counts of a 100 % duty cycle."""
GEARS = (649.0,) * 5 + (162.45,)
"""Turns of the rotor per turn of the joint."""
_TORQUE = 1.49e-3
"""Torque of the rotor per ampere [N·m/A]."""
TORQUES = tuple(gear * _TORQUE for gear in GEARS)
"""Torque of a joint per ampere [N·m/A], without the gear's losses."""


F = TypeVar("F")


class Header(IntEnum):
    """Headers of commands; the low nibble of a set-point or of `READ` selects the reply."""

    POSITION = 0x10
    VELOCITY = 0x20
    CURRENT = 0x30
    DUTY = 0x40
    READ = 0xA0
    LEAVE = 0x7C


SET_POINTS = (Header.POSITION, Header.VELOCITY, Header.CURRENT, Header.DUTY)
"""Headers of commands that carry six words and enter API mode."""


def checksum(data: bytes) -> int:
    """Return the byte that makes the sum of all bytes 0."""
    return -sum(data) & 0xFF


def stuffed(frame: bytes) -> bytes:
    """Return a frame with its flags and byte stuffing, as it is sent."""
    # The escape byte first: the escape of a flag contains it.
    out = frame.replace(b"\x7d", b"\x7d\x5d").replace(b"\x7e", b"\x7d\x5e")
    return b"\x7e" + out + b"\x7e"


def unstuffed(run: bytes) -> bytes:
    """Return the frame between two flags; raises `CodecError` if it ends with an escape byte."""
    if _ESCAPE not in run:
        return run
    out, flip = bytearray(), 0
    for byte in run:
        if not flip and byte == _ESCAPE:
            flip = _FLIP
        else:
            out.append(byte ^ flip)
            flip = 0
    if flip:
        raise CodecError("a frame ends with an escape byte")
    return bytes(out)


class _Parser(Generic[F]):
    """Splits a stuffed stream at its flags; each flag ends a frame and begins the next."""

    FRAME: ClassVar[Any]
    """Class of the frames, with a method ``from_frame``."""
    LIMIT = 2 * 72 + 2
    """Largest number of bytes of a frame on the wire: the longest reply with every byte escaped."""

    def __init__(self) -> None:
        self._run = bytearray()
        self.errors = 0

    @property
    def pending(self) -> int:
        """Number of bytes received of an incomplete frame."""
        return len(self._run)

    def reset(self) -> None:
        """Discard the received bytes."""
        self._run.clear()

    def feed(self, data: bytes) -> list[F]:
        """Receive bytes and return the frames that they complete."""
        *ends, rest = data.split(b"\x7e")
        frames = []
        for part in ends:
            run = bytes(self._run) + part
            self._run.clear()
            # Between two frames there is nothing, or stray zero bytes.
            if not run.strip(b"\0"):
                continue
            try:
                frames.append(self.FRAME.from_frame(self._checked(run)))
            except CodecError:
                self.errors += 1
        # One byte more than the longest frame proves that this is not a frame.
        self._run += rest[: self.LIMIT + 1 - len(self._run)]
        return frames

    def _checked(self, run: bytes) -> bytes:
        """Return the frame without its checksum; raises `CodecError`."""
        frame = unstuffed(run) if len(run) <= self.LIMIT else b""
        if len(frame) <= _LEAST or sum(frame) & 0xFF:
            raise CodecError("wrong length or checksum")
        return frame[:-1]


@dataclass(frozen=True, slots=True)
class Command:
    """A command of the host.

    Attributes:
        address: Address of the hand.
        header: The kind of request.
        words: The six set-points [counts]; empty for headers without set-points.
    """

    address: int
    header: int
    words: tuple[int, ...] = ()

    def to_bytes(self) -> bytes:
        """Return the command as sent."""
        frame = bytes((self.address, self.header))
        if self.words:
            frame += _WORDS.pack(*self.words)
        return stuffed(frame + bytes([checksum(frame)]))

    @classmethod
    def from_frame(cls, frame: bytes) -> Self:
        """Read a command from a frame without its checksum; raises `CodecError`."""
        if len(frame) < _LEAST:
            raise CodecError(f"a command cannot have {len(frame)} bytes")
        words: tuple[int, ...] = ()
        if frame[1] & 0xF0 in SET_POINTS:
            if len(frame) != 2 + _WORDS.size:
                raise CodecError(f"a frame of set-points cannot have {len(frame)} bytes")
            words = _WORDS.unpack_from(frame, 2)
        return cls(frame[0], frame[1], words)


class CommandParser(_Parser[Command]):
    """Finds commands in a stream, for a hand."""

    FRAME = Command


@dataclass(frozen=True, slots=True)
class Reply:
    """Measurements of a hand, in counts and in the order of `MOTORS`.

    Attributes:
        variant: 1: positions, currents, touch; 2: positions, velocities, touch; 3: positions,
            currents, velocities.
        positions: `COUNTS` per radian.
        currents: `AMPERE` per ampere.
        velocities: Four per rad/s of the rotor.
        touch: 12 bits of each of the thirty sensors.
        limited: Whether the hand limits each motor, because of heat or a collision.
    """

    variant: int
    positions: tuple[int, ...]
    currents: tuple[int, ...] = ()
    velocities: tuple[int, ...] = ()
    touch: tuple[int, ...] = ()
    limited: tuple[bool, ...] = (False,) * COUNT

    @classmethod
    def from_frame(cls, frame: bytes) -> Self:
        """Read a reply from a frame without its checksum; raises `CodecError`."""
        variant = (frame[0] & 0x0F) + 1 if frame else 0
        with_touch = 1 <= variant < NO_TOUCH
        size = 2 + _PAIRS.size + (_TOUCH if with_touch else _WORDS.size)
        # The echoed kind of command is documented for positions only, so any kind is accepted.
        if not 1 <= variant <= NO_TOUCH or frame[0] & 0xF0 not in (*SET_POINTS, Header.READ):
            raise CodecError(f"not the header of a reply: {frame[:1].hex()}")
        if len(frame) != size:
            raise CodecError(f"a reply of variant {variant} cannot have {len(frame)} bytes")
        if frame[-1] & 0xC0:
            raise CodecError(f"not the status of six motors: {frame[-1]:#04x}")
        pairs = _PAIRS.unpack_from(frame, 1)
        second, rest = pairs[1::2], frame[1 + _PAIRS.size : -1]
        return cls(
            variant,
            pairs[::2],
            () if variant == VELOCITIES else second,
            second if variant == VELOCITIES else (() if with_touch else _WORDS.unpack(rest)),
            _touch_words(rest) if with_touch else (),
            tuple(bool(frame[-1] >> motor & 1) for motor in range(COUNT)),
        )

    def to_frame(self) -> bytes:
        """Return the frame without its checksum."""
        second = self.velocities if self.variant == VELOCITIES else self.currents
        pairs = [word for pair in zip(self.positions, second, strict=True) for word in pair]
        rest = (
            _WORDS.pack(*self.velocities) if self.variant == NO_TOUCH else _touch_bytes(self.touch)
        )
        status = sum(1 << motor for motor, limited in enumerate(self.limited) if limited)
        head = bytes([Header.POSITION + self.variant - 1])
        return head + _PAIRS.pack(*pairs) + rest + bytes([status])

    def to_bytes(self) -> bytes:
        """Return the reply as sent."""
        frame = self.to_frame()
        return stuffed(frame + bytes([checksum(frame)]))


class ReplyParser(_Parser[Reply]):
    """Finds replies in a stream, for a host."""

    FRAME = Reply


def _touch_words(data: bytes) -> tuple[int, ...]:
    words: list[int] = []
    # Three bytes hold two words: the low nibble of the middle one belongs to the first.
    for low, middle, high in zip(data[::3], data[1::3], data[2::3], strict=True):
        words += (low | (middle & 0x0F) << 8, middle >> 4 | high << 4)
    return tuple(words)


def _touch_bytes(words: Sequence[int]) -> bytes:
    out = bytearray()
    for first, second in zip(words[::2], words[1::2], strict=True):
        out += bytes((first & 0xFF, first >> 8 | (second & 0x0F) << 4, second >> 4))
    return bytes(out)


# --- units ---------------------------------------------------------------------------------------


def _clipped(value: float) -> int:
    most = 32767  # limit of a signed 16-bit word, symmetric
    return round(min(max(value, -most), most))


def angle(counts: int) -> float:
    """Convert the counts of a position to [rad]."""
    return counts / COUNTS


def angle_counts(position: float) -> int:
    """Convert a position [rad] to counts, limited to 150 degrees."""
    return _clipped(position * COUNTS)


def velocity(counts: int, motor: int) -> float:
    """Convert the reported counts of a motor to the velocity of its joint [rad/s]."""
    return counts / _ROTOR / GEARS[motor]


def velocity_counts(rate: float, motor: int) -> int:
    """Convert the velocity of a motor's joint [rad/s] to the counts that a hand reports."""
    return _clipped(rate * _ROTOR * GEARS[motor])


def rate(counts: int) -> float:
    """Convert the counts of a commanded velocity to [rad/s]."""
    return counts / _RATE


def rate_counts(commanded: float) -> int:
    """Convert a commanded velocity [rad/s] to counts."""
    return _clipped(commanded * _RATE)


def effort(counts: int, motor: int) -> float:
    """Convert a current [counts] to the torque of the motor's joint [N·m]."""
    return counts / AMPERE * TORQUES[motor]


def effort_counts(torque: float, motor: int) -> int:
    """Convert the torque of a motor's joint [N·m] to a current [counts]."""
    return _clipped(torque / TORQUES[motor] * AMPERE)


_OFFSET = 0.878894
"""Force at zero conductance according to the client's formula [N]; words at rest are above 0."""
_SLOPE = 121_591.0
"""Force of a touch sensor per conductance [N·Ω]."""
_FULL = 4095
"""Largest touch word: twelve bits."""
_VOLTS = 3.3 / (_FULL + 1)
"""Voltage per count [V]: the converter measures up to 3.3 V."""
_DIVIDER, _SERIES = 33_000.0, 10_000.0
"""The client's formula for a sensor's resistance is 33,000 / V + 10,000 [Ω]: a voltage divider, and
a resistor in series with the sensor."""
_SHORTED = 20_000.0
"""Resistance at the largest word [Ω]: 33,000 / 3.3 + 10,000."""


def touch_force(word: int) -> float:
    """Return the force on a touch sensor by the client's formula [N].

    The formula is the maker's placeholder, not a calibration, and starts at 0.88 N. Only the
    difference from a sensor's value at rest indicates a contact.
    """
    volts = word * _VOLTS
    return _SLOPE * volts / (_DIVIDER + _SERIES * volts) + _OFFSET


def touch_word(force: float) -> int:
    """Return the 12-bit word that `touch_force` converts to a force [N]."""
    if force <= _OFFSET:
        return 0
    resistance = _SLOPE / (force - _OFFSET)
    # At its largest word, only the resistor in series and the divider remain.
    if resistance <= _SHORTED:
        return _FULL
    return min(_FULL, round(_DIVIDER / (resistance - _SERIES) / _VOLTS))
