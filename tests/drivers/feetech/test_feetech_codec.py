"""Frames, words and states of Feetech servos, byte by byte."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.parser import CodecError
from rtee.drivers.feetech import table
from rtee.drivers.feetech.codec import (
    BROADCAST,
    LARGEST_ID,
    LONGEST,
    Frame,
    GroupParser,
    Instruction,
    ReplyParser,
    RequestParser,
    Status,
    sync_read,
    sync_write,
)
from rtee.drivers.feetech.table import FAMILIES, Register

SCS, STS, HLS = FAMILIES["scs"], FAMILIES["sts"], FAMILIES["hls"]
WRITE = Instruction.WRITE


def le(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "little") for value in values)


def be(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "big") for value in values)


REQUESTS = [
    ("FF FF 01 02 01 FB", 1, Instruction.PING, b""),
    ("FF FF 01 04 02 03 02 F3", 1, Instruction.READ, b"\x03\x02"),
    ("FF FF 01 04 02 38 0B B5", 1, Instruction.READ, b"\x38\x0b"),
    ("FF FF 01 09 03 2A 01 FF 00 00 03 E8 DD", 1, WRITE, b"\x2a" + be(511, 0, 1000)),
    ("FF FF 01 05 03 2E 05 58 6B", 1, WRITE, b"\x2e" + be(1368)),
    ("FF FF 01 05 03 2A 01 87 44", 1, WRITE, b"\x2a" + be(391)),
    ("FF FF 01 04 03 28 01 CE", 1, WRITE, b"\x28\x01"),
    ("FF FF 01 04 03 28 00 CF", 1, WRITE, b"\x28\x00"),
    ("FF FF 01 04 03 28 02 CD", 1, WRITE, b"\x28\x02"),
    ("FF FF FE 04 03 28 01 D1", BROADCAST, WRITE, b"\x28\x01"),
    ("FF FF 01 04 03 30 00 C7", 1, WRITE, b"\x30\x00"),
    ("FF FF 01 04 03 05 05 ED", 1, WRITE, b"\x05\x05"),
    ("FF FF 05 04 03 30 01 C2", 5, WRITE, b"\x30\x01"),
    ("FF FF 01 05 04 2A 01 FF CB", 1, Instruction.REG_WRITE, b"\x2a" + be(511)),
    ("FF FF FE 02 05 FA", BROADCAST, Instruction.ACTION, b""),
    ("FF FF 01 09 03 2A 00 08 00 00 E8 03 D5", 1, WRITE, b"\x2a" + le(2048, 0, 1000)),
    ("FF FF 01 0A 03 29 32 00 08 00 00 E8 03 A3", 1, WRITE, b"\x29\x32" + le(2048, 0, 1000)),
    ("FF FF 01 05 03 2E E8 83 5D", 1, WRITE, b"\x2e\xe8\x83"),
    ("FF FF 01 0A 03 29 96 00 08 F4 01 DC 05 54", 1, WRITE, b"\x29\x96" + le(2048, 500, 1500)),
    ("FF FF 01 04 0B F4 01 FA", 1, Instruction.CALIBRATE, le(500)),
    ("FF FF 01 02 0B F1", 1, Instruction.CALIBRATE, b""),
    ("FF FF 01 04 03 28 80 4F", 1, WRITE, b"\x28\x80"),
    ("FF FF 01 02 08 F4", 1, Instruction.REBOOT, b""),
    ("FF FF 01 02 06 F6", 1, Instruction.RESTORE, b""),
    ("FF FF 01 02 0A F2", 1, Instruction.RESET, b""),
    ("FF FF 01 02 09 F3", 1, Instruction.BACK_UP, b""),
]  # fmt: skip
REPLIES = [
    ("FF FF 01 02 00 FC", 1, 0, b""),
    ("FF FF 01 04 00 05 04 F1", 1, 0, be(1284)),
    ("FF FF 01 04 00 09 03 EE", 1, 0, le(777)),
    ("FF FF 01 04 00 18 05 DD", 1, 0, le(1304)),
    ("FF FF 01 04 20 01 FF DA", 1, Status.OVERLOAD, be(511)),
]


@pytest.mark.parametrize(("text", "device", "code", "params"), REQUESTS)
def test_requests_are_as_published(text: str, device: int, code: int, params: bytes) -> None:
    raw, frame = bytes.fromhex(text), Frame(device, code, params)
    assert frame.to_bytes() == raw
    assert RequestParser().feed(raw) == [frame]


@pytest.mark.parametrize(("text", "device", "code", "params"), REPLIES)
def test_replies_are_as_published(text: str, device: int, code: int, params: bytes) -> None:
    raw, frame = bytes.fromhex(text), Frame(device, code, params)
    assert frame.to_bytes() == raw
    assert ReplyParser().feed(raw) == [frame]


@pytest.mark.parametrize(
    ("family", "register", "values", "text"),
    [
        (SCS, table.TORQUE, dict.fromkeys(range(1, 9), 1),
         "FF FF FE 14 83 28 01 01 01 02 01 03 01 04 01 05 01 06 01 07 01 08 01 15"),
        (SCS, table.GOAL_POSITION, {n: 391 if n % 2 else 630 for n in range(1, 9)},
         "FF FF FE 1C 83 2A 02 01 01 87 02 02 76 "
         "03 01 87 04 02 76 05 01 87 06 02 76 07 01 87 08 02 76 12"),
        (SCS, table.GOAL_POSITION, {n: 818 if n % 2 else 203 for n in range(1, 9)},
         "FF FF FE 1C 83 2A 02 01 03 32 02 00 CB "
         "03 03 32 04 00 CB 05 03 32 06 00 CB 07 03 32 08 00 CB 12"),
        (STS, table.GOAL_POSITION, {1: 2048, 2: 2048}, "FF FF FE 0A 83 2A 02 01 00 08 02 00 08 35"),
    ],
)  # fmt: skip
def test_what_is_written_to_several_is_as_published(
    family: table.Family, register: Register, values: dict[int, int], text: str
) -> None:
    data = {number: family.pack(register, value) for number, value in values.items()}
    assert sync_write(register.address, data) == [bytes.fromhex(text)]


def test_position_time_and_speed_go_to_four_servos_in_one_frame() -> None:
    data = dict.fromkeys(range(1, 5), le(2048, 0, 1000))
    assert sync_write(42, data) == [
        bytes.fromhex(
            "FF FF FE 20 83 2A 06 01 00 08 00 00 E8 03 02 00 08 00 00 E8 03 "
            "03 00 08 00 00 E8 03 04 00 08 00 00 E8 03 58"
        )
    ]


def test_more_than_a_frame_can_carry_goes_in_several() -> None:
    frames = sync_write(42, dict.fromkeys(range(100), bytes(8)))
    assert len(frames) == 4
    parsed = [frame for raw in frames for frame in RequestParser().feed(raw)]
    assert [n for frame in parsed for n in frame.params[2::9]] == list(range(100))
    assert max(len(raw) for raw in frames) <= LONGEST + 4
    assert sync_write(42, {}) == []


def test_several_are_read_together_and_one_gap_waits() -> None:
    request = bytes.fromhex("FF FF FE 06 82 38 0F 01 02 2F")
    assert sync_read(56, 15, [1, 2]) == request
    first = bytes.fromhex("FF FF 01 11 00 00 08 00 00 00 00 4A 1E 00 00 00 00 08 00 00 75")
    second = bytes.fromhex("FF FF 02 11 00 E8 03 00 00 00 00 4A 1E 00 00 00 00 08 00 00 91")
    parser = GroupParser([1, 2], 15)
    assert parser.feed(first[:-1]) == []
    assert parser.feed(first[-1:] + request) == []  # what was sent comes back
    [found] = parser.feed(second)
    states = {n: STS.measured(f.params) for n, f in found.items()}
    assert states == {1: [2048, 0, 0, 0, 30, 74], 2: [1000, 0, 0, 0, 30, 74]}
    # What came before a request does not count for the next one.
    assert parser.feed(first) == []
    parser.reset()
    assert parser.feed(second) == []
    assert parser.errors == 1  # the request that came back


def test_a_state_tells_all_at_once() -> None:
    raw = bytes.fromhex("FF FF 01 0D 00 01 FF 00 00 00 00 32 1E 00 00 00 A1")
    [reply] = ReplyParser().feed(raw)
    assert SCS.measured(reply.params) == [511, 0, 0, 0, 30, 50]
    # Backwards at 200, load -35 %, current -100 counts.
    data = le(1000, 0x8000 | 200, 0x0400 | 350) + b"\x4a\x1e\0\0\x01"
    data += bytes(2) + le(0x8000 | 100)
    assert STS.measured(data) == [1000, -200, -350, -100, 30, 74]
    assert 0x60 & Status.KNOWN == Status.OVERLOAD, "one bit has no name"


@pytest.mark.parametrize(
    ("family", "register", "value", "text"),
    [
        (STS, table.GOAL_SPEED, -1000, "E8 83"),
        (SCS, table.GOAL_SPEED, -1000, "83 E8"),
        (STS, Register(31, 2, 11), -2047, "FF 0F"),
        (HLS, Register(31, 2, 15), -4095, "FF 8F"),
        (STS, table.PRESENT_LOAD, -1, "01 04"),
        (SCS, table.MODEL, 1284, "05 04"),
        (STS, table.MODEL, 777, "09 03"),
        (STS, table.MODEL, 2825, "09 0B"),
    ],
)
def test_words_have_the_order_and_the_sign_of_their_family(
    family: table.Family, register: Register, value: int, text: str
) -> None:
    assert family.pack(register, value) == bytes.fromhex(text)
    assert family.unpack(register, bytes(register.address) + bytes.fromhex(text)) == value


@given(
    st.sampled_from(list(FAMILIES.values())),
    st.sampled_from([table.GOAL_POSITION, table.PRESENT_LOAD, table.PRESENT_CURRENT]),
    st.data(),
)
def test_signed_words_survive(
    family: table.Family, register: Register, data: st.DataObject
) -> None:
    assert register.sign is not None
    most = (1 << register.sign) - 1
    value = data.draw(st.integers(-most, most))
    packed = family.pack(register, value)
    assert family.unpack(register, packed, register.address) == value


@given(st.integers(0, LARGEST_ID), st.integers(0, 0x7F), st.binary(max_size=LONGEST - 2))
def test_frames_survive_and_are_found_in_garbage(device: int, code: int, params: bytes) -> None:
    frame = Frame(device, code, params)
    assert Frame.from_bytes(frame.to_bytes()) == frame
    for garbage in (b"", b"\x00\x13", b"\xff", b"\xff\xff\xff"):
        parser = ReplyParser()
        assert parser.feed(garbage + frame.to_bytes())[-1:] == [frame]
        assert parser.pending == 0


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("FF FE 01 02 01 FB", "begin with FF FF"),
        ("FF FF FF 02 01 FB", "begin with FF FF"),
        ("FF FF 01 03 01 FB", "declares a length"),
        ("FF FF 01 02 01 FA", "checksum"),
    ],
)
def test_what_is_no_frame_is_refused(text: str, problem: str) -> None:
    with pytest.raises(CodecError, match=problem):
        Frame.from_bytes(bytes.fromhex(text))
    assert RequestParser().feed(bytes.fromhex(text)) == []


def test_a_frame_too_long_to_send_is_refused() -> None:
    with pytest.raises(CodecError, match="a frame cannot carry 250 bytes"):
        Frame(1, WRITE, bytes(LONGEST - 1)).to_bytes()


def test_a_reply_has_no_id_of_all_and_no_large_status() -> None:
    broadcast = Frame(BROADCAST, 0).to_bytes()
    assert ReplyParser().feed(broadcast) == []
    assert RequestParser().feed(broadcast) == [Frame(BROADCAST, 0)]
    assert ReplyParser().feed(Frame(1, Instruction.SYNC_READ).to_bytes()) == []


def test_rates_and_units_are_those_of_the_vendor() -> None:
    assert [table.BAUD_RATES.index(rate) for rate in (1_000_000, 115_200, 38_400)] == [0, 4, 7]
    # 1024 positions in 300 degrees, 4096 in a turn.
    assert SCS.rad_per_count == pytest.approx(0.0051133, rel=1e-4)
    assert STS.rad_per_count == pytest.approx(0.0015340, rel=1e-4)
    # 0.0146 rpm by phase bit 2, 0.732 rpm without it and for HLS always.
    assert STS.speed_unit(12) == pytest.approx(0.0146 * 0.104720, rel=5e-3)
    assert STS.speed_unit(8) == HLS.speed_unit(12) == pytest.approx(0.732 * 0.104720, rel=1e-4)
    assert SCS.speed_unit(0) * 1368 == pytest.approx(7.0, rel=1e-3)
