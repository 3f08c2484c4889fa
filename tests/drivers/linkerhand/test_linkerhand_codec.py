"""The LinkerHands' bytes, from the example frames of their fact sheet."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.emulator import CanFrame
from rtee.buses.modbus_frames import rtu_frame
from rtee.buses.parser import CodecError
from rtee.drivers.linkerhand import codec
from rtee.drivers.linkerhand.codec import L10, O6, Side, Table, Version
from rtee.drivers.linkerhand.emulator import LinkerHandEmulator, LinkerProperties
from rtee.errors import FrameError

OPEN = [255, 70, 255, 255, 255, 255]
FIST = [67, 151, 0, 0, 0, 0]


def hand(model: str = "o6", unit: int = 0x27) -> LinkerHandEmulator:
    return LinkerHandEmulator(LinkerProperties(model=model, unit=unit))  # type: ignore[arg-type]


def asked(emulator: LinkerHandEmulator, request: str, now: float = 0.0) -> str:
    return " ".join(a.hex(" ").upper() for a in emulator.feed(bytes.fromhex(request), now))


def test_an_o6_answers_with_the_bytes_of_the_sheet() -> None:
    o6 = hand()
    for axis, count in zip(o6.axes, OPEN, strict=True):
        axis.position = axis.target = float(count)
    positions = "27 04 0C 00 FF 00 46 00 FF 00 FF 00 FF 00 FF 71 B2"
    assert asked(o6, "27 04 00 00 00 06 77 0E") == positions
    # 6 motors, a right hand, versions 1.0 and 1.0.
    version = "27 04 0C 00 06 00 01 00 01 00 52 00 10 00 10 89 B0"
    assert asked(o6, "27 04 00 1E 00 06 17 08") == version
    everything = asked(o6, "27 04 00 00 00 12 77 01")
    assert everything.startswith("27 04 24 00 FF 00 46")
    assert asked(o6, "27 04 00 12 00 06 D7 0B").startswith("27 04 0C 00 19")
    assert asked(o6, "27 04 00 18 00 06 F7 09").startswith("27 04 0C 00 00")
    assert not asked(o6, "28 04 00 00 00 06 77 F1"), "that was for the left hand"
    assert asked(hand(unit=0x28), "28 04 00 00 00 06 77 F1").startswith("28 04 0C")
    beyond = rtu_frame(0x27, bytes.fromhex("04 00 C8 00 06"))
    assert o6.feed(beyond, 0.0) == [bytes.fromhex("27 84 02 23 0A")]


@pytest.mark.parametrize(
    ("request_", "table", "values"),
    [
        (
            "27 10 00 00 00 06 0C 00 FF 00 46 00 FF 00 FF 00 FF 00 FF 4B 87",
            Table.POSITION,
            OPEN,
        ),
        (
            "27 10 00 00 00 06 0C 00 43 00 97 00 00 00 00 00 00 00 00 D9 2B",
            Table.POSITION,
            FIST,
        ),
        ("27 10 00 06 00 06 0C" + " 00 C8" * 6 + " 43 E8", Table.TORQUE, [200] * 6),
        ("27 10 00 0C 00 06 0C" + " 00 C8" * 6 + " C5 4F", Table.SPEED, [200] * 6),
    ],
)
def test_an_o6_obeys_the_writes_of_the_sheet(
    request_: str, table: Table, values: list[int]
) -> None:
    o6 = hand()
    answer = asked(o6, request_)
    assert answer[:17] == request_[:17]
    if table is Table.POSITION:
        assert answer == "27 10 00 00 00 06 47 0D"
        assert [axis.target for axis in o6.axes] == values
    else:
        assert o6.table(table) == values
        assert o6.moves == 0


def test_an_o6_takes_all_it_can_be_told_in_one_frame() -> None:
    o6 = hand()
    request = "27 10 00 00 00 12 24 00 FF 00 46 00 FF 00 FF 00 FF 00 FF" + " 00 C8" * 12 + " 5C FA"
    assert asked(o6, request).startswith("27 10 00 00 00 12")
    assert [axis.target for axis in o6.axes] == OPEN
    assert o6.table(Table.TORQUE) == o6.table(Table.SPEED) == [200] * 6
    assert o6.begun == [200] * 6, "the torques were in force before the motion"


def test_a_fault_has_its_code_where_the_sheet_has_it() -> None:
    o6 = hand()
    o6.inject("over_temperature")
    # The sheet's example has it on the thumb, this hand on the index finger.
    codes = asked(o6, "27 04 00 18 00 06 F7 09")
    assert codes.startswith("27 04 0C 00 00 00 00 00 02")
    assert codec.checked([2, 0, 0, 0, 0, 0], 6) == (2, 0, 0, 0, 0, 0)
    assert codec.FAULT_NAMES[2] == "over-temperature"


def test_an_l10_answers_the_requests_of_the_sheet() -> None:
    l10 = hand("l10")
    assert asked(l10, "27 04 00 00 00 0A 77 0B").startswith("27 04 14 00 FF")
    write = "27 10 00 00 00 0A 14 00 FF 00 46" + " 00 FF" * 4 + " 00 80" * 3 + " 00 46 E5 0B"
    assert asked(l10, write) == "27 10 00 00 00 0A 47 08"
    assert [axis.target for axis in l10.axes] == [255, 70, *[255] * 4, *[128] * 3, 70]
    assert asked(l10, "27 10 00 14 00 0A 14" + " 00 C8" * 10 + " 27 2C").startswith("27 10 00 14")
    assert l10.table(Table.SPEED) == [200] * 10
    assert asked(l10, "27 04 00 28 00 0A F7 03").startswith("27 04 14 00 19")
    assert asked(l10, "27 04 00 32 00 0A D6 C4").startswith("27 04 14 00 00")
    assert asked(l10, "27 04 00 9E 00 06 16 E0").startswith("27 04 0C 00 0A 00 01 00 01 00 52")


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("27 10 00 00 00 01 02 01 00", 3),  # 256 is not a value of a byte
        ("27 10 00 12 00 01 02 00 01", 2),  # temperatures cannot be set
        ("27 03 00 00 00 06", 1),  # function 3 is not known
    ],
)
def test_what_the_hand_does_not_have_is_refused(request_: str, code: int) -> None:
    raw = bytes.fromhex(request_)
    answer = hand().feed(rtu_frame(raw[0], raw[1:]), 0.0)
    assert [a[1:3] for a in answer] == [bytes([raw[1] | 0x80, code])]


def test_frames_on_can_are_those_of_the_sheet() -> None:
    opened = codec.property_frame(0x27, 0x01, OPEN)
    assert (opened.id, opened.data) == (0x27, bytes.fromhex("01 FF 46 FF FF FF FF"))
    assert codec.query(0x27, 0x33).data == b"\x33"
    o6 = hand()
    assert o6.on_frame(opened, 0.0) == []
    assert [axis.target for axis in o6.axes] == OPEN
    [answer] = o6.on_frame(codec.query(0x27, 0x33), 0.0)
    assert (answer.id, answer.data) == (0x27, bytes([0x33, *[25] * 6]))
    assert codec.answers(answer, 0x27, 0x33, 6)


@pytest.mark.parametrize("code", [0x64, 0xC2])
def test_the_version_is_told_on_can(code: int) -> None:
    hand = LinkerHandEmulator()
    [answer] = hand.on_frame(CanFrame(0x27, bytes([code])), 1.0)
    assert (answer.id, answer.data) == (0x27, bytes([code, 6, 1, 1, 82, 0x10, 0x10]))


def test_an_l10_has_its_values_in_two_parts_on_can() -> None:
    l10 = hand("l10")
    l10.on_frame(codec.property_frame(0x27, 0x04, [10, 20, 30, 40]), 0.0)
    l10.on_frame(codec.property_frame(0x27, 0x06, [1, 2, 3, 4, 5]), 0.0)
    assert [axis.target for axis in l10.axes[6:]] == [10.0, 20.0, 30.0, 40.0]
    assert l10.table(Table.SPEED) == [*[255] * 5, 1, 2, 3, 4, 5]
    [answer] = l10.on_frame(codec.query(0x27, 0x04), 0.0)
    assert answer.data == bytes([0x04, 128, 128, 128, 255])


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(0x28, b"\x01" + bytes(6)),
        CanFrame(0x27, b"\x02" + bytes(6)),
        CanFrame(0x27, b"\x01" + bytes(5)),
        CanFrame(0x27, b"\x01"),
        CanFrame(0x27, b""),
        CanFrame(0x27, b"\x01" + bytes(6), remote=True),
        CanFrame(0x27, b"\x01" + bytes(6), extended=True),
    ],
)
def test_other_frames_are_no_answer(frame: CanFrame) -> None:
    assert not codec.answers(frame, 0x27, 0x01, 6)


def test_tables_have_a_value_for_each_motor() -> None:
    for model in (O6, L10):
        assert len(model.ranges) == model.count
        for block in model.tables.values():
            assert sum(count for _, count in block.properties) == model.count
    with pytest.raises(CodecError, match="not 6 values"):
        codec.checked([1, 2], 6)
    with pytest.raises(CodecError, match="not 2 values"):
        codec.checked([1, 256], 2)


@given(
    st.builds(
        Version,
        *(st.integers(0, 255) for _ in range(3)),
        st.sampled_from(Side),
        *(st.integers(0, 255) for _ in range(2)),
    )
)
def test_versions_survive_their_registers(version: Version) -> None:
    assert Version.from_registers(version.to_registers()) == version


@given(st.lists(st.integers(0, 65535), max_size=8))
def test_versions_are_read_or_refused(registers: list[int]) -> None:
    try:
        found = Version.from_registers(registers)
    except FrameError:
        assert len(registers) < 6 or registers[3] not in (76, 82)
    else:
        assert found.to_registers() == tuple(registers[:6])


def test_versions_are_nibbles() -> None:
    assert codec.dotted(0x10) == "1.0"
    assert codec.dotted(0x2F) == "2.15"
