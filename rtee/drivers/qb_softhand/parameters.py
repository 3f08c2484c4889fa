"""The list of parameters of qb devices: fifty bytes each, in a packet longer than any frame."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Self

from rtee.drivers.qb_softhand.codec import HEADER, Command, QbFrameError

SLOT = 50  # bytes of a parameter
MOST = 64
"""Largest plausible number of parameters in a list."""

_HEAD = 6
"""Bytes before the first parameter: header, device, length, command and number."""
_SIGN = 0x8000
"""Current limits from here on are negative 16-bit numbers."""
_SIGNED = frozenset({3, 5})
"""Types of signed integers, of 16 and 32 bits, as limits are."""
# Type byte to the form of a value (big-endian).
_FORMS = {0: "B", 1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}


class Index(IntEnum):
    """The parameters that a driver needs, counted from 1."""

    DEVICE = 1
    STARTUP_ACTIVATION = 4
    RESOLUTIONS = 7
    USE_LIMITS = 10
    LIMITS = 11
    CURRENT_LIMIT = 13


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
        """Return its slot of fifty bytes."""
        form = _FORMS[self.kind]
        values = [v if form in "fd" else int(v) for v in self.values]
        body = struct.pack(f">{len(values)}{form}", *values)
        slot = bytes([self.kind, len(values)]) + body + self.label.encode("ascii", "replace")
        return slot.ljust(SLOT, b"\x00")[:SLOT]

    @classmethod
    def from_bytes(cls, slot: bytes) -> Self:
        """Read a slot; raises `QbFrameError` if it is not a slot."""
        if len(slot) != SLOT or slot[0] not in _FORMS:
            raise QbFrameError("a parameter has fifty bytes and begins with its type")
        form = f">{slot[1]}{_FORMS[slot[0]]}"
        size = struct.calcsize(form)
        if size + 2 > SLOT:
            raise QbFrameError(f"{slot[1]} values of type {slot[0]} do not fit a parameter")
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
                except QbFrameError:
                    pass
            self.errors += 1
            del buffer[:1]

    @staticmethod
    def _read(slots: bytes) -> dict[int, Parameter]:
        """Return the parameters in the complete slots; raises `QbFrameError`."""
        whole = len(slots) - len(slots) % SLOT
        # Refused early: after a false header, the parser would wait for slots that never come.
        if whole < len(slots) and slots[whole] not in _FORMS:
            raise QbFrameError("a parameter begins with its type")
        return {
            at // SLOT + 1: Parameter.from_bytes(slots[at : at + SLOT])
            for at in range(0, whole, SLOT)
        }


@dataclass(frozen=True, slots=True)
class Limits:
    """Travel of one motor [ticks]."""

    lower: int
    upper: int


def limits(parameters: Mapping[int, Parameter]) -> tuple[Limits, ...]:
    """Return the motors' limits from a list; empty if it has no plausible ones."""
    parameter = parameters.get(Index.LIMITS)
    if parameter is None or len(parameter.values) < 2 or parameter.kind not in _SIGNED:
        return ()
    pairs = zip(parameter.values[::2], parameter.values[1::2], strict=False)
    ranges = tuple(Limits(int(low), int(high)) for low, high in pairs)
    return ranges if all(m.lower < m.upper for m in ranges) else ()


def current_limit(parameters: Mapping[int, Parameter]) -> float | None:
    """Return the current limit [A] from a list, ``None`` if it has none."""
    parameter = parameters.get(Index.CURRENT_LIMIT)
    if parameter is None or not parameter.values or not 0 < parameter.values[0] < _SIGN:
        return None
    return parameter.values[0] / 1000.0
