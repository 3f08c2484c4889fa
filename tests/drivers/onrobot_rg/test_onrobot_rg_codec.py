"""The RG's registers by the frames of its sheet, its linkage, and its units there and back."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.modbus_frames import rtu_frame
from rtee.drivers.onrobot_rg.codec import (
    FINGERTIP,
    MODELS,
    STATE,
    TIPS_WIDTH,
    Command,
    Control,
    LinkageScale,
    Status,
)
from rtee.errors import FrameError

COMMANDS = [
    ("41 10 00 00 00 03 06 01 90 00 00 00 10 D8 40", Command(400, 0, Control.GRIP_WITH_OFFSET)),
    ("41 10 00 00 00 03 06 01 90 04 4C 00 10 18 A7", Command(400, 1100, Control.GRIP_WITH_OFFSET)),
    ("41 10 00 00 00 03 06 00 C8 01 F4 00 01 78 5E", Command(200, 500, Control.GRIP)),
]


@pytest.mark.parametrize(("frame", "command"), COMMANDS)
def test_a_command_is_one_frame(frame: str, command: Command) -> None:
    pdu = bytes.fromhex("10000000 03 06") + struct.pack(">3H", *command.to_registers())
    assert rtu_frame(0x41, pdu) == bytes.fromhex(frame)
    assert Command.from_registers(struct.unpack(">3H", bytes.fromhex(frame)[7:13])) == command


STATES = [
    ("41 03 04 01 F4 00 00 FB F9", Status(width=500)),
    ("41 03 04 01 40 00 02 3A 1E", Status(width=320, grip_detected=True)),
]


@pytest.mark.parametrize(("frame", "status"), STATES)
def test_a_state_is_width_and_status(frame: str, status: Status) -> None:
    data = bytes.fromhex(frame)
    assert Status.from_registers(struct.unpack(">2H", data[3:7])) == status
    pdu = b"\x03\x04" + struct.pack(">2H", *status.to_registers())
    assert rtu_frame(0x41, pdu) == data


@pytest.mark.parametrize(
    ("frame", "status"),
    [
        ("41 03 02 00 05 79 88", Status(busy=True, pushed=(True, False))),
        ("41 03 02 00 08 B8 4D", Status(triggered=(True, False))),
        ("41 03 02 00 40 B8 7B", Status(safety_error=True)),
    ],
)
def test_the_status_tells_of_the_safety_switches(frame: str, status: Status) -> None:
    data = bytes.fromhex(frame)
    bits = int.from_bytes(data[3:5], "big")
    assert Status.from_registers((0, bits)) == status
    assert rtu_frame(0x41, data[1:-2]) == data


def test_a_width_may_be_negative_and_unknown_bits_are_refused() -> None:
    assert Status.from_registers((0xFFF6, 0)).width == -10
    assert Status(width=-10).to_registers() == (0xFFF6, 0)
    with pytest.raises(FrameError, match="not a valid status of an RG"):
        Status.from_registers((0, 0x0080))
    with pytest.raises(FrameError, match="not a valid command of an RG"):
        Command.from_registers((0, 0, 4))


@given(st.tuples(*[st.integers(0, 0xFFFF)] * 2))
def test_any_two_registers_are_a_state_or_refused(words: tuple[int, int]) -> None:
    try:
        status = Status.from_registers(words)
    except FrameError:
        assert words[1] > 0x7F
        return
    assert status.to_registers() == words


@pytest.mark.parametrize("name", list(MODELS))
def test_the_links_open_to_the_stroke_and_close_at_zero(name: str) -> None:
    model = MODELS[name]
    for tenths in range(0, round(model.stroke * 1e4) + 1, 7):
        angle = model.angle(tenths * 1e-4)
        assert model.width(angle) == pytest.approx(tenths * 1e-4, abs=1e-9)
        step = (model.width(angle + 1e-6) - model.width(angle - 1e-6)) / 2e-6
        assert model.lever(angle) == pytest.approx(step, rel=1e-4)
    assert model.angle(0.0) == pytest.approx(0.0, abs=0.01)
    assert model.angle(model.stroke) < math.radians(80.0)
    assert model.angle(1.0) == pytest.approx(model.phase + math.pi / 2)


@pytest.mark.parametrize(("name", "published"), [("rg2", -0.0039), ("rg6", -0.0016)])
def test_between_its_fingertips_it_is_the_published_linkage(name: str, published: float) -> None:
    """theta = phase + asin((w - g) / 2L), with w between fingertips of 4.9 mm."""
    model = MODELS[name]
    for width in (0.0, 0.02, 0.05, 0.09):
        theta = math.asin(model.rise / model.link) + math.asin((width - published) / 2 / model.link)
        assert model.angle(width + 2 * FINGERTIP) == pytest.approx(theta)


@pytest.mark.parametrize(("name", "force"), [("rg2", 40.0), ("rg6", 120.0)])
def test_every_tenth_of_a_millimetre_and_newton_comes_back(name: str, force: float) -> None:
    model = MODELS[name]
    scale = LinkageScale(model, model.angle(0.0098), model.angle(model.stroke))
    for width in range(round(model.stroke * 1e4) + 1):
        assert scale.width(scale.position(width)) == width
    assert scale.width(-9.0) == 0
    assert scale.effort.raw == (0.0, pytest.approx(10.0 * force))
    for tenths in range(0, round(10 * force) + 1, 3):
        assert scale.effort.to_count(scale.effort.to_si(tenths)) == tenths
    assert scale.effort.to_count(math.inf) == 10.0 * force


def test_registers_are_where_the_sheet_has_them() -> None:
    assert (STATE, TIPS_WIDTH) == (0x010B, 0x0113)
