"""The emulated 3-Finger by the bytes of the manuals, on a line and on the network."""

from __future__ import annotations

import struct

import pytest

from rtee.buses.modbus_frames import rtu_frame
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.axis import VirtualObject
from rtee.drivers.robotiq_3f.codec import Command, Contact, Mode, Motion, Request, Status
from rtee.drivers.robotiq_3f.emulator import Robotiq3FEmulator, Robotiq3FProperties
from rtee.drivers.robotiq_common import Progress

CLOSE = Request(255, 255, 255)
REST = (Request(), Request(), Request())


class Host:
    """Speaks raw frames to an emulator, with a clock of its own."""

    def __init__(self, **properties: object) -> None:
        made = Robotiq3FProperties(**properties)  # type: ignore[arg-type]
        self.gripper = Robotiq3FEmulator(made)
        self.now = 50.0

    def frame(self, text: str, after: float = 0.01) -> str:
        self.now += after
        return b"".join(self.gripper.feed(bytes.fromhex(text), self.now)).hex(" ").upper()

    def write(self, command: Command, count: int = 8) -> None:
        body = struct.pack(f">{count}H", *command.to_registers()[:count])
        head = struct.pack(">BHHB", 0x10, 0x03E8, count, 2 * count)
        assert self.frame(rtu_frame(9, head + body).hex()).startswith("09 10 03 E8 00")

    def status(self, after: float = 0.01) -> Status:
        answer = bytes.fromhex(self.frame("09 03 07 D0 00 08 45 C9", after))
        return Status.from_registers(struct.unpack(">8H", answer[3:19]))

    def wait(self, seconds: float) -> Status:
        for _ in range(int(seconds / 0.1)):
            self.status(0.1)
        return self.status()


def test_the_manuals_activation_dialogue() -> None:
    host = Host(activation_time=1.0)
    assert host.frame("09 10 03 E8 00 03 06 01 00 00 00 00 00 72 E1") == "09 10 03 E8 00 03 01 30"
    assert host.frame("09 03 07 D0 00 01 85 CF") == "09 03 02 11 00 55 D5"
    host.wait(1.1)
    assert host.frame("09 03 07 D0 00 01 85 CF") == "09 03 02 31 00 4C 15"


def test_the_manuals_dialogue_on_the_network() -> None:
    host = Host(framing="tcp", activation_time=1.0)
    assert (
        host.frame("33 9A 00 00 00 0D 02 10 00 00 00 03 06 01 00 00 00 00 00")
        == "33 9A 00 00 00 06 02 10 00 00 00 03"
    )
    assert host.frame("45 33 00 00 00 06 02 04 00 00 00 01") == "45 33 00 00 00 05 02 04 02 11 00"
    host.now += 2.0
    host.frame("45 33 00 00 00 06 02 04 00 00 00 01", 0.0)
    assert (
        host.frame("45 34 00 00 00 06 02 04 00 00 00 01", 0.0) == "45 34 00 00 00 05 02 04 02 31 00"
    )
    assert (
        host.frame("34 AB 00 00 00 0D 02 10 03 E8 00 03 06 09 00 00 00 FF FF")
        == "34 AB 00 00 00 06 02 10 03 E8 00 03"
    )
    reply = bytes.fromhex(host.frame("D6 05 00 00 00 06 02 04 07 D0 00 08"))
    assert reply[:9] == bytes.fromhex("D6 05 00 00 00 13 02 04 10")


def test_simple_control_moves_all_fingers_and_echoes_only_the_first() -> None:
    host = Host(activated=True)
    host.write(Command(activate=True, go=True, axes=(CLOSE, *REST)), 3)
    assert host.status().motion is Motion.MOVING
    done = host.wait(3.0)
    assert done.motion is Motion.ALL_REACHED
    assert [a.position for a in done.axes[:3]] == [255, 255, 255]
    assert [a.requested for a in done.axes] == [255, 0, 0, 0]


def test_each_finger_goes_its_own_way() -> None:
    host = Host(activated=True)
    host.frame("09 10 03 E8 00 08 10 09 04 00 80 FF FF 40 FF FF C0 FF FF 89 FF FF 00 F0 5E")
    done = host.wait(3.0)
    assert [a.position for a in done.axes] == [0x80, 0x40, 0xC0, 0x89]


def test_open_is_the_same_count_at_power_up_and_when_opened() -> None:
    """As the manual's frames tell it: 6 or 7, with the request echoed as 0."""
    host = Host(activated=True)
    assert [a.position for a in host.status().axes[:3]] == [6, 6, 6]
    host.write(Command(activate=True, go=True, axes=(Request(100, 255, 255), *REST)), 3)
    host.wait(2.0)
    host.write(Command(activate=True, go=True, axes=(Request(0, 255, 255), *REST)), 3)
    opened = host.wait(3.0)
    assert [a.position for a in opened.axes[:3]] == [6, 6, 6]
    assert opened.motion is Motion.ALL_REACHED
    assert {a.contact for a in opened.axes[:3]} == {Contact.AT_REQUEST}
    assert opened.axes[0].requested == 0
    assert opened.axes[0].raw_current == 0, "nothing pushes against the end"


def test_the_scissor_follows_its_own_request() -> None:
    host = Host(activated=True)
    there = Request(40, 255, 255)
    host.write(Command(activate=True, go=True, scissor=True, axes=(Request(), *REST[:2], there)))
    done = host.wait(3.0)
    assert (done.axes[3].position, done.axes[3].contact) == (40, Contact.AT_REQUEST)


@pytest.mark.parametrize(
    ("mode", "scissor"), [(Mode.PINCH, 0xDC), (Mode.WIDE, 0x19), (Mode.SCISSOR, 0x19)]
)
def test_a_change_of_mode_moves_the_scissor(mode: Mode, scissor: int) -> None:
    host = Host(activated=True, mode_time=0.5)
    host.write(Command(activate=True, mode=mode), 1)
    during = host.status()
    assert (during.progress, during.mode) == (Progress.CHANGING, mode)
    host.write(Command(activate=True, mode=mode, go=True, axes=(CLOSE, *REST)), 3)
    assert host.status().fault == 6
    done = host.wait(1.0)
    assert (done.progress, done.fault) == (Progress.DONE, 0)
    assert done.axes[3].position == scissor
    assert host.wait(3.0).motion is Motion.ALL_REACHED


def test_an_object_stops_some_or_all_fingers() -> None:
    host = Host(activated=True)
    for axis in host.gripper.axes[:2]:
        axis.obstacle = VirtualObject(150, 20.0)
    host.write(Command(activate=True, go=True, axes=(CLOSE, *REST)), 3)
    some = host.wait(3.0)
    assert some.motion is Motion.SOME_SHORT
    assert [a.contact for a in some.axes[:3]] == [
        Contact.CLOSING,
        Contact.CLOSING,
        Contact.AT_REQUEST,
    ]


def test_the_automatic_release_needs_a_reset() -> None:
    host = Host(activated=True)
    host.write(Command(activate=True, go=True, axes=(CLOSE, *REST)), 3)
    host.wait(3.0)
    host.write(Command(activate=True, go=True, release=True), 1)
    assert host.status().fault == 0x0B
    assert host.wait(8.0).fault == 0x0F
    host.write(Command(), 3)
    assert host.status().fault == 0


def test_another_master_drives_it() -> None:
    minimalmodbus = pytest.importorskip("minimalmodbus")
    gripper = Robotiq3FEmulator(Robotiq3FProperties(activation_time=0.2))
    with SimulatedLine([gripper]) as line:
        master = minimalmodbus.Instrument(line.address, 9)
        master.serial.timeout = 1.0
        try:
            master.write_register(0x03E8, 0x0100, functioncode=6)
            for _ in range(400):
                if master.read_register(0x07D0) >> 12 & 3 == 3:
                    break
            master.write_registers(0x03E8, [0x0900, 0x0050, 0xFFFF])
            for _ in range(400):
                found = master.read_registers(0x07D0, 8)
                if found[0] >> 14 == 3:
                    break
            status = Status.from_registers(found)
        finally:
            master.serial.close()
    assert status.motion is Motion.ALL_REACHED
    assert status.axes[0].position == 0x50
