"""Protocol 2.0, from the example frames of its fact sheet."""

from __future__ import annotations

import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.parser import CodecError
from rtee.drivers.dynamixel import codec, table
from rtee.drivers.dynamixel.codec import (
    Instruction,
    InstructionPacket,
    InstructionParser,
    StatusPacket,
)

IDS = bytes(range(16))
ASKED = [
    ("FF FF FD 00 01 03 00 01 19 4E", InstructionPacket(1, Instruction.PING)),
    (
        "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15",
        InstructionPacket(1, Instruction.READ, struct.pack("<HH", 132, 4)),
    ),
    (
        "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89",
        InstructionPacket(1, Instruction.WRITE, struct.pack("<Hi", 116, 512)),
    ),
    (
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
        InstructionPacket(
            0xFE, Instruction.SYNC_WRITE, struct.pack("<HHBiBi", 116, 4, 1, 150, 2, 170)
        ),
    ),
    (
        "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
        InstructionPacket(0xFE, Instruction.SYNC_READ, struct.pack("<HHBB", 132, 4, 1, 2)),
    ),
    ("FF FF FD 00 01 03 00 08 2F 4E", InstructionPacket(1, Instruction.REBOOT)),
    (
        "FF FF FD 00 01 04 00 06 01 A1 E6",
        InstructionPacket(1, Instruction.FACTORY_RESET, b"\x01"),
    ),
    (
        "FF FF FD 00 00 06 00 03 0B 00 05 4F 62",
        InstructionPacket(0, Instruction.WRITE, b"\x0b\x00\x05"),
    ),
    (
        "FF FF FD 00 00 06 00 03 40 00 01 C8 E7",
        InstructionPacket(0, Instruction.WRITE, b"\x40\x00\x01"),
    ),
    (
        "FF FF FD 00 00 07 00 03 66 00 5E 01 4D 71",
        InstructionPacket(0, Instruction.WRITE, struct.pack("<Hh", 102, 350)),
    ),
    (
        "FF FF FD 00 FE 17 00 82 7E 00 0A 00 00 01 02 03 04 05 06 07 08 09 0A 0B 0C 0D 0E 0F E0 3D",
        InstructionPacket(0xFE, Instruction.SYNC_READ, struct.pack("<HH", 126, 10) + IDS),
    ),
    (
        "FF FF FD 00 FE 17 00 8A 7E 00 0A 00 00 01 02 03 04 05 06 07 08 09 0A 0B 0C 0D 0E 0F 69 75",
        InstructionPacket(0xFE, Instruction.FAST_SYNC_READ, struct.pack("<HH", 126, 10) + IDS),
    ),
    (
        "FF FF FD 00 01 0A 00 03 74 00 FF FF FD FD 00 21 E7",
        InstructionPacket(1, Instruction.WRITE, b"\x74\x00\xff\xff\xfd\x00"),
    ),
    (
        "FF FF FD 00 00 06 00 03 62 00 05 7B 65",
        InstructionPacket(0, Instruction.WRITE, b"\x62\x00\x05"),
    ),
]
ANSWERED = [
    ("FF FF FD 00 01 07 00 55 00 06 04 26 65 5D", StatusPacket(1, 0, b"\x06\x04\x26")),
    (
        "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0",
        StatusPacket(1, 0, struct.pack("<i", 166)),
    ),
    ("FF FF FD 00 01 04 00 55 00 A1 0C", StatusPacket(1)),
    ("FF FF FD 00 00 07 00 55 00 B0 04 2F EE C4", StatusPacket(0, 0, b"\xb0\x04\x2f")),
    ("FF FF FD 00 00 04 00 55 00 DA 8C", StatusPacket(0)),
    (
        "FF FF FD 00 00 0E 00 55 00 F4 FF 03 00 00 00 00 08 00 00 46 EF",
        StatusPacket(0, 0, struct.pack("<hii", -12, 3, 2048)),
    ),
    ("FF FF FD 00 01 04 00 55 80 A2 8F", StatusPacket(1, codec.ALERT)),
    ("FF FF FD 00 01 04 00 55 07 B0 8C", StatusPacket(1, codec.Error.ACCESS)),
    ("FF FF FD 00 01 04 00 55 06 B5 0C", StatusPacket(1, codec.Error.DATA_LIMIT)),
]
FAST = bytes.fromhex(
    "FFFFFD00FE1D00550000F4FF030000000008000098100001050000000000340800 00A8D1".replace(" ", "")
)
ASKING = bytes.fromhex(ASKED[2][0])


@pytest.mark.parametrize(("sheet", "packet"), ASKED)
def test_instructions_are_the_bytes_of_the_sheet(sheet: str, packet: InstructionPacket) -> None:
    raw = bytes.fromhex(sheet)
    assert packet.to_bytes() == raw
    assert InstructionPacket.from_bytes(raw) == packet
    assert InstructionParser().feed(raw) == [packet]


def test_long_sync_writes_are_the_bytes_of_the_sheet() -> None:
    modes = b"".join(bytes([i, 5]) for i in range(16))
    packet = InstructionPacket(0xFE, Instruction.SYNC_WRITE, struct.pack("<HH", 11, 1) + modes)
    assert packet.to_bytes()[:12] == bytes.fromhex("FFFFFD00FE2700830B000100")
    assert packet.to_bytes()[-2:] == bytes.fromhex("DC1B")
    goals = b"".join(struct.pack("<Bi", i, 2048) for i in range(16))
    packet = InstructionPacket(0xFE, Instruction.SYNC_WRITE, struct.pack("<HH", 116, 4) + goals)
    assert len(packet.to_bytes()) == 94
    assert packet.to_bytes()[-2:] == bytes.fromhex("D1B0")


@pytest.mark.parametrize(("sheet", "packet"), ANSWERED)
def test_answers_are_the_bytes_of_the_sheet(sheet: str, packet: StatusPacket) -> None:
    raw = bytes.fromhex(sheet)
    assert packet.to_bytes() == raw
    with pytest.raises(CodecError):
        InstructionPacket.from_bytes(raw)


def test_the_fast_answer_of_two_servos_is_that_of_the_sheet() -> None:
    answers = [
        StatusPacket(0, 0, struct.pack("<hii", -12, 3, 2048)),
        StatusPacket(1, 0, struct.pack("<hii", 5, 0, 2100)),
    ]
    assert codec.fast_status(answers) == FAST
    assert codec.fast_status(answers[:1], [10, 10]) == FAST[:22]


@given(st.binary(max_size=60))
def test_stuffing_has_an_inverse_and_hides_every_header(data: bytes) -> None:
    stuffed = codec.stuff(data + b"\xff\xff\xfd\x00" + data)
    assert codec.HEADER not in stuffed
    assert codec.unstuff(stuffed) == data + b"\xff\xff\xfd\x00" + data


@given(noise=st.binary(max_size=200), at=st.integers(0, 15), value=st.integers(0, 255))
def test_noise_and_damage_cost_no_more_than_one_good_packet(
    noise: bytes, at: int, value: int
) -> None:
    parser = InstructionParser()
    damaged = bytearray(ASKING)
    damaged[at] = value
    parser.feed(noise + bytes(damaged))
    assert parser.pending <= InstructionParser.LIMIT
    found = parser.feed(ASKING + ASKING)
    assert found[-1] == InstructionPacket.from_bytes(ASKING)


@given(cuts=st.lists(st.integers(1, 12), min_size=1))
def test_packets_are_found_however_the_stream_is_cut(cuts: list[int]) -> None:
    stream = b"\xff\xff" + ASKING + b"\xff\xff\xfd" + ASKING + b"\x00" + ASKING
    parser, found, at = InstructionParser(), [], 0
    while at < len(stream):
        step = cuts[at % len(cuts)]
        found += parser.feed(stream[at : at + step])
        at += step
    assert found == [InstructionPacket.from_bytes(ASKING)] * 3


@pytest.mark.parametrize("raw", [b"", ASKING[:-1], b"\x00" + ASKING, ASKING[:-1] + b"\x00"])
def test_what_is_no_packet_is_refused(raw: bytes) -> None:
    with pytest.raises(CodecError):
        InstructionPacket.from_bytes(raw)


def test_registers_survive_their_bytes() -> None:
    for register in table.REGISTERS:
        values = [register.default, -1 if register.signed else 1]
        for value in values:
            assert register.unpack(register.pack(value)) == value
    ends = [(r.address, r.address + r.size) for r in table.REGISTERS]
    assert all(a[1] <= b[0] for a, b in itertools.pairwise(ends))
