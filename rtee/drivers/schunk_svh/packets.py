"""The SVH's packets on the wire, and a resynchronising parser. No I/O."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Self

from rtee.buses.parser import FramedParser

BAUDRATE = 921_600
CHANNELS = 9
SYNC = b"\x4c\xaa"
PAYLOAD = 64
"""Bytes of data in every packet of the host, padded with zeros."""
PACKET = PAYLOAD + 8
"""Bytes of a padded packet on the wire."""
GAP = 782e-6
"""Pause the hand needs after each packet of the host [s]."""
TURNAROUND = 5e-4
"""Time from a request to its reply that the wire does not explain [s]; an assumption."""

_HEADER = struct.Struct("<2sBBH")


class SvhFrameError(ValueError):
    """Bytes that are no packet, or a packet whose data does not fit its command."""


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
    folded = int.from_bytes(data, "little")  # whole words at once: this is done in every cycle
    for bits in (256, 128, 64, 32, 16, 8):
        folded ^= folded >> bits
    return sum(data) & 0xFF, folded & 0xFF


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet, either way.

    Attributes:
        command: What it is about.
        channel: The channel it is about, 0 where the command has none.
        data: Its data as on the wire.
        index: The host's packet counter, 0 to 254; a reply carries that of its request.
    """

    command: Command
    channel: int = 0
    data: bytes = b""
    index: int = 0

    def to_bytes(self, *, pad: bool = True) -> bytes:
        """Return the packet as sent; the host always pads its data to 64 bytes."""
        if len(self.data) > PAYLOAD or not 0 <= self.channel <= 15 or not 0 <= self.index <= 255:
            raise SvhFrameError(f"no packet can carry {self}")
        data = self.data.ljust(PAYLOAD, b"\x00") if pad else self.data
        address = self.command | self.channel << 4
        return _HEADER.pack(SYNC, self.index, address, len(data)) + data + bytes(checksums(data))

    @classmethod
    def from_bytes(cls, raw: bytes) -> Self:
        """Return the packet that ``raw`` is, whole and nothing else.

        Raises:
            SvhFrameError: if it is none.
        """
        if len(raw) < 8:
            raise SvhFrameError(f"{len(raw)} bytes are too few for a packet")
        sync, index, address, length = _HEADER.unpack_from(raw)
        if sync != SYNC:
            raise SvhFrameError("a packet begins with 4C AA")
        if length > PAYLOAD or len(raw) != length + 8:
            raise SvhFrameError(f"a data length of {length} does not fit {len(raw)} bytes")
        data = raw[6:-2]
        if bytes(checksums(data)) != raw[-2:]:
            raise SvhFrameError("the checksums do not match")
        command = address & 0xF
        if command > Command.GET_FIRMWARE_INFO:
            raise SvhFrameError(f"there is no command {command:#x}")
        return cls(Command(command), address >> 4, data, index)


class Parser(FramedParser[Packet]):
    """Finds packets in a stream; a bad one costs itself, not the one that follows."""

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
