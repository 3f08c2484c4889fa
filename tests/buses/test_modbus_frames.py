"""Modbus frames by their bytes."""

from __future__ import annotations

import random
import struct

import pytest
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
)

from rtee.buses.modbus_frames import AnswerParser, RtuRequests, TcpRequests, crc16, rtu_frame


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


def asking(
    function: int,
    address: int = 0,
    count: int = 1,
    *,
    unit: int = 9,
    number: int | None = None,
) -> AnswerParser:
    """Return the parser of the answer to a request, on TCP where it has a number."""
    kinds: dict[int, type[ModbusPDU]] = {
        3: ReadHoldingRegistersRequest,
        4: ReadInputRegistersRequest,
        16: WriteMultipleRegistersRequest,
    }
    values = [0] * count if function == 16 else []
    request = kinds[function](dev_id=unit, address=address, count=count, registers=values)
    head = struct.pack(">HH", address, count) if function == 16 else bytes([2 * count])
    decoder = DecodePDU(is_server=False)
    framer = FramerRTU(decoder) if number is None else FramerSocket(decoder)
    parser = AnswerParser(framer, request, head)
    parser.request(number or 0)
    return parser


def test_an_answer_is_found_behind_noise() -> None:
    answer = bytes.fromhex("09 04 02 31 00 4D 61")
    noise = b"\x09\x04\x02\x00"
    [found] = asking(4).feed(noise + answer + b"\x00")
    assert found.registers == [0x3100]
    parser = asking(4)
    pieces = [parser.feed(bytes([byte])) for byte in noise + answer]
    assert [found.registers for piece in pieces for found in piece] == [[0x3100]]
    assert asking(3).feed(noise + answer) == []
    assert asking(4, unit=8).feed(noise + answer) == []
    assert asking(4).feed(answer[:-1]) == []


def test_only_the_answer_to_the_request_is_taken() -> None:
    long, short = rtu_frame(9, bytes([3, 4, 0, 1, 0, 2])), rtu_frame(9, bytes([3, 2, 0, 5]))
    assert [a.registers for a in asking(3).feed(long + short)] == [[5]]
    assert [a.registers for a in asking(3, count=2).feed(short + long)] == [[1, 2]]
    other, mine = (rtu_frame(9, bytes([16, 0, at, 0, 1])) for at in (4, 5))
    assert asking(16, 5).feed(other) == []
    assert [a.address for a in asking(16, 5).feed(other + mine)] == [5]


def test_a_damaged_answer_is_none_and_is_counted_once_per_attempt() -> None:
    damaged = bytes.fromhex("09 04 02 31 01 4D 61")
    parser = asking(4)
    for attempts in (1, 2):
        parser.reset()
        assert parser.feed(damaged[:3]) == parser.feed(damaged[3:]) == []
        assert parser.errors == attempts
    parser.reset()
    assert len(parser.feed(bytes.fromhex("09 04 02 31 00 4D 61"))) == 1
    assert parser.errors == 2


def test_an_answer_on_a_network_is_found_by_its_number() -> None:
    frame = bytes.fromhex("0002 0000 0005 41 03 02 00 07")
    [found] = asking(3, unit=65, number=2).feed(b"\x00\x00" + frame)
    assert found.registers == [7]
    for number, unit, function in ((1, 65, 3), (2, 64, 3), (2, 65, 4)):
        assert asking(function, unit=unit, number=number).feed(frame) == []
    assert asking(3, count=2, unit=65, number=2).feed(frame) == []
    assert asking(3, unit=65, number=2).feed(frame[:-1]) == []
    [refusal] = asking(3, unit=65, number=2).feed(bytes.fromhex("0002 0000 0003 41 83 02"))
    assert refusal.exception_code == 2


def test_a_device_that_counts_behind_is_heard_where_that_is_allowed() -> None:
    request = ReadHoldingRegistersRequest(dev_id=1, address=1, count=1)
    framer = FramerSocket(DecodePDU(is_server=False))
    answers = [bytes.fromhex(f"00 0{n} 00 00 00 05 01 03 02 00 2A") for n in (5, 4, 3)]
    for behind, taken in ((0, [1, 0, 0]), (1, [1, 1, 0])):
        for answer, times in zip(answers, taken, strict=True):
            parser = AnswerParser(framer, request, b"\x02", behind)
            parser.request(5)
            assert len(parser.feed(answer)) == times
    # The number before 0 is the largest one of two bytes.
    parser = AnswerParser(framer, request, b"\x02", 1)
    parser.request(0)
    assert len(parser.feed(bytes.fromhex("FFFF 0000 0005 01 03 02 00 2A"))) == 1


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
    [refusal] = asking(3).feed(rtu_frame(9, b"\x83\x01"))
    assert isinstance(refusal, ExceptionResponse)
    assert refusal.exception_code == 1
