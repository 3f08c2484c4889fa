"""The SoftHand's bytes, from the example frames of its fact sheet."""

from __future__ import annotations

import math
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.parser import CodecError
from rtee.buses.serial import SerialBus
from rtee.drivers.qb_softhand import codec
from rtee.drivers.qb_softhand.codec import Command, Frame, Parser
from rtee.drivers.qb_softhand.driver import OneMotorHand, TwoMotorHand
from rtee.drivers.qb_softhand.emulator import QbOptions, QbSoftHandEmulator
from rtee.drivers.qb_softhand.link import QbLink
from rtee.errors import BusTimeout, FrameError

SHEET = [
    ("3A 3A 01 02 00 00", Frame(1, Command.PING)),
    ("3A 3A 01 03 80 03 83", Frame(1, Command.ACTIVATE, b"\x03")),
    ("3A 3A 01 03 80 00 80", Frame(1, Command.ACTIVATE, b"\x00")),
    ("3A 3A 01 02 81 81", Frame(1, Command.GET_ACTIVATE)),
    ("3A 3A 01 03 81 03 82", Frame(1, Command.GET_ACTIVATE, b"\x03")),
    ("3A 3A 01 03 81 01 80", Frame(1, Command.GET_ACTIVATE, b"\x01")),
    ("3A 3A 01 06 82 25 1C 00 00 BB", Frame(1, Command.SET_INPUTS, codec.pack_int16(9500, 0))),
    ("3A 3A 01 06 82 4A 38 00 00 F0", Frame(1, Command.SET_INPUTS, codec.pack_int16(19000, 0))),
    ("3A 3A 01 02 84 84", Frame(1, Command.GET_MEASUREMENTS)),
    (
        "3A 3A 01 08 84 25 1C 00 00 00 00 BD",
        Frame(1, Command.GET_MEASUREMENTS, codec.pack_int16(9500, 0, 0)),
    ),
    ("3A 3A 01 06 85 00 FA 00 00 7F", Frame(1, Command.GET_CURRENTS, codec.pack_int16(250, 0))),
    (
        "3A 3A 01 0C 86 00 FA FF F4 24 D8 00 00 00 00 8B",
        Frame(
            1,
            Command.GET_CURR_AND_MEAS,
            codec.pack_int16(250, -12, 9432, 0, 0),
        ),
    ),
    ("3A 3A 01 06 83 25 1C 00 00 BA", Frame(1, Command.GET_INPUTS, codec.pack_int16(9500, 0))),
    (
        "3A 3A 01 08 89 04 B0 00 00 00 00 3D",
        Frame(1, Command.GET_VELOCITIES, codec.pack_int16(1200, 0, 0)),
    ),
    (
        "3A 3A 01 03 8F 1E 91",
        Frame(1, Command.SET_WATCHDOG, bytes([codec.watchdog_byte(0.6)])),
    ),
    ("3A 3A 01 03 90 0D 9D", Frame(1, Command.SET_BAUDRATE, b"\x0d")),
    ("3A 3A 01 04 06 00 00 06", Frame(1, Command.GET_INFO, b"\x00\x00")),
    ("3A 3A 01 04 0C 00 00 0C", Frame(1, Command.GET_PARAM_LIST, b"\x00\x00")),
    (
        "3A 3A 01 06 93 25 1C 00 00 AA",
        Frame(1, Command.SET_INPUTS_ACK, codec.pack_int16(9500, 0)),
    ),
    ("3A 3A 01 03 93 01 92", Frame(1, Command.SET_INPUTS_ACK, b"\x01")),
    ("3A 3A 00 02 84 84", Frame(0, Command.GET_MEASUREMENTS)),
]
GOOD = bytes.fromhex("3A3A010C8600FAFFF424D8000000008B")


@pytest.mark.parametrize(("sheet", "frame"), SHEET)
def test_frames_are_the_bytes_of_the_sheet(sheet: str, frame: Frame) -> None:
    raw = bytes.fromhex(sheet)
    assert frame.to_bytes() == raw
    assert Frame.from_bytes(raw) == frame
    assert Parser().feed(raw) == [frame]


def test_measurements_are_big_endian_and_signed() -> None:
    assert codec.read_int16(Frame.from_bytes(GOOD).data, least=5) == (250, -12, 9432, 0, 0)
    assert codec.read_int16(codec.pack_int16(-40000, 40000)) == (-32768, 32767)
    with pytest.raises(CodecError):
        codec.read_int16(b"\x00" * 8, least=5)
    with pytest.raises(CodecError):
        codec.read_int16(b"\x00" * 3)


def test_both_forms_of_acknowledgement_are_understood() -> None:
    assert codec.acknowledged(Frame(1, 1), Command.STORE_PARAMS) is True
    assert codec.acknowledged(Frame(1, 0), Command.STORE_PARAMS) is False
    assert codec.acknowledged(Frame(1, 3, b"\x01"), Command.STORE_PARAMS) is True
    assert codec.acknowledged(Frame(1, 147, b"\x00"), Command.SET_INPUTS_ACK) is False
    assert codec.acknowledged(Frame(1, 147, b"\x01"), Command.STORE_PARAMS) is None
    assert codec.activation(b"\x03") == 3
    with pytest.raises(CodecError):
        codec.activation(b"")


@given(st.floats(0.02, 5.0))
def test_watchdog_period_survives_its_byte(seconds: float) -> None:
    assert math.isclose(
        codec.watchdog_seconds(codec.watchdog_byte(seconds)), seconds, abs_tol=0.0101
    )


def test_watchdog_off_is_zero() -> None:
    assert codec.watchdog_byte(0.0) == 0


@given(noise=st.binary(max_size=300), at=st.integers(0, 15), value=st.integers(0, 255))
def test_noise_and_damage_cost_at_most_one_longest_frame(noise: bytes, at: int, value: int) -> None:
    parser = Parser()
    damaged = bytearray(GOOD)
    damaged[at] = value
    parser.feed(noise + bytes(damaged))
    assert parser.pending <= Parser.LIMIT
    parser.reset()
    assert parser.feed(bytes(damaged)[: at + 1] + GOOD + GOOD * 9)[-1] == Frame.from_bytes(GOOD)


@given(cuts=st.lists(st.integers(1, 9), min_size=1))
def test_frames_are_found_however_the_stream_is_cut(cuts: list[int]) -> None:
    stream = b"\x3a" + GOOD + b"\x00\x3a\x3a" + bytes.fromhex("3A3A01020000") + GOOD
    parser, found, at = Parser(), [], 0
    while at < len(stream):
        step = cuts[at % len(cuts)]
        found += parser.feed(stream[at : at + step])
        at += step
    assert [f.command for f in found] == [134, 0, 134]


@pytest.mark.parametrize("generation", ["legacy", "modern"])
@pytest.mark.parametrize("motors", [1, 2])
def test_parameter_list_is_read_in_both_framings(generation: str, motors: int) -> None:
    hand = QbSoftHandEmulator(QbOptions(generation=generation, motors=motors))  # type: ignore[arg-type]
    reply = hand.feed(bytes.fromhex("3A3A01040C00000C"), 0.0)
    parser = codec.ListParser(1)
    found: list[dict[int, codec.Parameter]] = []
    for byte in b"\x3a\x00" + b"".join(reply):
        found += parser.feed(bytes([byte]))
    assert len(found) == 1
    limits = codec.limits(found[0])
    expected = (0, 19000) if motors == 1 else (-4000, 23000)
    assert limits == (expected,) * motors
    assert codec.current_limit(found[0]) == 1.5
    assert found[0][codec.Index.DEVICE].values == (1,)
    assert found[0][codec.Index.DEVICE].label.startswith("1 - Device ID")


@given(st.lists(st.binary(max_size=700), max_size=6))
def test_parameter_parser_is_bounded_whatever_comes(pieces: list[bytes]) -> None:
    parser = codec.ListParser(1)
    for piece in [b"\x3a\x3a\x01\x00\x0c\x05", *pieces]:
        parser.feed(piece)
        assert parser.pending <= codec.ListParser.LIMIT


def test_parameters_that_make_no_sense_are_not_believed() -> None:
    assert codec.limits({11: codec.Parameter(5, (100, -100))}) == ()
    assert codec.limits({}) == ()
    assert codec.current_limit({13: codec.Parameter(3, (-1,))}) is None
    with pytest.raises(CodecError):
        codec.Parameter.from_bytes(b"\x09" * 50)
    with pytest.raises(CodecError):
        codec.Parameter.from_bytes(b"\x08\x07".ljust(50, b"\x00"))


@given(st.floats(0.0, 1.0))
def test_closure_of_one_motor_has_an_inverse(closure: float) -> None:
    mapping = OneMotorHand()
    ticks = tuple(round(t) for t in mapping.to_ticks((closure,)))
    assert mapping.to_closure(ticks)[0] == pytest.approx(closure, abs=0.51 / 19000)
    assert mapping.to_ticks((0.5,)) == (9500.0, 0.0)


@given(st.floats(0.0, 1.0), st.floats(-1.0, 1.0))
def test_synergies_of_two_motors_have_an_inverse(synergy: float, manipulation: float) -> None:
    mapping = TwoMotorHand()
    first, second = (round(t) for t in mapping.to_ticks((synergy, manipulation)))
    back = mapping.to_closure((first, first, second, second))
    assert back == pytest.approx((synergy, manipulation), abs=3e-4)
    assert mapping.lower - 1 <= first <= mapping.upper + 1


def test_two_motors_pushed_to_their_lower_limit_are_measured() -> None:
    mapping = TwoMotorHand()
    synergy, manipulation = mapping.to_closure((mapping.lower,) * 4)
    assert synergy < 0.0
    assert manipulation == 0.0


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("error", "heard"), [(FrameError, True), (BusTimeout, False), (None, True)]
)
async def test_hands_that_garble_each_other_are_heard(
    error: type[FrameError | BusTimeout] | None, heard: bool
) -> None:
    class Line:
        async def transact(self, *_: object, **__: object) -> Frame:
            if error is not None:
                raise error("/dev/line", "what came")
            return Frame(1, Command.PING)

    assert await QbLink(cast("SerialBus", Line()), 0, 0.1, 1).hears_any() is heard
