"""Modbus frames by their bytes."""

from __future__ import annotations

import random

import pytest

from rtee.buses.modbus_frames import (
    RtuRequests,
    TcpRequests,
    answer_head,
    crc16,
    find_answer,
    find_network_answer,
    rtu_frame,
)


@pytest.mark.parametrize(
    ("data", "crc"),
    [
        ("A1B2C3D4E5F6", "97DA"),
        ("E212F1FF00D2", "2D0B"),
        ("FFFFFFFFFFFF", "0194"),
        ("000000000000", "001B"),
        ("313233343536373839", "374B"),
        ("80000003", "69E5"),
    ],
)
def test_the_crc_is_that_of_modbus(data: str, crc: str) -> None:
    assert crc16(bytes.fromhex(data)) == bytes.fromhex(crc)


REQUESTS = [
    "09 10 03 E8 00 03 06 01 00 00 00 00 00 72 E1",
    "09 04 07 D0 00 01 30 0F",
    "09 03 07 D0 00 03 04 0E",
    "09 17 07 D0 00 02 03 E9 00 02 04 00 E6 3C C8 2D 0C",
    "09 10 03 E8 00 01 02 09 00 E3 E8",
]


@pytest.mark.parametrize("frame", REQUESTS)
@pytest.mark.parametrize("noise", [b"", b"\x09", b"\x09\x10", b"\xff\x00\x09\x03", bytes(40)])
def test_a_request_is_found_behind_noise_byte_by_byte(frame: str, noise: bytes) -> None:
    raw = bytes.fromhex(frame)
    parser = RtuRequests(9)
    found = [r for byte in noise + raw for r in parser.feed(bytes([byte]))]
    assert [(r.unit, r.pdu) for r in found] == [(9, raw[1:-2])]
    assert parser.pending == 0


def test_requests_to_other_slaves_are_skipped() -> None:
    parser = RtuRequests(9)
    other = rtu_frame(8, bytes.fromhex("0307D00003"))
    mine = bytes.fromhex(REQUESTS[1])
    assert [r.pdu for r in parser.feed(other + mine + other + mine)] == [mine[1:-2]] * 2


@pytest.mark.parametrize("kind", [RtuRequests, TcpRequests])
def test_any_bytes_leave_a_bounded_buffer_and_one_good_frame_is_heard(
    kind: type[RtuRequests] | type[TcpRequests],
) -> None:
    chance = random.Random(7)
    good = bytes.fromhex(REQUESTS[3])
    if kind is TcpRequests:
        good = b"\x12\x34\0\0\0\x06\x41\x03\x01\x00\x00\x04"
    heard = 0
    for _ in range(2000):
        parser = RtuRequests(9) if kind is RtuRequests else TcpRequests()
        noise = chance.randbytes(chance.randrange(300))
        if kind is TcpRequests:
            noise = noise.replace(b"\0\0", b"\1\1")
        parser.feed(noise)
        assert parser.pending <= 260
        heard += len(parser.feed(good))
    assert heard >= 2000


def test_an_answer_is_found_behind_noise() -> None:
    answer = bytes.fromhex("09 04 02 31 00 4D 61")
    data = b"\x09\x04\x02\x00" + answer + b"\x00"
    assert find_answer(data, 9, 4) == (4, 11)
    assert find_answer(data, 9, 3) == (-1, -1)
    assert find_answer(answer[:-1], 9, 4) == (-1, -1)


def test_only_the_answer_to_the_request_is_taken() -> None:
    long, short = rtu_frame(9, bytes([3, 4, 0, 1, 0, 2])), rtu_frame(9, bytes([3, 2, 0, 5]))
    assert find_answer(long + short, 9, 3, answer_head(3, 0, 1)) == (9, 16)
    assert find_answer(short + long, 9, 3, answer_head(3, 0, 2)) == (7, 16)
    other, mine = (rtu_frame(9, bytes([16, 0, at, 0, 1])) for at in (4, 5))
    assert find_answer(other, 9, 16, answer_head(16, 5, 1)) == (-1, -1)
    assert find_answer(other + mine, 9, 16, answer_head(16, 5, 1)) == (8, 16)


def test_an_answer_on_a_network_is_found_by_its_number() -> None:
    frame = bytes.fromhex("0002 0000 0005 41 03 02 00 07")
    head = answer_head(3, 0, 1)
    assert find_network_answer(b"\x00\x00" + frame, 2, 65, 3, head) == (2, 13)
    for number, unit, function in ((1, 65, 3), (2, 64, 3), (2, 65, 4)):
        assert find_network_answer(frame, number, unit, function, head) == (-1, -1)
    assert find_network_answer(frame, 2, 65, 3, answer_head(3, 0, 2)) == (-1, -1)
    assert find_network_answer(frame[:-1], 2, 65, 3, head) == (-1, -1)
    refusal = bytes.fromhex("0002 0000 0003 41 83 02")
    assert find_network_answer(refusal, 2, 65, 3, head) == (0, 9)


@pytest.mark.parametrize("cut", range(1, 19))
def test_an_incomplete_request_on_a_network_costs_no_other(cut: int) -> None:
    write = bytes.fromhex("339A0000000D0210000000030601000000 0000")
    read = bytes.fromhex("000200000006410301000004")
    parser = TcpRequests()
    assert parser.feed(write[:cut]) == []
    assert [r.pdu for r in parser.feed(read)] == [read[7:]]
    whole = [r.pdu for piece in (write[:cut], write[cut:], read) for r in parser.feed(piece)]
    assert whole == [write[7:], read[7:]]


def test_an_exception_is_an_answer() -> None:
    frame = rtu_frame(9, b"\x97\x01")
    assert find_answer(frame, 9, 0x17) == (0, 5)
