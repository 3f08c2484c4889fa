"""CANopen and CiA 402 frames from the fact sheet's examples; the emulated node by hand."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.emulator import CanFrame
from rtee.buses.parser import CodecError
from rtee.drivers.cia402 import cia301, codec
from rtee.drivers.cia402.cia301 import (
    AbortCode,
    Emergency,
    NmtCommand,
    NmtState,
    Sdo,
)
from rtee.drivers.cia402.codec import Command, DriveScale, Limits, Motion, State, Status
from rtee.drivers.cia402.emulated_drive import DriveProperties
from rtee.drivers.cia402.emulator import Cia402Emulator


def frame(text: str) -> CanFrame:
    """``605 40 41 60`` as a frame."""
    number, *data = text.split()
    return CanFrame(int(number, 16), bytes.fromhex("".join(data)))


def test_frames_are_those_of_the_sheet() -> None:
    assert cia301.heartbeat(5, NmtState.BOOT) == frame("705 00")
    assert cia301.heartbeat(5, NmtState.PRE_OPERATIONAL) == frame("705 7F")
    assert cia301.nmt(NmtCommand.START, 5) == frame("000 01 05")
    assert cia301.nmt(NmtCommand.STOP, 5) == frame("000 02 05")
    assert cia301.nmt(NmtCommand.RESET_NODE, 5) == frame("000 81 05")
    assert Emergency(0x8130, 0x11).to_frame(5) == frame("085 30 81 11 00 00 00 00 00")
    assert Emergency.from_bytes(bytes.fromhex("3081110000000000")) == Emergency(0x8130, 0x11)
    assert Command(0x0F, 1000, 8).to_bytes() == bytes.fromhex("0F00E803000008")
    assert Status.from_bytes(bytes.fromhex("3712DA03000008")) == Status(0x1237, 986, 8)


@pytest.mark.parametrize(
    ("sheet", "sdo"),
    [
        ("2B171000 64000000", Sdo(0x2B, 0x1017, 0, b"\x64\0\0\0")),
        ("60171000 00000000", Sdo(0x60, 0x1017, 0)),
        ("40416000 00000000", Sdo.upload(0x6041)),
        ("4B416000 40000000", Sdo(0x4B, 0x6041, 0, b"\x40\0\0\0")),
        ("2B406000 06000000", Sdo(0x2B, 0x6040, 0, b"\x06\0\0\0")),
        ("2F606000 01000000", Sdo(0x2F, 0x6060, 0, b"\x01\0\0\0")),
        ("237A6000 E8030000", Sdo(0x23, 0x607A, 0, b"\xe8\x03\0\0")),
        ("40996001 00000000", Sdo.upload(0x6099, 1)),
        ("80996001 00000206", Sdo(0x80, 0x6099, 1, struct.pack("<I", AbortCode.NO_OBJECT))),
    ],
)
def test_sdo_frames_are_those_of_the_sheet(sheet: str, sdo: Sdo) -> None:
    raw = bytes.fromhex(sheet)
    assert sdo.to_bytes() == raw
    assert Sdo.from_bytes(raw).to_bytes() == raw


def test_states_are_read_by_mask() -> None:
    for word, state in (
        (0x0040, State.SWITCH_ON_DISABLED), (0x0021, State.READY), (0x0023, State.SWITCHED_ON),
        (0x1237, State.ENABLED), (0x0017, State.QUICK_STOP), (0x0008, State.FAULT),
        (0x000F, State.FAULT_REACTION), (0x0000, State.NOT_READY),
    ):  # fmt: skip
        assert State.of(word) is state


@given(st.binary(max_size=9))
def test_any_data_is_read_or_refused(data: bytes) -> None:
    for read, size in (
        (Status.from_bytes, 7), (Command.from_bytes, 7), (Motion.from_bytes, 8),
        (Limits.from_bytes, 6), (Emergency.from_bytes, 8), (Sdo.from_bytes, 8),
    ):  # fmt: skip
        if len(data) == size:
            read(data)
        else:
            with pytest.raises(CodecError):
                read(data)


@given(st.floats(-3.0, 3.0), st.sampled_from([651.9, -651.9, 12345.6]))
def test_units_have_inverses(position: float, counts: float) -> None:
    scale = DriveScale(counts, 77, 2.0)
    there = scale.to_counts(position)
    assert scale.to_position(there) == pytest.approx(position, abs=0.51 / abs(counts))
    assert scale.to_velocity(scale.to_velocity_limit(1.0)) * counts > 0
    rpm = DriveScale(counts, velocity_unit=4096 / 60)
    assert rpm.to_velocity_limit(60 * 4096 / counts) == 3600
    assert rpm.to_velocity(60) == pytest.approx(4096 / counts)
    assert abs(scale.to_effort(scale.to_permille(1.3))) == pytest.approx(1.3, abs=1e-3)


def test_gear_and_encoder_make_the_counts() -> None:
    assert codec.counts_per_rad(4096, 1, 100, 1) == pytest.approx(4096 * 100 / (2 * math.pi))
    with pytest.raises(ValueError, match="positive"):
        codec.counts_per_rad(4096, 0, 1, 1)


def test_every_error_code_has_a_name() -> None:
    assert cia301.emergency_name(0x2310) == "overcurrent"
    assert cia301.emergency_name(0x2999) == "current"
    assert cia301.emergency_name(0xFF42) == "manufacturer-specific"
    assert cia301.emergency_cure(0x4310) == "let it cool down"
    assert cia301.emergency_cure(0x3220) == "check the motor's supply"
    assert cia301.emergency_cure(0x8130) == "see why this program fell silent"
    assert cia301.emergency_cure(0xFF42) == cia301.emergency_cure(0) == "remove the cause"


class Host:
    """Speaks the sheet's bytes to the emulated node; keeps its own time."""

    def __init__(self, **properties: object) -> None:
        self.emulator = Cia402Emulator(DriveProperties(nodes=(5,), **properties))  # type: ignore[arg-type]
        self.now = 0.0
        self.heard = self.emulator.step(self.now)

    def send(self, text: str, *, after: float = 0.001) -> list[str]:
        self.now += after
        answers = self.emulator.on_frame(frame(text), self.now)
        return [f"{a.id:03X} " + a.data.hex(" ").upper() for a in answers]

    def wait(self, seconds: float, step: float = 0.01) -> list[str]:
        out = []
        end = self.now + seconds
        while self.now < end:
            self.now += step
            out += self.emulator.step(self.now)
        return [f"{a.id:03X} " + a.data.hex(" ").upper() for a in out]


def test_the_node_boots_beats_and_answers_as_in_the_sheet() -> None:
    host = Host()
    assert host.heard == [frame("705 00")]
    assert host.send("605 2B 17 10 00 64 00 00 00") == ["585 60 17 10 00 00 00 00 00"]
    assert host.wait(0.1) == ["705 7F"]
    assert host.send("605 40 41 60 00 00 00 00 00")[0][:15] == "585 4B 41 60 00"
    assert host.send("605 40 99 61 01 00 00 00 00") == ["585 80 99 61 01 00 00 02 06"]
    assert host.send("605 2F 40 60 00 06 00 00 00") == ["585 80 40 60 00 10 00 07 06"]
    assert host.send("605 40 6C 60 07 00 00 00 00") == ["585 80 6C 60 07 11 00 09 06"]
    host.send("000 01 05")
    assert "705 05" in host.wait(0.1)
    assert host.send("000 81 05") == ["705 00"]
    host.send("000 02 05")
    assert host.send("605 40 41 60 00 00 00 00 00") == []


def test_a_mapping_in_force_cannot_be_changed() -> None:
    host = Host()
    done = "585 60 00 1A {:02X} 00 00 00 00"
    assert host.send("605 23 00 1A 01 10 00 41 60") == [done.format(1)]
    assert host.send("605 2F 00 1A 00 01 00 00 00") == [done.format(0)]
    assert host.send("605 23 00 1A 01 08 00 00 7F") == ["585 80 00 1A 01 00 00 01 06"]
    assert host.send("605 2F 00 1A 00 00 00 00 00") == [done.format(0)]
    assert host.send("605 23 00 1A 01 20 00 64 60") == [done.format(1)]


def test_strings_come_in_segments() -> None:
    host = Host(name="a name of more than seven")
    (first,) = host.send("605 40 08 10 00 00 00 00 00")
    assert first == "585 41 08 10 00 19 00 00 00"
    text, toggle = b"", 0
    while True:
        (answer,) = host.send(f"605 {0x60 | toggle:02X} 00 00 00 00 00 00 00")
        raw = bytes.fromhex(answer[4:])
        assert raw[0] >> 4 & 1 == toggle >> 4
        text += raw[1 : 8 - (raw[0] >> 1 & 7)]
        toggle ^= 0x10
        if raw[0] & 1:
            break
    assert text == b"a name of more than seven"


def walk(host: Host) -> None:
    for word in ("06", "07", "0F"):
        assert host.send(f"605 2B 40 60 00 {word} 00 00 00") == ["585 60 40 60 00 00 00 00 00"]


def position(host: Host) -> int:
    (answer,) = host.send("605 40 64 60 00 00 00 00 00")
    return int.from_bytes(bytes.fromhex(answer[4:])[4:8], "little", signed=True)


def test_a_profile_move_by_sdo_with_its_handshake() -> None:
    host = Host()
    assert host.send("605 2F 60 60 00 01 00 00 00") == ["585 60 60 60 00 00 00 00 00"]
    walk(host)
    host.send("605 23 7A 60 00 E8 03 00 00")
    host.wait(0.2)
    assert position(host) == 0
    host.send("605 2B 40 60 00 1F 00 00 00")
    host.wait(0.2)
    assert position(host) == 1000
    (word,) = host.send("605 40 41 60 00 00 00 00 00")
    assert bytes.fromhex(word[4:])[5] & 0x14 == 0x14
    host.send("605 2B 40 60 00 0F 00 00 00")
    host.wait(0.02)
    (word,) = host.send("605 40 41 60 00 00 00 00 00")
    assert bytes.fromhex(word[4:])[5] & 0x14 == 0x04


def test_a_fault_is_told_and_reset_by_the_edge_of_its_bit() -> None:
    host = Host()
    walk(host)
    host.emulator.inject("overcurrent")
    assert "085 10 23 03 00 00 00 00 00" in host.wait(0.02)
    assert host.send("605 40 3F 60 00 00 00 00 00") == ["585 4B 3F 60 00 10 23 00 00"]
    host.emulator.clear()
    host.send("605 2B 40 60 00 80 00 00 00")
    assert "085 00 00 00 00 00 00 00 00" in host.wait(0.02)
    assert host.send("605 40 41 60 00 00 00 00 00")[0].startswith("585 4B 41 60 00 50")


def test_a_silent_host_makes_it_fault() -> None:
    host = Host()
    host.send("605 23 16 10 01 64 00 7E 00")
    walk(host)
    host.send("77E 05")
    host.wait(0.05)
    host.send("77E 05")
    assert not [f for f in host.wait(0.08) if f.startswith("085")]
    assert "085 30 81 11 00 00 00 00 00" in host.wait(0.05)
    assert host.emulator.drives[5].state is State.FAULT
    assert host.emulator.drives[5].node.state is NmtState.PRE_OPERATIONAL


def test_a_mapping_that_cannot_be_is_refused() -> None:
    host = Host()
    host.send("605 23 00 16 01 20 00 99 61")
    assert host.send("605 2F 00 16 00 01 00 00 00") == ["585 80 00 16 00 41 00 04 06"]


@pytest.mark.parametrize(
    ("code", "register"),
    [(0, 0), (0x2310, 0x03), (0x3210, 0x05), (0x4310, 0x09), (0x8130, 0x11), (0x8210, 0x11),
     (0x8611, 0x21), (0x5000, 0x01), (0xFF01, 0x01)],
)  # fmt: skip
def test_the_error_register_goes_with_the_error(code: int, register: int) -> None:
    assert cia301.error_register(code) == register


def homing(host: Host, method: int) -> None:
    """Begin to home by SDO, as a host without process data does."""
    host.send(f"605 2F 98 60 00 {method & 0xFF:02X} 00 00 00")
    host.send("605 2F 60 60 00 06 00 00 00")
    walk(host)
    host.send("605 2B 40 60 00 1F 00 00 00")


def status(host: Host) -> int:
    (answer,) = host.send("605 40 41 60 00 00 00 00 00")
    return int.from_bytes(bytes.fromhex(answer[4:])[4:6], "little")


HOMING_BITS = 0x3400
ATTAINED, FAILED, INTERRUPTED = 0x1400, 0x2400, 0x0400


@pytest.mark.parametrize(
    ("method", "home"),
    [
        (1, -8192),  # the first index pulse to the right of the switch at -10000
        (2, 16384),  # the first one to the left of the switch at 20000
        (17, -10000),
        (18, 20000),
        (33, 0),
        (34, 4096),
        (35, 700),
        (37, 700),
    ],
)
def test_each_homing_method_leads_to_its_own_home(method: int, home: int) -> None:
    host = Host(start=700.0, homed=False, switches=(-10_000.0, 20_000.0))
    homing(host, method)
    if method not in (35, 37):
        assert status(host) & HOMING_BITS == 0, "under way"
        assert host.emulator.drives[5].axis.position != home
    host.wait(5.0)
    assert status(host) & HOMING_BITS == ATTAINED
    assert host.emulator.drives[5].axis.position == home
    assert position(host) == 0, "home is where the counter is at 0"
    host.send("605 2F 60 60 00 01 00 00 00")
    host.send("605 23 7A 60 00 64 00 00 00")
    host.send("605 2B 40 60 00 0F 00 00 00")
    host.send("605 2B 40 60 00 1F 00 00 00")
    host.wait(1.0)
    assert position(host) == 100
    assert host.emulator.drives[5].axis.position == home + 100


@pytest.mark.parametrize("method", [0, 3, 19, 36, -1])
def test_other_homing_methods_are_refused_by_the_statusword(method: int) -> None:
    host = Host(start=700.0, homed=False)
    homing(host, method)
    host.wait(0.2)
    assert status(host) & HOMING_BITS == FAILED
    assert position(host) == 700
    homing(host, 35)
    host.wait(0.2)
    assert status(host) & HOMING_BITS == ATTAINED, "the next start forgets the error"


def test_homing_stops_when_its_bit_falls_or_a_halt_comes() -> None:
    host = Host(homed=False)
    homing(host, 17)
    host.wait(0.1)
    host.send("605 2B 40 60 00 1F 01 00 00")
    halted = position(host)
    host.wait(0.2)
    assert position(host) == halted
    assert status(host) & HOMING_BITS == INTERRUPTED
    host.send("605 2B 40 60 00 1F 00 00 00")
    host.wait(0.02)
    assert position(host) < halted, "it goes on"
    host.send("605 2B 40 60 00 0F 00 00 00")
    stopped = position(host)
    host.wait(0.5)
    assert position(host) == stopped
    assert status(host) & HOMING_BITS == INTERRUPTED


def test_an_index_pulse_beyond_the_stop_is_a_homing_error() -> None:
    host = Host(homed=False, lower=-100.0, upper=5000.0)
    homing(host, 33)
    host.wait(2.0)
    assert status(host) & HOMING_BITS == FAILED


def test_a_halt_stops_a_profile_move_until_it_is_over() -> None:
    host = Host(speed=2000.0)
    host.send("605 2F 60 60 00 01 00 00 00")
    walk(host)
    host.send("605 23 7A 60 00 E8 03 00 00")
    host.send("605 2B 40 60 00 1F 00 00 00")
    host.wait(0.1)
    assert 0 < position(host) < 1000
    assert not status(host) & 0x400
    host.send("605 2B 40 60 00 1F 01 00 00")
    halted = position(host)
    host.wait(0.5)
    assert position(host) == halted
    assert status(host) & 0x400, "halted: it stands"
    # A real drive may go limp or ramp down instead, by this object: here there is no choice.
    assert host.send("605 2B 5D 60 00 00 00 00 00") == ["585 80 5D 60 00 00 00 02 06"]
    host.send("605 2B 40 60 00 0F 00 00 00")
    host.wait(1.0)
    assert position(host) == 1000
    assert status(host) & 0x400


def test_a_set_point_that_comes_during_a_halt_waits() -> None:
    host = Host()
    host.send("605 2F 60 60 00 01 00 00 00")
    walk(host)
    host.send("605 2B 40 60 00 0F 01 00 00")
    host.send("605 23 7A 60 00 E8 03 00 00")
    host.send("605 2B 40 60 00 1F 01 00 00")
    host.wait(0.3)
    assert position(host) == 0
    host.send("605 2B 40 60 00 1F 00 00 00")
    host.wait(0.5)
    assert position(host) == 1000


def test_a_relative_set_point_counts_from_the_one_before() -> None:
    host = Host(start=200.0)
    host.send("605 2F 60 60 00 01 00 00 00")
    walk(host)
    host.send("605 23 7A 60 00 E8 03 00 00")
    for _ in range(2):  # the second comes long before the first is reached
        host.send("605 2B 40 60 00 7F 00 00 00")
        host.send("605 2B 40 60 00 4F 00 00 00")
    host.wait(1.0)
    assert position(host) == 2200
    host.send("605 2B 40 60 00 1F 00 00 00")
    host.wait(1.0)
    assert position(host) == 1000
