"""The WSG 50's frames by the bytes of its sheet, and what is not a frame."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.parser import CodecError
from rtee.drivers.wsg50.codec import (
    Command,
    Frame,
    FrameParser,
    Grasping,
    Info,
    Limits,
    State,
    Status,
    acknowledge,
    answer,
    asking,
    crc,
    grasp,
    grasping_of,
    home,
    move,
    number,
    numbers,
    release,
    setting,
    state_of,
)

REQUESTS = [
    ("01 02 00 12 34 6D 66", Frame(0x01, b"\x12\x34")),
    ("01 00 00 E8 10", Frame(0x01)),
    ("06 02 00 01 02 E8 E3", Frame(Command.LOOP, b"\x01\x02")),
    ("07 00 00 35 4C", Frame(Command.DISCONNECT)),
    ("20 01 00 00 8F 83", home()),
    ("21 09 00 00 00 00 F0 41 00 00 C8 42 C0 4A", move(30.0, 100.0, stop_on_block=False)),
    ("21 09 00 02 00 00 F0 41 00 00 C8 42 4A 89", move(30.0, 100.0, stop_on_block=True)),
    ("22 00 00 0E 76", Frame(Command.STOP)),
    ("23 00 00 AC 1C", Frame(Command.FAST_STOP)),
    ("24 03 00 61 63 6B DC B9", acknowledge()),
    ("25 08 00 00 00 20 42 00 00 48 42 83 5C", grasp(40.0, 50.0)),
    ("26 08 00 00 00 A0 42 00 00 C8 42 96 91", release(80.0, 100.0)),
    ("30 04 00 00 00 7A 44 BC 38", setting(Command.SET_ACCELERATION, 1000.0)),
    ("31 00 00 68 A5", Frame(Command.ACCELERATION)),
    ("32 04 00 00 00 A0 41 F5 22", setting(Command.SET_FORCE, 20.0)),
    ("33 00 00 2C 70", Frame(Command.FORCE_LIMIT)),
    ("34 08 00 00 00 A0 40 00 00 D2 42 43 48", setting(Command.SET_SOFT_LIMITS, 5.0, 105.0)),
    ("36 00 00 17 93", Frame(Command.CLEAR_SOFT_LIMITS)),
    ("38 00 00 EA CF", Frame(Command.TARE)),
    ("40 03 00 00 00 00 F5 70", asking(Command.STATE)),
    ("40 03 00 01 64 00 5B 1E", Frame(Command.STATE, b"\x01\x64\x00")),
    ("41 03 00 00 00 00 DE 42", asking(Command.GRASPING)),
    ("43 03 00 00 00 00 B8 10", asking(Command.WIDTH)),
    ("43 03 00 01 32 00 1C 78", Frame(Command.WIDTH, b"\x01\x32\x00")),
    ("44 03 00 00 00 00 3C D1", asking(Command.SPEED)),
    ("45 03 00 00 00 00 17 E3", asking(Command.FORCE)),
    ("46 03 00 00 00 00 5A 83", asking(Command.TEMPERATURE)),
    ("50 00 00 DB 87", Frame(Command.INFO)),
    ("53 00 00 3D 38", Frame(Command.LIMITS)),
]

ANSWERS = [
    ("06 04 00 00 00 01 02 AD 2E", answer(Command.LOOP, Status.OK, b"\x01\x02")),
    ("07 02 00 00 00 62 0E", answer(Command.DISCONNECT, Status.OK)),
    ("20 02 00 1A 00 FC 32", answer(Command.HOME, Status.PENDING)),
    ("20 02 00 00 00 B3 FD", answer(Command.HOME, Status.OK)),
    ("21 02 00 1A 00 67 CB", answer(Command.MOVE, Status.PENDING)),
    ("21 02 00 00 00 28 04", answer(Command.MOVE, Status.OK)),
    ("21 02 00 1C 00 8D 72", answer(Command.MOVE, Status.RANGE)),
    ("21 02 00 03 00 DD 58", answer(Command.MOVE, Status.NOT_REFERENCED)),
    ("21 02 00 1D 00 DE 46", answer(Command.MOVE, Status.AXIS_BLOCKED)),
    ("21 02 00 10 00 48 22", answer(Command.MOVE, Status.ACCESS_DENIED)),
    ("21 02 00 13 00 BD 7E", answer(Command.MOVE, Status.ABORTED)),
    ("24 02 00 00 00 B9 7E", answer(Command.ACKNOWLEDGE, Status.OK)),
    ("25 02 00 1A 00 6D 48", answer(Command.GRASP, Status.PENDING)),
    ("25 02 00 12 00 E4 C9", answer(Command.GRASP, Status.FAILED)),
    ("30 06 00 00 00 00 00 16 43 DC CB", answer(0x30, Status.OK, struct.pack("<f", 150.0))),
    ("32 02 00 00 00 9C 93", answer(Command.SET_FORCE, Status.OK)),
    ("90 02 00 0E 00 FD 02", answer(0x90, Status.UNKNOWN_COMMAND)),
]


def raw(text: str) -> bytes:
    return bytes.fromhex("AA AA AA" + text)


@pytest.mark.parametrize(("text", "frame"), REQUESTS + ANSWERS)
def test_a_frame_is_the_sheets(text: str, frame: Frame) -> None:
    assert frame.to_bytes() == raw(text)
    assert Frame.from_bytes(raw(text)) == frame
    assert crc(raw(text)) == 0
    assert FrameParser().feed(raw(text)) == [frame]


def test_after_the_preamble_the_checksum_is_the_sheets() -> None:
    assert crc(b"\xaa\xaa\xaa") == 0x50F5


def test_measurements_are_read_from_the_sheets_answers() -> None:
    state = Frame.from_bytes(raw("40 06 00 00 00 C1 00 00 00 E6 BF"))
    assert state_of(state) == State.REFERENCED | State.STOPPED | State.REACHED
    grasping = Frame.from_bytes(raw("41 03 00 00 00 04 5A 02"))
    assert grasping_of(grasping) is Grasping.HOLDING
    assert number(Frame.from_bytes(raw("43 06 00 00 00 00 00 F0 41 39 34"))) == 30.0
    assert number(Frame.from_bytes(raw("45 06 00 00 00 00 00 A0 41 42 D9"))) == 20.0
    info = Frame.from_bytes(raw("50 0A 00 00 00 02 01 00 40 D2 04 00 00 43 4A"))
    found = Info.from_bytes(info.payload[2:])
    assert found == Info(2, 1, 0x4000, 1234)
    assert found.version == "4.0.0"
    limits = Frame.from_bytes(
        raw(
            "53 22 00 00 00 00 00 DC 42 00 00 A0 40 00 00 D2 43 00 00 C8 42 00 40 9C 45"
            "00 00 A0 40 00 00 A0 42 00 00 F0 42 4A 0C"
        )
    )
    assert Limits.from_frame(limits) == Limits()
    assert answer(Command.LIMITS, Status.OK, Limits().to_bytes()) == limits


def test_a_temperature_is_in_tenths() -> None:
    frame = Frame.from_bytes(raw("46 04 00 00 00 FA 00 A6 30"))
    assert int.from_bytes(frame.payload[2:], "little") == 250


@pytest.mark.parametrize(
    "frame",
    [
        Frame(0x53, b"\0\0" + struct.pack("<8f", -1, 5, 420, 100, 5000, 5, 80, 120)),
        Frame(0x53, b"\0\0" + struct.pack("<8f", 110, 5, 420, 100, 5000, 80, 5, 120)),
        Frame(0x53, b"\0\0" + struct.pack("<7f", *range(7))),
        Frame(0x53, b"\0\0" + struct.pack("<8f", *[float("nan")] * 8)),
    ],
)
def test_limits_that_are_none_are_refused(frame: Frame) -> None:
    with pytest.raises(CodecError):
        Limits.from_frame(frame)


@pytest.mark.parametrize("payload", [b"", b"\0", b"\xff\0"])
def test_an_answer_without_a_known_status_is_refused(payload: bytes) -> None:
    with pytest.raises(CodecError):
        _ = Frame(0x40, payload).status


def test_what_is_no_number_state_or_grasp_is_refused() -> None:
    with pytest.raises(CodecError):
        numbers(Frame(0x43, b"\0\0\0\0\0"), 1)
    with pytest.raises(CodecError):
        state_of(Frame(0x40, b"\0\0\0"))
    with pytest.raises(CodecError):
        grasping_of(Frame(0x41, b"\0\0\x08"))


@given(st.lists(st.binary(max_size=40), max_size=6), st.integers(1, 7))
def test_frames_are_found_between_garbage(between: list[bytes], size: int) -> None:
    stream, wanted = b"", []
    for i, noise in enumerate(between):
        frame = answer(Command.WIDTH, Status.OK, struct.pack("<f", float(i)))
        # Noise that begins like a frame may swallow one, which is another property.
        stream += noise.replace(b"\xaa", b"\xab") + frame.to_bytes()
        wanted.append(frame)
    parser, found = FrameParser(), []
    for at in range(0, len(stream), size):
        found += parser.feed(stream[at : at + size])
    assert found == wanted


@given(st.binary(max_size=300))
def test_any_bytes_are_a_frame_or_refused(data: bytes) -> None:
    try:
        frame = Frame.from_bytes(data)
    except CodecError:
        return
    assert frame.to_bytes() == data
