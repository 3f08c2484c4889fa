"""The emulated RG by the bytes of its sheet, on the network and on a line."""

from __future__ import annotations

import math
import struct

import pytest

from rtee.buses.modbus_frames import rtu_frame
from rtee.drivers.axis import VirtualObject
from rtee.drivers.onrobot_rg.codec import MODELS, Command, Control, Status
from rtee.drivers.onrobot_rg.emulator import OnRobotRGEmulator, OnRobotRGProperties


class Host:
    """Speaks raw frames to an emulator, with a clock of its own."""

    def __init__(self, **properties: object) -> None:
        properties.setdefault("framing", "rtu")
        made = OnRobotRGProperties(**properties)  # type: ignore[arg-type]
        self.gripper = OnRobotRGEmulator(made)
        self.now = 10.0

    def frame(self, text: str, after: float = 0.001) -> str:
        self.now += after
        return b"".join(self.gripper.feed(bytes.fromhex(text), self.now)).hex(" ").upper()

    def command(self, command: Command) -> None:
        pdu = bytes.fromhex("1000000003 06") + struct.pack(">3H", *command.to_registers())
        assert self.frame(rtu_frame(0x41, pdu).hex()) == "41 10 00 00 00 03 8E C8"

    def status(self, after: float = 0.001) -> Status:
        answer = bytes.fromhex(self.frame("41 03 01 0B 00 02 BA F5", after))
        return Status.from_registers(struct.unpack(">2H", answer[3:7]))

    def wait(self, seconds: float) -> Status:
        for _ in range(int(seconds / 0.05)):
            self.status(0.05)
        return self.status()


def test_the_sheets_frames() -> None:
    host = Host(position=0.05)
    assert host.frame("41 03 01 0B 00 02 BA F5") == "41 03 04 01 F4 00 00 FB F9"
    assert host.frame("41 03 01 13 00 01 7A F3") == "41 03 02 01 92 39 B6"
    assert host.frame("41 03 01 02 00 01 2A F6") == "41 03 02 00 31 78 5F"
    assert host.frame("41 03 06 00 00 01 8A 42") == "41 03 02 00 20 B8 53"
    assert host.frame("41 06 00 02 00 08 27 0C") == "41 06 00 02 00 08 27 0C"
    assert host.frame("41 10 04 07 00 01 02 00 31 12 30") == "41 10 04 07 00 01 BF F8"
    assert host.frame("41 03 06 04 00 02 8B 82").startswith("41 03 04")
    assert host.frame("41 03 01 02 00 12 6B 3B").startswith("41 03 24 00 31")


def test_the_sheets_frames_on_the_network() -> None:
    host = Host(framing="tcp", position=0.05)
    read = "00 01 00 00 00 06 41 03 01 0B 00 02"
    assert host.frame(read) == "00 01 00 00 00 07 41 03 04 01 F4 00 00"
    write = "00 02 00 00 00 0D 41 10 00 00 00 03 06 00 C8 01 2C 00 10"
    assert host.frame(write) == "00 02 00 00 00 06 41 10 00 00 00 03"
    host.now += 2.0
    # 30 mm between the fingertips, each 4.9 mm thick.
    assert host.gripper.status().width == 500
    host.frame(read)
    assert host.gripper.status().width == 398


def test_an_rg6_says_so_and_opens_to_its_stroke() -> None:
    host = Host(model="rg6", position=0.05)
    assert host.frame("41 03 06 00 00 01 8A 42").startswith("41 03 02 00 21")
    host.command(Command(1200, 1600, Control.GRIP))
    assert host.wait(3.0) == Status(width=1600)


@pytest.mark.parametrize("model", list(MODELS))
def test_the_links_turn_at_their_speed(model: str) -> None:
    host = Host(model=model)
    host.command(Command(100, 0, Control.GRIP))
    host.wait(0.2)
    before = host.gripper.axis.position
    host.status(0.1)
    turned = before - host.gripper.axis.position
    assert turned / 0.1 == pytest.approx(math.radians({"rg2": 67.35, "rg6": 48.65}[model]))


@pytest.mark.parametrize("tenths", [30, 200, 400, 900])
def test_it_grips_with_the_force_of_its_register(tenths: int) -> None:
    host = Host()
    host.gripper.axis.obstacle = VirtualObject(MODELS["rg2"].angle(0.05), 1e5, closing=-1.0)
    host.command(Command(tenths, 0, Control.GRIP))
    assert host.status().busy
    state = host.wait(2.0)
    assert state.grip_detected
    assert not state.busy
    assert state.width == pytest.approx(500, abs=2)
    # The RG2 gives at most 40 N, whatever the register asks for.
    assert abs(host.gripper.axis.effort) == pytest.approx(min(tenths / 10, 40.0), rel=1e-3)


def test_a_command_is_ignored_while_it_is_busy_except_stop() -> None:
    host = Host()
    host.command(Command(100, 200, Control.GRIP))
    host.status(0.2)
    host.command(Command(100, 900, Control.GRIP))
    assert (host.gripper.moves, host.status().busy) == (1, True)
    host.command(Command(100, 900, Control.STOP))
    there = host.status()
    assert not there.busy
    assert host.wait(0.5) == there
    host.command(Command(100, 900, Control.GRIP))
    assert host.wait(2.0).width == 900


def test_a_safety_switch_ends_a_motion_until_the_tool_is_restarted() -> None:
    host = Host()
    host.command(Command(100, 200, Control.GRIP))
    host.status(0.2)
    host.gripper.inject("safety_1")
    stopped = host.status()
    assert (stopped.pushed, stopped.triggered) == ((True, False), (True, False))
    host.command(Command(100, 900, Control.GRIP))
    assert host.wait(0.3) == stopped
    host.gripper.power_cycle(host.now)
    # It is still pushed, which is an error of its own.
    assert host.status().safety_error
    host.gripper.inject("stuck")
    host.gripper.clear("stuck")
    assert host.status().safety_error
    host.gripper.clear()
    host.gripper.power_cycle(host.now)
    assert host.status() == Status(width=stopped.width)
    host.command(Command(100, 900, Control.GRIP))
    assert host.wait(2.0).width == 900


def test_a_switch_that_is_pushed_at_rest_ends_the_next_motion() -> None:
    host = Host()
    host.gripper.inject("safety_2")
    assert host.status().triggered == (False, False)
    host.command(Command(100, 200, Control.GRIP))
    assert host.status().triggered == (False, True)
    assert not host.status().busy


@pytest.mark.parametrize(
    ("request_frame", "code"),
    [
        ("03 05 00 00 01", 2),
        ("06 01 0B 00 01", 2),
        ("06 00 02 00 07", 3),
        ("04 01 0B 00 02", 1),
    ],
)
def test_what_it_does_not_know_is_refused(request_frame: str, code: int) -> None:
    pdu = bytes.fromhex(request_frame)
    answer = Host().frame(rtu_frame(0x41, pdu).hex())
    assert answer == rtu_frame(0x41, bytes([pdu[0] | 0x80, code])).hex(" ").upper()
