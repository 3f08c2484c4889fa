"""DYNAMIXEL protocol 2.0: packets, byte stuffing, CRC, a resynchronising parser. No I/O.

The driver leaves the wire to dynamixel-sdk; this codec is for the emulated servos.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Self

from rtee.buses.parser import CodecError, FramedParser, Framing

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE  # the id that all servos listen to
STATUS = 0x55  # in an answer, where a request has its instruction
LONGEST = 1024
"""Largest accepted length field [byte]: more than any table needs, less than most garbage."""
_STUFFED = b"\xff\xff\xfd"
_POLYNOMIAL = 0x8005
"""Polynomial of the CRC-16 (Robotis e-manual, protocol 2.0, CRC)."""


class Instruction(IntEnum):
    """Instructions of a host."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class Error(IntEnum):
    """The low seven bits of a status packet's error."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


ALERT = 0x80
"""Bit of a status packet's error: the hardware error status is not 0."""


class Hardware(IntFlag):
    """The bits of the hardware error status."""

    INPUT_VOLTAGE = 0x01
    HALL_SENSOR = 0x02
    OVERHEATING = 0x04
    ENCODER = 0x08
    ELECTRICAL_SHOCK = 0x10
    OVERLOAD = 0x20


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1) ^ (_POLYNOMIAL if value & 0x8000 else 0)
        table.append(value & 0xFFFF)
    return tuple(table)


_CRC = _crc_table()


def crc16(data: Iterable[int]) -> int:
    """Return the CRC-16 of bytes: polynomial 0x8005, neither reflected nor inverted."""
    value = 0
    for byte in data:
        value = (value << 8 & 0xFFFF) ^ _CRC[(value >> 8 ^ byte) & 0xFF]
    return value


def stuff(data: bytes) -> bytes:
    """Return a packet's body in which a stuffed ``FD`` tells ``FF FF FD`` from a header."""
    return data.replace(_STUFFED, _STUFFED + b"\xfd")


def unstuff(data: bytes) -> bytes:
    """Undo `stuff`."""
    return data.replace(_STUFFED + b"\xfd", _STUFFED)


_FRAMING = Framing(
    HEADER, 1, lambda raw: crc16(raw).to_bytes(2, "little"), LONGEST, 3, 2, size=2, tail=2,
)  # fmt: skip
"""Framing of packets: the id, then the length of the body and its CRC."""


@dataclass(frozen=True, slots=True)
class InstructionPacket:
    """A packet from the host.

    Attributes:
        device: Id of the servo, or `BROADCAST`.
        instruction: Its instruction; any integer, as servos answer unknown ones with an error.
        params: Its parameters.
    """

    device: int
    instruction: int
    params: bytes = b""

    def to_bytes(self) -> bytes:
        """Return the packet as sent."""
        return _FRAMING.sealed((self.device,), stuff(bytes([self.instruction]) + self.params))

    @classmethod
    def from_bytes(cls, raw: bytes) -> Self:
        """Return the packet in ``raw``; raises `CodecError`."""
        [device], body = _FRAMING.opened(raw)
        # On a half-duplex line, a servo also receives the answers of the others.
        if body[0] == STATUS:
            raise CodecError("this is a status packet")
        body = unstuff(body)
        return cls(device, body[0], body[1:])


@dataclass(frozen=True, slots=True)
class StatusPacket:
    """A packet from a servo.

    Attributes:
        device: Its id.
        error: Error number and alert bit.
        params: The data that it returns.
    """

    device: int
    error: int = 0
    params: bytes = b""

    def to_bytes(self) -> bytes:
        """Return the packet as sent."""
        return _FRAMING.sealed((self.device,), stuff(bytes([STATUS, self.error]) + self.params))


def fast_status(answers: Sequence[StatusPacket], sizes: Sequence[int] | None = None) -> bytes:
    """Return the single packet in which several servos answer a fast sync or bulk read.

    Each servo's part is its error, its id, its data and the CRC of all bytes before. If ``sizes``
    names more servos than ``answers``, the packet ends at the first missing servo.
    """
    if sizes is None:
        sizes = [len(a.params) for a in answers]
    # Instruction, then error, id and CRC for each servo.
    length = 1 + sum(size + 4 for size in sizes)
    packet = HEADER + struct.pack("<BHB", BROADCAST, length, STATUS)
    for answer in answers:
        # Not stuffed, since the SDK does not unstuff fast reads.
        packet += bytes([answer.error, answer.device]) + answer.params
        packet += struct.pack("<H", crc16(packet))
    return packet


class InstructionParser(FramedParser[InstructionPacket]):
    """Finds instructions in a stream, as a servo does.

    Attributes:
        damaged: Id and instruction, as received, of packets with a wrong CRC; the user of the
            parser empties the list.
    """

    FRAMING = _FRAMING
    FRAME = InstructionPacket

    def __init__(self) -> None:
        super().__init__()
        self.damaged: list[tuple[int, int]] = []

    def _inside(self) -> int:
        # Stuffing keeps headers out of packets: another header means that this packet is cut off.
        return max(0, self._buffer.find(HEADER, 1))

    def _tried(self, at: int, length: int) -> InstructionPacket | None:
        packet = super()._tried(at, length)
        if packet is None and length and at == 0 and self._buffer[7] != STATUS:
            # Stored only for a wrong CRC, which a servo answers with an error.
            raw = self._buffer[:length]
            if crc16(raw[:-2]) != raw[-2] | raw[-1] << 8:
                self.damaged = [*self.damaged[-7:], (raw[4], raw[7])]
        return packet
