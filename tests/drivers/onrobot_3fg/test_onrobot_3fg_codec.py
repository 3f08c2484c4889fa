"""The 3FG's registers by the frames of its sheet, and its units there and back."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.modbus_frames import rtu_frame
from rtee.drivers.onrobot_3fg.codec import (
    Command,
    Control,
    Fingers,
    GripType,
    Status,
    scale_of,
)
from rtee.drivers.onrobot_common import serial_number
from rtee.errors import FrameError


def test_all_four_targets_are_one_frame() -> None:
    command = Command(500, 750, GripType.EXTERNAL, Control.GRIP)
    pdu = bytes.fromhex("100000000408") + struct.pack(">4H", *command.to_registers())
    assert rtu_frame(0x41, pdu) == bytes.fromhex(
        "41 10 00 00 00 04 08 01 F4 02 EE 00 00 00 01 AA 7C"
    )
    assert Command.from_registers(command.to_registers()) == command


@pytest.mark.parametrize(
    ("frame", "status"),
    [
        (
            "41 03 08 00 09 05 14 04 96 00 00 88 5C",
            Status(busy=True, calibrated=True, raw_diameter=1300, diameter=1174),
        ),
        (
            "41 03 08 00 0E 02 EE 02 70 01 F4 C6 57",
            Status(False, True, True, True, 750, 624, 500),
        ),
    ],
)
def test_a_status_is_the_sheets_frame(frame: str, status: Status) -> None:
    raw = bytes.fromhex(frame)
    assert Status.from_registers(struct.unpack(">4H", raw[3:-2])) == status
    pdu = b"\x03\x08" + struct.pack(">4H", *status.to_registers())
    assert rtu_frame(0x41, pdu) == raw


def test_the_diameter_with_offset_is_signed() -> None:
    assert Status.from_registers((8, 40, 0xFFAC, 0)).diameter == -84
    assert Status(diameter=-84).to_registers()[2] == 0xFFAC


def test_what_is_no_status_or_command_is_refused() -> None:
    with pytest.raises(FrameError, match="not a valid status of a 3FG"):
        Status.from_registers((0x0100, 0, 0, 0))
    with pytest.raises(FrameError, match="not a valid command of a 3FG"):
        Command.from_registers((0, 0, 0, 3))


@given(st.tuples(*[st.integers(0, 0xFFFF)] * 4))
def test_any_registers_are_a_status_or_refused(found: tuple[int, ...]) -> None:
    try:
        status = Status.from_registers(found)
    except FrameError:
        return
    assert status.to_registers() == found


def test_every_diameter_and_force_comes_back() -> None:
    scale = scale_of(0.0, 2.9)
    for register in range(346, 1501):
        assert scale.position.to_count(scale.position.to_si(register)) == register
    for register in range(1001):
        assert scale.effort.to_count(scale.effort.to_si(register)) == register
    assert scale.position.to_si(1500) == pytest.approx(0.0, abs=1e-12)
    assert scale.position.to_si(346) == pytest.approx(2.9)
    assert scale.position.to_count(3.5) == 346
    assert scale.effort.to_count(math.inf) == 1000


def test_effort_follows_from_force_by_virtual_work() -> None:
    scale = scale_of(0.0, 2.9)
    work = 240.0 * (scale.position.to_raw(1.0) - scale.position.to_raw(1.1)) * 1e-4
    assert scale.effort.to_si(1000) * 0.1 == pytest.approx(work)


@pytest.mark.parametrize("position", [1, 2, 3])
def test_the_angle_of_the_levers_comes_back(position: int) -> None:
    fingers = Fingers(position=position)
    for degrees in range(30, 166, 5):
        angle = math.radians(degrees)
        assert fingers.angle(fingers.raw_diameter(angle)) == pytest.approx(angle)


def test_an_object_is_thinner_outside_and_wider_inside_than_the_centres() -> None:
    fingers = Fingers(offset=0.0063)
    assert fingers.diameter(0.130, GripType.EXTERNAL) == pytest.approx(0.1174)
    assert fingers.diameter(0.130, GripType.INTERNAL) == pytest.approx(0.1426)


def test_the_serial_number_is_text() -> None:
    text = b"AB-12".ljust(32, b"\0")
    assert serial_number(struct.unpack(">16H", text)) == "AB-12"
