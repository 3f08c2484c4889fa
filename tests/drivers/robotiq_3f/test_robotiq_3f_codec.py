"""The 3-Finger's registers by the frames of its manuals, and its units there and back."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.modbus_frames import rtu_frame
from rtee.drivers.robotiq_3f.codec import (
    AXES,
    FAULTS,
    SCALES,
    AxisStatus,
    Command,
    Contact,
    Mode,
    Motion,
    Request,
    Status,
)
from rtee.drivers.robotiq_common import Progress
from rtee.errors import FrameError

FULL = Request(255, 255, 255)
NONE = Request()


def words(frame: str, skip: int, end: int = -2) -> list[int]:
    body = bytes.fromhex(frame)[skip:end]
    return list(struct.unpack(f">{len(body) // 2}H", body))


WRITES = [
    ("09 10 03 E8 00 03 06 01 00 00 00 00 00 72 E1", Command(activate=True)),
    (
        "09 10 03 E8 00 03 06 09 00 00 FF FF FF 42 29",
        Command(activate=True, go=True, axes=(FULL, NONE, NONE, NONE)),
    ),
    (
        "09 10 03 E8 00 03 06 09 00 00 00 FF FF 72 19",
        Command(activate=True, go=True, axes=(Request(0, 255, 255), NONE, NONE, NONE)),
    ),
    ("09 10 03 E8 00 01 02 03 00 E5 48", Command(activate=True, mode=Mode.PINCH)),
    (
        "09 10 03 E8 00 08 10 09 04 00 80 FF FF 40 FF FF C0 FF FF 89 FF FF 00 F0 5E",
        Command(
            activate=True,
            go=True,
            individual=True,
            axes=(
                Request(0x80, 255, 255),
                Request(0x40, 255, 255),
                Request(0xC0, 255, 255),
                Request(0x89, 255, 255),
            ),
        ),
    ),
]


@pytest.mark.parametrize(("frame", "command"), WRITES)
def test_a_command_is_the_manuals_frame(frame: str, command: Command) -> None:
    found = words(frame, 7)
    count = len(found)
    assert list(command.to_registers()[:count]) == found
    pdu = bytes.fromhex(frame)[1:7] + struct.pack(f">{count}H", *found)
    assert rtu_frame(9, pdu) == bytes.fromhex(frame)
    assert Command.from_registers([*found, *[0] * (8 - count)]) == command


def axis(contact: Contact, requested: int, position: int, current: int = 0) -> AxisStatus:
    return AxisStatus(contact, requested, position, current)


AT, CLOSING, MOVING = Contact.AT_REQUEST, Contact.CLOSING, Contact.MOVING
READS = [
    (
        "09 03 10 39 C0 00 FF 08 0F 00 08 10 00 08 0F 00 89 00 00 73 70",
        Status(
            True,
            True,
            Progress.DONE,
            0,
            Mode.BASIC,
            Motion.MOVING,
            (
                axis(MOVING, 255, 8, 15),
                axis(MOVING, 0, 8, 16),
                axis(MOVING, 0, 8, 15),
                axis(AT, 0, 0x89),
            ),
        ),
    ),
    (
        "09 03 10 B9 EA 00 FF BC 00 00 C1 00 00 BD 00 00 89 00 00 4E 17",
        Status(
            True,
            True,
            Progress.DONE,
            0,
            Mode.BASIC,
            Motion.ALL_SHORT,
            (
                axis(CLOSING, 255, 188),
                axis(CLOSING, 0, 193),
                axis(CLOSING, 0, 189),
                axis(AT, 0, 0x89),
            ),
        ),
    ),
    (
        "09 03 10 F9 FF 00 00 07 00 00 06 00 00 06 00 00 89 00 00 34 8D",
        Status(
            True,
            True,
            Progress.DONE,
            0,
            Mode.BASIC,
            Motion.ALL_REACHED,
            (axis(AT, 0, 7), axis(AT, 0, 6), axis(AT, 0, 6), axis(AT, 0, 0x89)),
        ),
    ),
    (
        "09 03 10 21 00 00 00 07 00 00 06 00 00 06 00 00 89 00 00 D1 97",
        Status(
            True,
            False,
            Progress.CHANGING,
            0,
            Mode.BASIC,
            Motion.MOVING,
            (axis(MOVING, 0, 7), axis(MOVING, 0, 6), axis(MOVING, 0, 6), axis(MOVING, 0, 0x89)),
        ),
    ),
]


@pytest.mark.parametrize(("frame", "status"), READS)
def test_a_status_is_the_manuals_frame(frame: str, status: Status) -> None:
    assert Status.from_registers(words(frame, 3)) == status
    pdu = b"\x03\x10" + struct.pack(">8H", *status.to_registers())
    assert rtu_frame(9, pdu) == bytes.fromhex(frame)


def test_the_network_carries_the_same_registers() -> None:
    frame = "D605 0000 0013 02 04 10 39C0 0000 B80B 00BD 0E00 BA0B 0089 0000"
    status = Status.from_registers(words(frame, 9, 25))
    assert [a.position for a in status.axes] == [0xB8, 0xBD, 0xBA, 0x89]
    assert [a.raw_current for a in status.axes] == [11, 14, 11, 0]


def test_another_devices_registers_are_refused() -> None:
    with pytest.raises(FrameError, match="not a valid status of a 3-finger gripper"):
        Status.from_registers([0x3900, 0xF000, 0, 0, 0, 0, 0, 0])


@given(st.tuples(*[st.integers(0, 0xFFFF)] * 8))
def test_any_registers_are_a_status_or_refused(found: tuple[int, ...]) -> None:
    try:
        status = Status.from_registers(found)
    except FrameError:
        return
    assert status.to_registers() == found


@given(st.tuples(*[st.integers(0, 0xFFFF)] * 8))
def test_a_command_comes_back(found: tuple[int, ...]) -> None:
    command = Command.from_registers(found)
    assert Command.from_registers(command.to_registers()) == command


@pytest.mark.parametrize("name", AXES)
def test_every_count_comes_back(name: str) -> None:
    scale = SCALES[name]
    low, high = (15, 240) if name == "scissor" else (0, 255)
    for count in range(low, high + 1):
        assert scale.position.to_count(scale.position.within(count)) == count
    for count in range(256):
        assert scale.velocity.to_count(scale.velocity.to_si(count)) == count
        assert scale.effort.to_count(scale.effort.to_si(count)) == count
    assert scale.effort.to_count(math.inf) == 255


def test_the_scissor_swings_eleven_degrees_to_either_side() -> None:
    scale = SCALES["scissor"]
    assert math.degrees(scale.position.within(0)) == pytest.approx(11.0, abs=0.01)
    assert math.degrees(scale.position.within(255)) == pytest.approx(-11.0, abs=0.01)
    assert scale.position.to_count(-1.0) == 240


def test_every_fault_has_a_name_and_a_hint_or_is_a_warning() -> None:
    assert all(fault.name and (fault.hint or fault.warning) for fault in FAULTS.values())
