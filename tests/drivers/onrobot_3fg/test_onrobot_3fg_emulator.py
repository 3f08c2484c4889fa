"""The emulated 3FG by the bytes of its sheet, on the network and on a line."""

from __future__ import annotations

import struct

import pytest

from rtee.buses.link import Line
from rtee.buses.modbus_frames import rtu_frame
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.axis import VirtualObject
from rtee.drivers.onrobot_3fg.codec import Status
from rtee.drivers.onrobot_3fg.emulator import OnRobot3FGEmulator, OnRobot3FGProperties


class Host:
    """Speaks raw frames to an emulator, with a clock of its own."""

    def __init__(self, **properties: object) -> None:
        properties.setdefault("framing", "rtu")
        made = OnRobot3FGProperties(**properties)  # type: ignore[arg-type]
        self.gripper = OnRobot3FGEmulator(made)
        self.now = 10.0

    def frame(self, text: str, after: float = 0.01) -> str:
        self.now += after
        return b"".join(self.gripper.feed(bytes.fromhex(text), self.now)).hex(" ").upper()

    def set(self, register: int, value: int) -> None:
        frame = rtu_frame(0x41, struct.pack(">BHH", 6, register, value))
        assert self.frame(frame.hex()) == frame.hex(" ").upper()

    def status(self, after: float = 0.01) -> Status:
        answer = bytes.fromhex(self.frame("41 03 01 00 00 04 4B 35", after))
        return Status.from_registers(struct.unpack(">4H", answer[3:11]))

    def wait(self, seconds: float) -> Status:
        for _ in range(int(seconds / 0.05)):
            self.status(0.05)
        return self.status()


@pytest.mark.parametrize(
    "frame",
    [
        "41 06 00 00 01 F4 87 1D",
        "41 06 00 01 02 EE 57 E6",
        "41 06 00 02 00 00 26 CA",
        "41 06 00 03 00 01 B6 CA",
    ],
)
def test_single_registers_are_echoed(frame: str) -> None:
    assert Host().frame(frame) == frame


def test_the_sheets_frames() -> None:
    host = Host()
    assert host.frame("41 03 02 01 00 02 9A B3") == "41 03 04 00 C8 05 DC 38 C0"
    assert (
        host.frame("41 10 00 00 00 04 08 01 F4 02 EE 00 00 00 01 AA 7C")
        == "41 10 00 00 00 04 CF 0A"
    )
    done = host.wait(2.0)
    assert (done.raw_diameter, done.diameter, done.busy) == (750, 624, False)
    assert not done.grip_detected


def test_the_sheets_frames_on_the_network() -> None:
    host = Host(framing="tcp")
    reply = host.frame("00 02 00 00 00 06 41 03 01 00 00 04")
    assert reply.startswith("00 02 00 00 00 0B 41 03 08 00 08 05 DC")
    assert (
        host.frame("00 01 00 00 00 06 41 06 00 03 00 01") == "00 01 00 00 00 06 41 06 00 03 00 01"
    )
    block = bytes.fromhex(host.frame("00 01 00 00 00 06 41 03 01 00 00 12"))
    assert block[4:9] == bytes.fromhex("00 27 41 03 24")
    assert len(block) == 45
    assert host.frame("00 02 00 00 00 0F 41 10 00 00 00 04 08 00 00 02 EE 00 00 00 02").startswith(
        "00 02 00 00 00 06 41 10"
    )
    assert host.frame("00 03 00 00 00 06 42 03 01 00 00 04") == ""


def test_writing_targets_moves_nothing() -> None:
    host = Host()
    host.set(0, 500)
    host.set(1, 600)
    host.set(2, 0)
    assert host.wait(1.0).raw_diameter == 1500
    assert host.gripper.moves == 0


def test_a_grip_builds_up_its_force_after_the_contact() -> None:
    host = Host()
    host.gripper.axis.obstacle = VirtualObject(0.080, 4e4, closing=-1.0)
    for register, value in ((0, 500), (1, 400), (2, 0), (3, 1)):
        host.set(register, value)
    seen = [host.status(0.02) for _ in range(150)]
    first = next(i for i, s in enumerate(seen) if s.grip_detected)
    assert seen[first].busy
    assert not seen[first].force_grip
    last = seen[-1]
    assert (last.busy, last.grip_detected, last.force_grip) == (False, True, True)
    assert last.force == pytest.approx(500, abs=10)
    assert 765 <= last.raw_diameter <= 800


def test_grip_is_ignored_while_busy_and_stop_is_not() -> None:
    host = Host()
    host.set(1, 400)
    host.set(3, 2)
    assert host.status().busy
    host.set(1, 1400)
    host.set(3, 1)
    assert host.wait(0.5).raw_diameter < 1300
    host.set(3, 4)
    there = host.status()
    assert not there.busy
    assert host.wait(0.5).raw_diameter == there.raw_diameter


@pytest.mark.parametrize(("ignores", "end"), [("grip", 1400), ("all", 400)])
def test_whether_a_move_is_taken_while_busy_is_an_option(ignores: str, end: int) -> None:
    host = Host(busy_ignores=ignores)
    host.set(1, 400)
    host.set(3, 2)
    host.status(0.1)
    host.set(1, 1400)
    host.set(3, 2)
    assert host.wait(3.0).raw_diameter == pytest.approx(end, abs=1)


@pytest.mark.parametrize(
    ("pdu", "code"),
    [("0400000001", 1), ("0303000001", 2), ("0601000001", 2), ("0600030009", 3), ("0604030007", 3)],
)
def test_what_is_not_listed_is_refused(pdu: str, code: int) -> None:
    host = Host()
    reply = bytes.fromhex(host.frame(rtu_frame(0x41, bytes.fromhex(pdu)).hex()))
    assert reply[1:3] == bytes([int(pdu[:2], 16) | 0x80, code])


def test_the_settings_are_one_block_and_change_the_geometry() -> None:
    host = Host()
    settings = struct.pack(">BHHB4H", 0x10, 0x0401, 4, 8, 500, 0, 3, 700)
    host.frame(rtu_frame(0x41, settings).hex())
    reply = bytes.fromhex(host.frame(rtu_frame(0x41, bytes.fromhex("0301000012")).hex()))
    words = struct.unpack(">18H", reply[3:-2])
    assert (words[14], words[16], words[17]) == (500, 3, 700)
    assert words[2] == 1500 - 140


def test_another_master_drives_it() -> None:
    minimalmodbus = pytest.importorskip("minimalmodbus")
    gripper = OnRobot3FGEmulator(OnRobot3FGProperties(framing="rtu"))
    with SimulatedLine([gripper], line=Line(1_000_000, "E")) as line:
        master = minimalmodbus.Instrument(line.address, 65)
        master.serial.baudrate, master.serial.timeout = 1_000_000, 1.0  # a pty has no parity
        try:
            for register, value in ((0, 300), (1, 1200), (2, 0), (3, 2)):
                master.write_register(register, value, functioncode=6)
            for _ in range(500):
                if not master.read_register(256) & 1:
                    break
            assert master.read_register(257) == 1200
            assert master.read_register(258, signed=True) == 1074
            with pytest.raises(minimalmodbus.IllegalRequestError):
                master.read_registers(0x0300, 1)
        finally:
            master.serial.close()
