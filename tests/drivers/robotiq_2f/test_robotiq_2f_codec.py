"""The 2F's registers by the frames of its manual, and its units there and back."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.modbus_frames import rtu_frame
from rtee.drivers.robotiq_2f.codec import (
    FAULTS,
    MODELS,
    Command,
    Grasp,
    Status,
)
from rtee.drivers.robotiq_common import Progress
from rtee.drivers.scale import FingerScale
from rtee.errors import FrameError


def registers(frame: str, skip: int) -> list[int]:
    body = bytes.fromhex(frame)[skip:-2]
    return list(struct.unpack(f">{len(body) // 2}H", body))


WRITES = [
    ("09 10 03 E8 00 03 06 00 00 00 00 00 00 73 30", Command()),
    ("09 10 03 E8 00 03 06 01 00 00 00 00 00 72 E1", Command(activate=True)),
    (
        "09 10 03 E8 00 03 06 09 00 00 FF FF FF 42 29",
        Command(activate=True, go=True, position=255, speed=255, force=255),
    ),
    (
        "09 10 03 E8 00 03 06 09 00 00 00 FF FF 72 19",
        Command(activate=True, go=True, position=0, speed=255, force=255),
    ),
    (
        "09 10 03 E8 00 03 06 09 00 00 73 B2 96 76 BC",
        Command(activate=True, go=True, position=115, speed=178, force=150),
    ),
    ("09 10 03 E8 00 03 06 11 00 00 00 00 00 70 71", Command(activate=True, release=True)),
]


@pytest.mark.parametrize(("frame", "command"), WRITES)
def test_a_command_is_the_manuals_frame(frame: str, command: Command) -> None:
    pdu = bytes.fromhex("1003E8000306") + struct.pack(">3H", *command.to_registers())
    assert rtu_frame(9, pdu) == bytes.fromhex(frame)
    assert Command.from_registers(registers(frame, 7)) == command


@pytest.mark.parametrize(
    ("force", "frame"),
    [
        (0x40, "09 17 07 D0 00 03 03 E8 00 03 06 09 00 00 80 FF 40 96 56"),
        (0x80, "09 17 07 D0 00 03 03 E8 00 03 06 09 00 00 80 FF 80 96 06"),  # of a Hand-E
    ],
)
def test_a_whole_cycle_is_one_frame(force: int, frame: str) -> None:
    command = Command(activate=True, go=True, position=0x80, speed=255, force=force)
    pdu = bytes.fromhex("1707D0000303E8000306") + struct.pack(">3H", *command.to_registers())
    assert rtu_frame(9, pdu) == bytes.fromhex(frame)


READS = [
    (
        "09 03 06 39 00 00 FF 0E 0A F7 8B",
        Status(True, True, Progress.DONE, 0, Grasp.MOVING, 0, 255, 14, 10),
    ),
    (
        "09 04 06 B9 00 00 FF BD 00 5C 9A",
        Status(True, True, Progress.DONE, 0, Grasp.CONTACT_CLOSING, 0, 255, 189, 0),
    ),
    (
        "09 04 06 39 00 00 00 BB 10 71 06",
        Status(True, True, Progress.DONE, 0, Grasp.MOVING, 0, 0, 187, 16),
    ),
    (
        "09 03 06 F9 00 00 00 0D 00 56 4C",
        Status(True, True, Progress.DONE, 0, Grasp.AT_REQUEST, 0, 0, 13, 0),
    ),
    (
        "09 17 06 39 00 00 80 10 0A CF 0C",
        Status(True, True, Progress.DONE, 0, Grasp.MOVING, 0, 0x80, 16, 10),
    ),
    (
        "09 17 06 39 00 00 80 40 0A F3 0C",
        Status(True, True, Progress.DONE, 0, Grasp.MOVING, 0, 0x80, 0x40, 10),
    ),
    (
        "09 04 06 F1 00 0F 00 03 00 11 96",
        Status(True, False, Progress.DONE, 15, Grasp.AT_REQUEST, 0, 0, 3, 0),
    ),
    (
        "09 04 06 00 00 07 00 03 00 06 D7",
        Status(False, False, Progress.RESET, 7, Grasp.MOVING, 0, 0, 3, 0),
    ),
]


@pytest.mark.parametrize(("frame", "status"), READS)
def test_a_status_is_the_manuals_frame(frame: str, status: Status) -> None:
    assert Status.from_registers(registers(frame, 3)) == status
    function = bytes.fromhex(frame)[1]
    pdu = bytes([function, 6]) + struct.pack(">3H", *status.to_registers())
    assert rtu_frame(9, pdu) == bytes.fromhex(frame)


@pytest.mark.parametrize(
    ("word", "state"), [(0x1100, Progress.ACTIVATING), (0x3100, Progress.DONE)]
)
def test_the_activation_is_read_from_the_first_register(word: int, state: Progress) -> None:
    assert Status.from_registers([word, 0, 0]).progress is state


def test_the_current_is_ten_milliamperes_a_count() -> None:
    assert Status(raw_current=0x10).current == pytest.approx(0.16)


@pytest.mark.parametrize("words", [(0x39C0, 0, 0), (0x3700, 0, 0), (0x3901, 0, 0)])
def test_another_grippers_status_is_refused(words: tuple[int, int, int]) -> None:
    with pytest.raises(FrameError, match="not a valid status of a 2-finger gripper"):
        Status.from_registers(words)


@given(st.tuples(*[st.integers(0, 0xFFFF)] * 3))
def test_any_three_registers_are_a_status_or_refused(words: tuple[int, int, int]) -> None:
    try:
        status = Status.from_registers(words)
    except FrameError:
        return
    assert status.to_registers() == (words[0] & 0xF900, *words[1:])


def scales() -> list[FingerScale]:
    return [
        MODELS["2f_85"].scale(0.0, 0.82),
        MODELS["2f_140"].scale(0.0, 0.7, open_count=13),
        MODELS["hand_e"].scale(0.0, 0.025),
        MODELS["hand_e_c10"].scale(0.0, 0.025, open_count=0, closed_count=255),
    ]


@pytest.mark.parametrize("scale", scales(), ids=list(MODELS))
def test_every_count_comes_back(scale: FingerScale) -> None:
    for count in range(int(scale.position.raw[0]), int(scale.position.raw[1]) + 1):
        assert scale.position.to_count(scale.position.to_si(count)) == count
    for count in range(256):
        assert scale.velocity.to_count(scale.velocity.to_si(count)) == count
        assert scale.effort.to_count(scale.effort.to_si(count)) == count


def test_the_actuator_is_at_its_ends_where_the_gripper_is() -> None:
    scale = MODELS["2f_140"].scale(0.1, 0.7, open_count=13)
    assert scale.position.to_si(13) == pytest.approx(0.1)
    assert scale.position.to_si(230) == pytest.approx(0.7)
    assert scale.position.to_count(math.inf) == 255


def test_effort_and_velocity_are_those_of_the_fingertips_by_virtual_work() -> None:
    scale = MODELS["2f_85"].scale(0.0, 0.8)
    assert scale.effort.to_si(255) == pytest.approx(235.0 * 0.085 / 0.8)
    assert scale.velocity.to_si(255) == pytest.approx(0.150 * 0.8 / 0.085)
    assert scale.effort.to_count(math.inf) == scale.velocity.to_count(math.inf) == 255
    assert scale.effort.to_count(0.0) == scale.velocity.to_count(0.0) == 0


@pytest.mark.parametrize(("name", "force"), [("hand_e", 130.0), ("hand_e_c10", 185.0)])
def test_a_hand_e_slides_each_finger_half_its_stroke(name: str, force: float) -> None:
    """50 mm, 20 to 150 mm/s, both fingers moving: at one of them half the way and speed."""
    scale = MODELS[name].scale(0.0, 0.025, open_count=0, closed_count=255)
    assert scale.position.to_si(51) == pytest.approx(0.005)
    assert scale.velocity.si == pytest.approx((0.010, 0.075))
    assert scale.effort.si == pytest.approx((40.0, 2.0 * force))


def test_every_fault_has_a_name_and_all_but_warnings_a_hint() -> None:
    assert all(fault.name and (fault.hint or fault.warning) for fault in FAULTS.values())
    assert {code for code, fault in FAULTS.items() if fault.major} == {10, 11, 12, 13, 14, 15}
