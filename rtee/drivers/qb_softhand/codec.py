"""The qb SoftHand's serial protocol: frames, messages and a resynchronising parser. No I/O."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import reduce
from operator import xor
from typing import ClassVar, Self

from rtee.buses.parser import CodecError, FramedParser, Framing

BAUDRATE = 2_000_000  # the setting from the factory [baud]
BAUDRATES = (BAUDRATE, 460_800)
"""Rates that a hand can be set to [baud]."""
HEADER = b"\x3a\x3a"
BROADCAST = 0  # every device answers it, with its own number
LONGEST = 128
"""Largest length byte that a device accepts."""
TURNAROUND = 1e-3
"""Time from a request to its answer besides that on the wire: the latency of a USB adapter [s]."""

_INT16 = tuple(struct.Struct(f">{count}h") for count in range(LONGEST // 2 + 1))
"""Formats of 0 to 64 16-bit integers, the largest number in a frame."""


_FRAMING = Framing(HEADER, 1, lambda raw: bytes([reduce(xor, raw[4:])]), LONGEST, 2, extra=1)
"""The device's number, and a length that covers command, data and their checksum."""


class Command(IntEnum):
    """The commands that hands of several generations share."""

    PING = 0
    SET_ZEROS = 1
    STORE_PARAMS = 3
    GET_INFO = 6
    GET_PARAM_LIST = 12
    ACTIVATE = 128
    GET_ACTIVATE = 129
    SET_INPUTS = 130
    GET_INPUTS = 131
    GET_MEASUREMENTS = 132
    GET_CURRENTS = 133
    GET_CURR_AND_MEAS = 134
    GET_VELOCITIES = 137
    GET_ACCELERATIONS = 139
    SET_WATCHDOG = 143
    SET_BAUDRATE = 144
    SET_INPUTS_ACK = 147


@dataclass(frozen=True, slots=True)
class Frame:
    """A request or an answer; a legacy acknowledgement looks like a command without data.

    Attributes:
        device: Number of the device that is addressed, or that answers.
    """

    device: int
    command: int
    data: bytes = b""

    def to_bytes(self) -> bytes:
        """Return the frame as sent."""
        return _FRAMING.sealed((self.device,), bytes([self.command]) + self.data)

    @classmethod
    def from_bytes(cls, raw: bytes) -> Self:
        """Decode ``raw``, which must be exactly one frame; raises `CodecError`."""
        [device], body = _FRAMING.opened(raw)
        return cls(device, body[0], body[1:])


class Parser(FramedParser[Frame]):
    """Finds frames in a stream; a damaged frame does not cost the one that follows."""

    FRAMING = _FRAMING
    FRAME = Frame


def pack_int16(*values: float) -> bytes:
    """Return values as big-endian 16-bit integers, clamped into their range."""
    counts = [round(value) for value in values]
    # Clamped only if packing fails, since almost all values fit and this runs in every cycle.
    try:
        return _INT16[len(counts)].pack(*counts)
    except struct.error:
        return _INT16[len(counts)].pack(*[min(max(c, -32768), 32767) for c in counts])


def read_int16(data: bytes, *, least: int = 1) -> tuple[int, ...]:
    """Return the big-endian 16-bit integers in ``data``.

    Raises:
        CodecError: if there are fewer than ``least``, more than a frame carries, or an odd
            number of bytes.
    """
    if len(data) % 2 or not 2 * least <= len(data) <= LONGEST:
        raise CodecError(f"{len(data)} bytes do not hold {least} or more 16-bit values")
    return _INT16[len(data) // 2].unpack(data)


def activation(data: bytes) -> int:
    """Return the mask of active motors from an answer to GET_ACTIVATE; raises `CodecError`."""
    if len(data) != 1:
        raise CodecError(f"an activation is one byte, not {len(data)}")
    return data[0] & 0x03


def acknowledged(frame: Frame, command: int) -> bool | None:
    """Return whether a frame acknowledges a command as successful, in either generation's form.

    ``None``: the frame acknowledges something else.
    """
    # In legacy firmware, the command byte itself is the result.
    if not frame.data and frame.command in {0, 1}:
        return frame.command == 1
    if frame.command == command and len(frame.data) == 1:
        return frame.data[0] == 1
    return None


def watchdog_byte(seconds: float) -> int:
    """Return the watchdog's byte for a period [s]: units of 20 ms, 0 is off, at most 5 s."""
    if seconds <= 0.0:
        return 0
    # At least 1: a short period must not round to 0, which would switch the watchdog off.
    return min(max(round(seconds / 0.02), 1), 250)


def watchdog_seconds(value: int) -> float:
    """Return the watchdog's period [s] from its byte."""
    return value * 0.02


SLOT = 50  # bytes of a parameter
MOST = 64
"""Largest plausible number of parameters in a list."""

_HEAD = 6
"""Bytes before the first parameter: header, device, length, command and number."""
_SIGN = 0x8000
"""Current limits from here on are negative 16-bit numbers."""
_SIGNED = frozenset({3, 5})
"""Type bytes of signed integers of 16 and 32 bits, the types that limits may have."""
# Type byte to the form of a value (big-endian).
_FORMS = {0: "B", 1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}


class Index(IntEnum):
    """The parameters that a driver needs, counted from 1."""

    DEVICE = 1
    INPUT_MODE = 5
    CONTROL_MODE = 6
    LIMITS = 11
    CURRENT_LIMIT = 13


_INTEGERS = frozenset(range(7))
"""Type bytes of flags and integers, the types that a mode may have."""

_ELSEWHERE: Mapping[Index, Mapping[int, str]] = {
    Index.INPUT_MODE: {
        1: "the handle's encoder", 2: "EMG", 3: "EMG", 4: "EMG", 5: "EMG", 6: "a joystick",
    },
    Index.CONTROL_MODE: {1: "PWM", 2: "current"},
}  # fmt: skip
"""The modes in which a hand does not take references of position, by parameter."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter.

    Attributes:
        kind: 0 flag, 1/2 8-bit, 3/4 16-bit, 5/6 32-bit (signed/unsigned), 7 float, 8 double.
        label: Its name in words.
    """

    kind: int
    values: tuple[float, ...]
    label: str = ""

    def to_bytes(self) -> bytes:
        """Return the parameter as a slot of fifty bytes."""
        form = _FORMS[self.kind]
        values = [v if form in "fd" else int(v) for v in self.values]
        body = struct.pack(f">{len(values)}{form}", *values)
        slot = bytes([self.kind, len(values)]) + body + self.label.encode("ascii", "replace")
        return slot.ljust(SLOT, b"\x00")[:SLOT]

    @classmethod
    def from_bytes(cls, slot: bytes) -> Self:
        """Read a slot; raises `CodecError` if it is not a slot."""
        if len(slot) != SLOT or slot[0] not in _FORMS:
            raise CodecError("a parameter must have fifty bytes and begin with its type")
        form = f">{slot[1]}{_FORMS[slot[0]]}"
        size = struct.calcsize(form)
        if size + 2 > SLOT:
            raise CodecError(f"{slot[1]} values of type {slot[0]} do not fit a parameter")
        label = slot[2 + size :].split(b"\x00")[0].decode("ascii", "replace")
        return cls(slot[0], struct.unpack_from(form, slot, 2), label)


class ListParser:
    """Reads a parameter list by counting slots, since its length does not fit into a length byte.

    The bytes after the slots (menus, padding, checksum) differ between generations and are ignored.

    Attributes:
        errors: Packets that were not a parameter list.
    """

    LIMIT: ClassVar[int] = 6 + MOST * SLOT

    def __init__(self, device: int) -> None:
        self._device = device
        self._buffer = bytearray()
        self.errors = 0

    @property
    def pending(self) -> int:
        """Bytes kept because the list may still be completed."""
        return len(self._buffer)

    def reset(self) -> None:
        """Discard the received data."""
        self._buffer.clear()

    def feed(self, data: bytes) -> list[dict[int, Parameter]]:
        """Receive bytes and return the list that they complete, by index counted from 1."""
        buffer = self._buffer
        buffer += data[: self.LIMIT]
        del buffer[self.LIMIT :]
        head = HEADER + bytes([self._device])
        while True:
            start = buffer.find(head)
            if start < 0:
                # The last two bytes may begin a header that is still coming.
                del buffer[:-2]
                return []
            del buffer[:start]
            if len(buffer) < _HEAD:
                return []
            count = buffer[5]
            if buffer[4] == Command.GET_PARAM_LIST and 0 < count <= MOST:
                try:
                    found = self._read(bytes(buffer[_HEAD : _HEAD + count * SLOT]))
                    if len(found) < count:
                        return []
                    buffer.clear()
                    return [found]
                # A false header inside other data: the search continues one byte later.
                except CodecError:
                    pass
            self.errors += 1
            del buffer[:1]

    @staticmethod
    def _read(slots: bytes) -> dict[int, Parameter]:
        """Return the parameters in the complete slots; raises `CodecError`."""
        whole = len(slots) - len(slots) % SLOT
        # Refused early: after a false header, the parser would wait for slots that never come.
        if whole < len(slots) and slots[whole] not in _FORMS:
            raise CodecError("a parameter must begin with its type")
        return {
            at // SLOT + 1: Parameter.from_bytes(slots[at : at + SLOT])
            for at in range(0, whole, SLOT)
        }


def limits(parameters: Mapping[int, Parameter]) -> tuple[tuple[int, int], ...]:
    """Return the travel of the motors from a list [ticks]; empty if it has no plausible one."""
    parameter = parameters.get(Index.LIMITS)
    if parameter is None or len(parameter.values) < 2 or parameter.kind not in _SIGNED:
        return ()
    pairs = zip(parameter.values[::2], parameter.values[1::2], strict=False)
    ranges = tuple((int(low), int(high)) for low, high in pairs)
    return ranges if all(low < high for low, high in ranges) else ()


def current_limit(parameters: Mapping[int, Parameter]) -> float | None:
    """Return the current limit [A] from a list, ``None`` if it has none."""
    parameter = parameters.get(Index.CURRENT_LIMIT)
    if parameter is None or not parameter.values or not 0 < parameter.values[0] < _SIGN:
        return None
    return parameter.values[0] / 1000.0


def other_mode(parameters: Mapping[int, Parameter]) -> str:
    """Return the mode in a list in which a hand takes no references of position; empty if none."""
    for index, modes in _ELSEWHERE.items():
        found = parameters.get(index)
        if found is None or found.kind not in _INTEGERS or len(found.values) != 1:
            continue
        mode = int(found.values[0])
        if mode in modes:
            return f"{index.name.lower().replace('_', ' ')} {mode} ({modes[mode]})"
    return ""
