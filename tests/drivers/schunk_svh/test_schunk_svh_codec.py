"""The SVH's bytes, from the example frames of its fact sheet."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.parser import CodecError
from rtee.drivers.schunk_svh import codec
from rtee.drivers.schunk_svh.channels import (
    CHANNELS,
    channel_of,
    channels_for,
    current_settings,
    position_settings,
)
from rtee.drivers.schunk_svh.codec import Command, Packet, Parser


def raw(text: str) -> bytes:
    """Bytes of a sheet's hex; ``00x64`` stands for 64 zero bytes."""
    out = b""
    for word in text.split():
        value, _, times = word.partition("x")
        out += bytes([int(value, 16)]) * (int(times) if times else 1)
    return out


IDLE = (-15000, -15000, -8000, 8000, -8000, 8000, -8000, -8000, -25000)
FIRMWARE = raw("4C AA 00 0C 38 00 53 56 48 00 01 00 50 00 53 69 6D 75 6C 61 74 65 64 00x39 EA 46")
FEEDBACK = raw(
    "4C AA 01 02 36 00 68 C5 FF FF 68 C5 FF FF C0 E0 FF FF 40 1F 00 00 C0 E0 FF FF 40 1F 00 00"
    " C0 E0 FF FF C0 E0 FF FF 58 9E FF FF 00 00 05 00 FD FF 0C 00 00 00 00 00 00 00 00 00 FF FF"
    " 8B CD"
)
REQUESTS = [
    ("4C AA 00 0C 40 00 00x64 00 00", Packet(Command.GET_FIRMWARE_INFO)),
    ("4C AA 01 02 40 00 00x64 00 00", Packet(Command.GET_CONTROL_FEEDBACK_ALL, index=1)),
    (
        "4C AA 02 03 40 00 68 C5 FF FF 68 C5 FF FF C0 E0 FF FF 40 1F 00 00 C0 E0 FF FF"
        " 40 1F 00 00 C0 E0 FF FF C0 E0 FF FF 58 9E FF FF 00x28 80 C6",
        Packet(Command.SET_CONTROL_COMMAND_ALL, data=codec.Targets(IDLE).to_bytes(), index=2),
    ),
    (
        "4C AA 03 31 40 00 20 4E 00x62 6E 6E",
        Packet(Command.SET_CONTROL_COMMAND, 3, codec.Target(20000).to_bytes(), 3),
    ),
    (
        "4C AA 04 09 40 00 1F 00 1F 00x61 3E 00",
        Packet(Command.SET_CONTROLLER_STATE, 0, codec.ControllerState(0x1F, 0x1F).to_bytes(), 4),
    ),
    (
        "4C AA 05 09 40 00 1F 00 1F 00 00 02 00 02 00x56 42 00",
        Packet(
            Command.SET_CONTROLLER_STATE,
            0,
            codec.ControllerState(0x1F, 0x1F, 0x200, 0x200).to_bytes(),
            5,
        ),
    ),
    (
        "4C AA 07 09 40 00 1F 00 1F 00 08 02 08 02 01 00 01 00x53 54 00",
        Packet(
            Command.SET_CONTROLLER_STATE,
            0,
            codec.ControllerState(0x1F, 0x1F, 0x208, 0x208, 1, 1).to_bytes(),
            7,
        ),
    ),
    (
        "4C AA 09 35 40 00 00 24 74 C9 00 24 74 49 00 40 1C 47 00 00 80 3F 6F 12 83 3A"
        " 00 00 FA C3 00 00 FA 43 CD CC 4C 3F 00 00 00 00 00 00 7A 44 00x24 BE 2C",
        Packet(Command.SET_POSITION_SETTINGS, 3, position_settings(3).to_bytes(), 9),
    ),
    (
        "4C AA 0A 37 40 00 00 00 AF C3 00 00 AF 43 29 5C CF 3E BD 37 86 36 00 00 C8 C1"
        " 00 00 C8 41 00 00 80 3F 00 00 20 41 00 00 7F C3 00 00 7F 43 00x24 5C E0",
        Packet(Command.SET_CURRENT_SETTINGS, 3, current_settings(3).to_bytes(), 10),
    ),
]


@pytest.mark.parametrize(("sheet", "packet"), REQUESTS)
def test_requests_are_the_bytes_of_the_sheet(sheet: str, packet: Packet) -> None:
    frame = packet.to_bytes()
    assert frame == raw(sheet)
    assert len(frame) == codec.PACKET
    back = Packet.from_bytes(frame)
    assert (back.command, back.channel, back.index) == (
        packet.command, packet.channel, packet.index,
    )  # fmt: skip
    assert back.data.rstrip(b"\x00") == packet.data.rstrip(b"\x00")


def test_encoder_scalings_are_the_bytes_of_the_sheet() -> None:
    packet = Packet(
        Command.SET_ENCODER_VALUES, data=codec.Encoders((1,) * 9).to_bytes(), index=0x0B
    )
    assert packet.to_bytes(pad=False) == raw("4C AA 0B 0B 24 00") + raw("01 00 00 00") * 9 + raw(
        "09 01"
    )
    assert codec.Encoders.from_bytes(packet.data).scalings == (1,) * 9


def test_replies_are_read_at_their_natural_length() -> None:
    info = codec.FirmwareInfo.from_bytes(Packet.from_bytes(FIRMWARE).data)
    assert info == codec.FirmwareInfo("SVH", 1, 0x50, "Simulated")
    assert Packet(Command.GET_FIRMWARE_INFO, data=info.to_bytes()).to_bytes(pad=False) == FIRMWARE

    feedback = codec.FeedbackAll.from_bytes(Packet.from_bytes(FEEDBACK).data)
    assert feedback.positions == IDLE
    assert feedback.currents_ma == (0, 5, -3, 12, 0, 0, 0, 0, -1)
    again = Packet(Command.GET_CONTROL_FEEDBACK_ALL, data=feedback.to_bytes(), index=1)
    assert again.to_bytes(pad=False) == FEEDBACK

    reply = Packet.from_bytes(raw("4C AA 03 31 06 00 A4 4D 00 00 96 00 87 7F"))
    assert codec.Feedback.from_bytes(reply.data) == codec.Feedback(19876, 150)


def test_settings_and_state_survive_the_wire() -> None:
    for channel in range(9):
        data = position_settings(channel).to_bytes()
        back = codec.PositionSettings.from_bytes(
            Packet(Command.GET_POSITION_SETTINGS, data=data).data
        )
        assert back.max_rate == position_settings(channel).max_rate
        assert back.to_bytes() == data
        data = current_settings(channel).to_bytes()
        read = codec.CurrentSettings.from_bytes(
            Packet(Command.GET_CURRENT_SETTINGS, data=data).data
        )
        assert read.to_bytes() == data
    state = codec.ControllerState(1, 2, 0x2FF, 0x20F, 1, 1)
    packet = Packet(Command.GET_CONTROLLER_STATE, data=state.to_bytes())
    assert codec.ControllerState.from_bytes(packet.data) == state
    assert state.enabled == 0x0F


@pytest.mark.parametrize(
    "bad",
    [
        b"",
        FIRMWARE[:-1],
        b"\x4c\xab" + FIRMWARE[2:],
        FIRMWARE[:-1] + b"\x00",
        FIRMWARE[:10] + b"\xff" + FIRMWARE[11:],
        FIRMWARE[:4] + b"\x41\x00" + FIRMWARE[6:],
        FIRMWARE[:3] + b"\x0d" + FIRMWARE[4:],
    ],
)
def test_what_is_no_packet_is_refused(bad: bytes) -> None:
    with pytest.raises(CodecError):
        Packet.from_bytes(bad)


def test_data_too_short_for_its_command_is_refused() -> None:
    short = b"\x00" * 3
    for read in (
        codec.FirmwareInfo.from_bytes,
        codec.Feedback.from_bytes,
        codec.FeedbackAll.from_bytes,
        codec.PositionSettings.from_bytes,
        codec.CurrentSettings.from_bytes,
        codec.ControllerState.from_bytes,
        codec.Target.from_bytes,
        codec.Targets.from_bytes,
        codec.Encoders.from_bytes,
    ):
        with pytest.raises(CodecError):
            read(short)


@given(cuts=st.lists(st.integers(1, 40), min_size=1, max_size=8))
def test_packets_are_found_however_the_stream_is_cut(cuts: list[int]) -> None:
    stream = b"\x00\x4c" + FIRMWARE + b"\x4c\x4c" + FEEDBACK + b"\xaa" + FIRMWARE
    parser = Parser()
    found: list[Packet] = []
    position = 0
    while position < len(stream):
        step = cuts[position % len(cuts)]
        found += parser.feed(stream[position : position + step])
        position += step
    assert [p.command for p in found] == [
        Command.GET_FIRMWARE_INFO, Command.GET_CONTROL_FEEDBACK_ALL, Command.GET_FIRMWARE_INFO,
    ]  # fmt: skip


@given(noise=st.binary(max_size=200), at=st.integers(0, 60), value=st.integers(0, 255))
def test_noise_and_damage_cost_no_more_than_one_good_packet(
    noise: bytes, at: int, value: int
) -> None:
    parser = Parser()
    damaged = bytearray(FEEDBACK)
    damaged[at] = value
    parser.feed(noise + bytes(damaged))
    assert parser.pending <= Parser.LIMIT
    found = parser.feed(FIRMWARE + FIRMWARE)
    assert any(p.command is Command.GET_FIRMWARE_INFO for p in found)
    assert parser.pending <= Parser.LIMIT


def test_a_packet_with_a_bad_checksum_is_dropped_and_counted() -> None:
    parser = Parser()
    assert parser.feed(FEEDBACK[:-1] + b"\x00" + FEEDBACK) == [Packet.from_bytes(FEEDBACK)]
    assert parser.errors == 1


@pytest.mark.parametrize("channel", CHANNELS)
@given(angle=st.floats(-0.2, 1.5), stop=st.integers(-200_000, 200_000))
def test_units_have_inverses(channel: codec.Packet, angle: float, stop: int) -> None:
    zero = channel.zero(stop)
    ticks = channel.to_ticks(angle, zero)
    assert math.isclose(
        channel.to_rad(ticks, zero), angle, abs_tol=abs(channel.rad_per_tick) * 0.5001
    )
    assert channel.to_ticks(channel.to_rad(ticks, zero), zero) == ticks
    if channel.force_slope:
        assert math.isclose(channel.to_effort(channel.to_current(0.3)) * channel.direction, -0.3)


def test_gearing_is_that_of_the_sheet() -> None:
    expected = [
        -5.7059e-6, -6.8276e-6, -2.9556e-5, 2.0e-5, -2.9556e-5, 2.0e-5, -2.1778e-5, -2.1778e-5,
        -1.2889e-5,
    ]  # fmt: skip
    for channel, gearing in zip(CHANNELS, expected, strict=True):
        assert math.isclose(channel.rad_per_tick, gearing, rel_tol=1e-4)
        low, high = channel.soft_limits(1000)
        assert low <= channel.idle(1000) <= high
        angles = sorted(channel.to_rad(t, channel.zero(1000)) for t in (low, high))
        assert angles == pytest.approx([0.0, channel.range], abs=1e-9)


def test_firmware_decides_the_offsets() -> None:
    assert channels_for((1, 2))[1].min_offset == -105_000
    assert channels_for((2, 3))[8].reset_factor == 0.7
    assert channels_for((1, 80)) == CHANNELS


def test_actuators_are_matched_by_the_end_of_their_names() -> None:
    assert channel_of("left_hand_Pinky") == 7
    assert channel_of("Finger_Spread") == 8
    with pytest.raises(KeyError):
        channel_of("left_hand_Wrist")
