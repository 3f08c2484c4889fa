"""The RH56's bytes, from the example frames of its fact sheet, and what its numbers stand for."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.modbus_frames import rtu_frame
from rtee.buses.parser import CodecError
from rtee.drivers.inspire_rh56 import codec
from rtee.drivers.inspire_rh56.codec import (
    KEEP,
    REPLY,
    REQUEST,
    Command,
    Error,
    Frame,
    Register,
    ReplyParser,
    Report,
    RequestParser,
    State,
)
from rtee.drivers.inspire_rh56.emulator import InspireRh56Emulator
from rtee.drivers.inspire_rh56.memory import Rh56Properties
from rtee.drivers.inspire_rh56.options import FORCES, MotorScale

READ, WRITE = Command.READ, Command.WRITE
OPENED = codec.table([1000] * 5 + [0])
REQUESTS = [
    ("EB 90 01 04 11 0A 06 0C 32", READ, Register.ANGLE, b"\x0c"),
    ("EB 90 01 04 11 2E 06 0C 56", READ, Register.FORCE, b"\x0c"),
    ("EB 90 01 04 11 3A 06 0C 62", READ, Register.CURRENT, b"\x0c"),
    ("EB 90 01 04 11 46 06 06 68", READ, Register.ERROR, b"\x06"),
    ("EB 90 01 04 11 4C 06 06 6E", READ, Register.STATUS, b"\x06"),
    ("EB 90 01 04 11 52 06 06 74", READ, Register.TEMPERATURE, b"\x06"),
    ("EB 90 01 04 11 E8 03 01 02", READ, Register.HAND_ID, b"\x01"),
    ("EB 90 01 04 11 0A 06 4E 74", READ, Register.ANGLE, bytes([codec.BLOCK])),
    (
        "EB 90 01 0F 12 CE 05 64 00 64 00 64 00 64 00 D0 07 00 00 5C",
        WRITE,
        Register.ANGLE_SET,
        codec.table([100, 100, 100, 100, 2000, 0]),
    ),
    (
        "EB 90 01 0F 12 CE 05 FF FF FF FF FF FF F4 01 FF FF FF FF E0",
        WRITE,
        Register.ANGLE_SET,
        codec.table([KEEP, KEEP, KEEP, 500, KEEP, KEEP]),
    ),
    (
        "EB 90 01 0F 12 F2 05 E8 03 E8 03 E8 03 E8 03 E8 03 E8 03 9B",
        WRITE,
        Register.SPEED_SET,
        codec.table([1000] * 6),
    ),
    (
        "EB 90 01 0F 12 DA 05 F4 01 F4 01 F4 01 F4 01 F4 01 F4 01 BF",
        WRITE,
        Register.FORCE_SET,
        codec.table([500] * 6),
    ),
    ("EB 90 01 04 12 EC 03 01 07", WRITE, Register.CLEAR_ERROR, b"\x01"),
    ("EB 90 01 04 12 ED 03 01 08", WRITE, Register.SAVE, b"\x01"),
    ("EB 90 01 04 12 F1 03 01 0C", WRITE, Register.FORCE_CALIBRATION, b"\x01"),
]
REPLIES = [
    (
        "90 EB 01 0F 11 0A 06 64 00 64 00 64 00 64 00 D0 07 00 00 98",
        READ,
        Register.ANGLE,
        codec.table([100, 100, 100, 100, 2000, 0]),
    ),
    (
        "90 EB 01 0F 11 0A 06 E8 03 E8 03 E8 03 E8 03 E8 03 00 00 C8",
        READ,
        Register.ANGLE,
        OPENED,
    ),
    (
        "90 EB 01 0F 11 2E 06 00 00 F4 FF 05 00 5E 01 00 00 00 00 AC",
        READ,
        Register.FORCE,
        codec.table([0, -12, 5, 350, 0, 0]),
    ),
    ("90 EB 01 09 11 46 06 00 00 00 01 00 00 68", READ, Register.ERROR, bytes([0, 0, 0, 1, 0, 0])),
    ("90 EB 01 09 11 4C 06 02 02 02 03 02 02 7A", READ, Register.STATUS, bytes([2, 2, 2, 3, 2, 2])),
    ("90 EB 01 04 12 CE 05 01 EB", WRITE, Register.ANGLE_SET, b"\x01"),
    ("90 EB 01 04 12 F2 05 01 0F", WRITE, Register.SPEED_SET, b"\x01"),
    ("90 EB 01 04 12 DA 05 01 F7", WRITE, Register.FORCE_SET, b"\x01"),
]
GOOD = bytes.fromhex(REPLIES[1][0])


@pytest.mark.parametrize(("text", "command", "address", "data"), REQUESTS)
def test_requests_of_the_sheet(text: str, command: int, address: int, data: bytes) -> None:
    raw, frame = bytes.fromhex(text), Frame(1, command, address, data)
    assert frame.to_bytes(REQUEST) == raw
    assert RequestParser().feed(raw) == [frame]
    assert ReplyParser().feed(raw) == []


@pytest.mark.parametrize(("text", "command", "address", "data"), REPLIES)
def test_replies_of_the_sheet(text: str, command: int, address: int, data: bytes) -> None:
    raw, frame = bytes.fromhex(text), Frame(1, command, address, data)
    assert frame.to_bytes(REPLY) == raw
    assert ReplyParser().feed(raw) == [frame]


@given(st.binary(max_size=60), st.integers(1, 20))
def test_a_reply_after_noise_is_found_however_it_is_cut(noise: bytes, size: int) -> None:
    parser = ReplyParser()
    # A header in the noise may announce bytes that never come: the second reply ends that.
    data = noise + GOOD + GOOD
    found = [f for at in range(0, len(data), size) for f in parser.feed(data[at : at + size])]
    assert Frame.from_bytes(GOOD) in found
    assert parser.pending <= parser.LIMIT


def test_what_no_frame_can_be_is_refused() -> None:
    for raw in (GOOD[:-1], GOOD + b"\0", GOOD[:-1] + bytes([GOOD[-1] ^ 1]), b"", b"\x90\xeb\1\3"):
        with pytest.raises(CodecError):
            Frame.from_bytes(raw)
    for data in (b"", bytes(253)):
        with pytest.raises(CodecError, match="a frame cannot carry"):
            Frame(1, READ, 1000, data).to_bytes(REPLY)


def test_a_report_comes_back() -> None:
    report = Report(
        (1000, 0, 500, -20, 1, 2),
        (0, -12, 5, 350, 0, 0),
        (0, 10, 2000, 0, 0, 0),
        (Error(0), Error.LOCKED, Error.TOO_HOT | Error.CURRENT, Error(0), Error(0), Error(0)),
        (State.OPENING, State.LOCKED, State.FAULT, State.AT_FORCE, State.CLOSING, State.AT_TARGET),
        (30, 31, 32, 33, 34, 35),
    )
    data = report.to_bytes()
    assert len(data) == codec.BLOCK
    assert Report.from_bytes(data) == report
    # The registers lie where they are addressed.
    at = Register.STATUS - Register.ANGLE
    assert data[at : at + 6] == bytes(report.states)


@pytest.mark.parametrize(("at", "value"), [(0, b"\x00\x70"), (60, b"\x20"), (65, b"\xee")])
def test_what_no_hand_reports_is_refused(at: int, value: bytes) -> None:
    data = bytearray(
        Report((0,) * 6, (0,) * 6, (0,) * 6, (Error(0),) * 6, (State(2),) * 6, (30,) * 6).to_bytes()
    )
    data[at : at + len(value)] = value
    with pytest.raises(CodecError, match="of an RH56"):
        Report.from_bytes(bytes(data))
    with pytest.raises(CodecError, match="77 bytes are not a report"):
        Report.from_bytes(bytes(data[1:]))


@pytest.mark.parametrize("value", [4, 8, 0xEE])
def test_a_state_without_a_meaning_leaves_the_other_measurements(value: int) -> None:
    data = bytearray(
        Report(
            (500,) * 6, (9,) * 6, (0,) * 6, (Error(0),) * 6, (State(2),) * 6, (30,) * 6
        ).to_bytes()
    )
    data[66] = value
    report = Report.from_bytes(bytes(data))
    assert report.states == (State.OTHER, *(State.AT_TARGET,) * 5)
    assert (report.angles, report.forces) == ((500,) * 6, (9,) * 6)


# --- what the numbers stand for -------------------------------------------------------------


def scale(finger: str, **options: bool) -> MotorScale:
    return MotorScale(0.0, 1.47, FORCES[finger], most=1000, travel_time=0.3, **options)


@pytest.mark.parametrize(
    ("finger", "grams", "newtons"),
    [
        ("index", 1000, 7.064),
        ("index", 500, 3.325),
        ("middle", 1000, 6.470),
        ("thumb_bend", 1000, 12.931),
    ],
)
def test_grams_are_the_newtons_that_were_measured(finger: str, grams: int, newtons: float) -> None:
    force = FORCES[finger]
    assert force.newtons(grams) == pytest.approx(newtons)
    assert force.newtons(-grams) == pytest.approx(-newtons)
    assert force.grams(newtons) == pytest.approx(grams)
    grip = scale(finger).grip
    assert grip.force_for(newtons * force.arm, 0.0) == pytest.approx(newtons)


@given(st.sampled_from(sorted(FORCES)), st.floats(0.0, 1000.0))
def test_forces_rise_from_zero_and_come_back(finger: str, grams: float) -> None:
    force = FORCES[finger]
    assert force.newtons(0.0) == 0.0
    assert force.newtons(grams + 1.0) > force.newtons(grams) >= 0.0
    assert force.grams(force.newtons(grams)) == pytest.approx(grams, abs=1e-6)


def test_counts_of_positions_speeds_and_limits() -> None:
    bend = scale("index")
    assert [bend.position.within(count) for count in (1000, 0, 500, 1010, -5)] == pytest.approx(
        [0.0, 1.47, 0.735, 0.0, 1.47]
    )
    assert bend.position.to_count(2.0) == 0
    assert [bend.speed(v) for v in (math.inf, 4.9, 2.45, 0.0)] == [1000, 1000, 500, 1]
    assert [bend.limit(e) for e in (math.inf, 5.0, 0.3325, 0.0)] == [1000, 1000, 500, 1]
    turned = scale("thumb_rotate", reverse=True)
    assert turned.position.within(1000) == pytest.approx(1.47)
    assert turned.effort(200) < 0.0 < scale("thumb_rotate").effort(200)


# --- the emulated hand ----------------------------------------------------------------------


def asked(hand: InspireRh56Emulator, text: str, now: float = 1.0) -> str:
    return b"".join(hand.feed(bytes.fromhex(text), now)).hex(" ").upper()


def words_at(hand: InspireRh56Emulator, address: int) -> tuple[int, ...]:
    data = hand.memory.read(address, 12)
    assert data is not None
    return codec.words(data)


def test_the_emulated_hand_answers_with_the_bytes_of_the_sheet() -> None:
    hand = InspireRh56Emulator()
    ask = "EB 90 01 0F 12 CE 05 E8 03 E8 03 E8 03 E8 03 E8 03 00 00 8C"
    assert asked(hand, ask) == "90 EB 01 04 12 CE 05 01 EB"
    reply = asked(hand, REQUESTS[0][0], 4.0)
    assert reply == REPLIES[1][0]
    assert asked(hand, REQUESTS[11][0], 4.1) == "90 EB 01 04 12 DA 05 01 F7"
    hand.inject("locked_rotor")
    assert asked(hand, REQUESTS[3][0], 4.2) == REPLIES[3][0]
    hand.clear()
    assert asked(hand, REQUESTS[12][0], 4.3) == "90 EB 01 04 12 EC 03 01 07"
    assert asked(hand, REQUESTS[3][0], 4.4) == "90 EB 01 09 11 46 06 00 00 00 00 00 00 67"


def test_one_finger_is_commanded_by_a_part_of_a_table() -> None:
    hand = InspireRh56Emulator()
    # As sent by a published client to a real hand: 976 to the index finger alone.
    assert asked(hand, "EB 90 01 05 12 D4 05 D0 03 C4") == "90 EB 01 04 12 D4 05 01 F1"
    assert words_at(hand, Register.ANGLE_SET) == (KEEP, KEEP, KEEP, 976, KEEP, KEEP)
    states = hand.memory.read(Register.STATUS, 6)
    assert states == bytes([0xFF, 0xFF, 0xFF, State.CLOSING, 0xFF, 0xFF])
    assert asked(hand, "EB 90 01 05 12 D5 05 D0 03 C5").endswith("12 D5 05 00 F1"), "not a register"
    speeds = Frame(1, WRITE, Register.SPEED_SET + 8, (300).to_bytes(2, "little") * 2)
    asked(hand, speeds.to_bytes(REQUEST).hex())
    assert words_at(hand, Register.SPEED_SET) == (1000, 1000, 1000, 1000, 300, 300)
    modbus = InspireRh56Emulator(Rh56Properties(protocol="modbus", framing="tcp"))
    assert asked(modbus, "00 01 00 00 00 06 01 06 05 D4 03 D0").endswith("01 06 05 D4 03 D0")
    assert words_at(modbus, Register.ANGLE_SET)[3] == 976


def test_it_tells_the_result_of_saving_by_a_second_frame() -> None:
    hand = InspireRh56Emulator()
    assert asked(hand, "EB 90 01 04 12 ED 03 01 08", 1.0) == "90 EB 01 04 12 ED 03 01 08"
    assert hand.step(1.5) == []
    assert hand.step(2.1) == [bytes.fromhex("90 EB 01 04 12 ED 03 01 08")]
    assert hand.step(9.0) == []


def test_its_supply_reads_as_that_of_real_hands() -> None:
    told = asked(InspireRh56Emulator(), "EB 90 01 04 11 C0 05 02 DD")
    assert 557 <= int.from_bytes(bytes.fromhex(told)[7:9], "little") <= 562


def test_it_speaks_modbus_on_a_line_where_told_to() -> None:
    hand = InspireRh56Emulator(Rh56Properties(protocol="modbus"))
    request = rtu_frame(1, bytes.fromhex("03 06 0A 00 06"))
    assert asked(hand, request.hex()).startswith("01 03 0C 03 E8")


def test_it_is_silent_or_refuses_where_it_must() -> None:
    hand = InspireRh56Emulator(Rh56Properties(unknown="refused"))
    assert asked(hand, "EB 90 01 04 11 0A 06 0C 33") == "", "a wrong checksum"
    assert asked(hand, "EB 90 02 04 11 0A 06 0C 33") == "", "another hand"
    assert asked(hand, REQUESTS[7][0]) == "", "registers without meaning"
    for count in (0, 253, 255):
        request = Frame(1, READ, Register.HAND_ID, bytes([count])).to_bytes(REQUEST)
        assert asked(hand, request.hex()) == "", "more than a frame can carry, or nothing"
    over = Frame(1, WRITE, Register.SPEED_SET, codec.table([1001] * 6))
    assert asked(hand, over.to_bytes(REQUEST).hex()).endswith("12 F2 05 00 0E")


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        (
            "00 01 00 00 00 13 01 10 05 CE 00 06 0C 03 E8 03 E8 03 E8 03 E8 03 E8 00 00",
            "00 01 00 00 00 06 01 10 05 CE 00 06",
        ),
        (
            "00 02 00 00 00 06 01 03 06 0A 00 06",
            "00 02 00 00 00 0F 01 03 0C 03 E8 03 E8 03 E8 03 E8 03 E8 03 E8",
        ),
        ("00 03 00 00 00 06 01 03 06 46 00 03", "00 03 00 00 00 09 01 03 06 00 00 00 00 00 00"),
    ],
)
def test_it_answers_over_modbus_as_in_the_sheet(request_: str, reply: str) -> None:
    hand = InspireRh56Emulator(Rh56Properties(protocol="modbus", framing="tcp"))
    assert asked(hand, request_) == reply
