"""The emulated 2F by bytes alone, and with a program that others wrote for the real one."""

from __future__ import annotations

import struct
from typing import Literal

import pytest

from rtee.buses.modbus_frames import rtu_frame
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.axis import VirtualObject
from rtee.drivers.robotiq_2f.codec import Command, Grasp, Status
from rtee.drivers.robotiq_2f.emulator import Robotiq2FEmulator, Robotiq2FProperties


class Host:
    """Speaks raw frames to an emulator, with a clock of its own."""

    def __init__(self, **properties: object) -> None:
        made = Robotiq2FProperties(**properties)  # type: ignore[arg-type]
        self.gripper = Robotiq2FEmulator(made)
        self.now = 100.0

    def frame(self, text: str, after: float = 0.01) -> str:
        self.now += after
        return b"".join(self.gripper.feed(bytes.fromhex(text), self.now)).hex(" ").upper()

    def write(self, command: Command, after: float = 0.01) -> None:
        pdu = bytes.fromhex("1003E8000306") + struct.pack(">3H", *command.to_registers())
        assert self.frame(rtu_frame(9, pdu).hex(), after) == "09 10 03 E8 00 03 01 30"

    def status(self, after: float = 0.01) -> Status:
        answer = bytes.fromhex(self.frame("09 03 07 D0 00 03 04 0E", after))
        assert answer == rtu_frame(9, answer[1:-2])
        assert (len(answer), answer[:3]) == (11, b"\x09\x03\x06")
        return Status.from_registers(struct.unpack(">3H", answer[3:9]))

    def wait(self, seconds: float) -> Status:
        for _ in range(int(seconds / 0.1)):
            self.status(0.1)
        return self.status()


GO = Command(activate=True, go=True, position=255, speed=255, force=255)


def test_the_manuals_activation_dialogue() -> None:
    host = Host(activation_time=1.0)
    assert host.frame("09 10 03 E8 00 03 06 00 00 00 00 00 00 73 30") == "09 10 03 E8 00 03 01 30"
    assert host.frame("09 10 03 E8 00 03 06 01 00 00 00 00 00 72 E1") == "09 10 03 E8 00 03 01 30"
    assert host.frame("09 04 07 D0 00 01 30 0F") == "09 04 02 11 00 54 A1"
    assert host.frame("09 03 07 D0 00 01 85 CF") == "09 03 02 11 00 55 D5"
    host.wait(1.1)
    assert host.frame("09 04 07 D0 00 01 30 0F") == "09 04 02 31 00 4D 61"
    assert host.frame("09 03 07 D0 00 01 85 CF") == "09 03 02 31 00 4C 15"


def test_a_read_of_six_registers_is_seventeen_bytes() -> None:
    host = Host(activated=True)
    host.write(Command(activate=True))
    assert (
        host.frame("09 03 07 D0 00 06 C4 0D")
        == "09 03 0C 31 00 00 00 03 00 00 00 00 00 00 00 66 E0"
    )


def test_one_register_may_be_written_alone_by_function_16_or_6() -> None:
    host = Host(activation_time=0.5)
    assert host.frame("09 10 03 E8 00 01 02 09 00 E3 E8") == "09 10 03 E8 00 01 80 F1"
    assert host.wait(0.6).ready
    host.frame(rtu_frame(9, bytes.fromhex("0603E90050")).hex())
    assert host.status().requested == 0x50
    host.frame(rtu_frame(9, bytes.fromhex("0603EAFFFF")).hex())
    assert host.wait(1.0).position == 0x50


def test_a_partial_write_leaves_the_activation_alone() -> None:
    host = Host(activated=True)
    reply = host.frame("09 17 07 D0 00 02 03 E9 00 02 04 00 E6 3C C8 2D 0C")
    assert reply.startswith("09 17 04 39 00 00 E6")
    assert host.wait(2.5).position == 0xE6


@pytest.mark.parametrize(
    "frame",
    [
        "09 03 07 D0 00 03 04 0F",  # checksum
        "08 03 07 D0 00 03 05 DF",  # another unit
        rtu_frame(9, bytes.fromhex("0300000003")).hex(),  # no such address
        rtu_frame(9, bytes.fromhex("0207D00003")).hex(),  # no such function
        rtu_frame(9, bytes.fromhex("0307D00000")).hex(),  # no registers
    ],
)
def test_what_it_does_not_understand_it_does_not_answer(frame: str) -> None:
    host = Host()
    assert host.frame(frame) == ""
    assert not host.status().activated


def test_it_moves_at_the_speed_asked_for() -> None:
    host = Host(activated=True)
    host.write(Command(activate=True, go=True, position=255, speed=0, force=0))
    before = host.status().position
    moved = host.status(1.0).position - before
    assert moved == pytest.approx(20.0 * 227 / 85, rel=0.1)
    assert host.status().grasp is Grasp.MOVING


def test_closing_on_nothing_and_on_an_object_are_told_apart() -> None:
    host = Host(activated=True)
    host.write(GO)
    closed = host.wait(1.5)
    assert (closed.position, closed.grasp) == (230, Grasp.AT_REQUEST)
    host.write(Command(activate=True, go=True, position=0, speed=255, force=0))
    host.wait(1.5)
    host.gripper.axis.obstacle = VirtualObject(120, 40.0)
    host.write(GO)
    held = host.wait(1.5)
    assert held.grasp is Grasp.CONTACT_CLOSING
    assert 120 <= held.position <= 127
    assert held.requested == 255
    assert held.raw_current > 50


def test_weaker_grips_press_less() -> None:
    depth = []
    for force in (0, 128, 255):
        host = Host(activated=True)
        host.gripper.axis.obstacle = VirtualObject(120, 20.0)
        host.write(Command(activate=True, go=True, position=255, speed=255, force=force))
        host.wait(1.5)
        depth.append(host.gripper.axis.position)
    assert depth == sorted(depth)
    assert depth[2] - depth[0] > 5


def test_clearing_rgto_stops_it() -> None:
    host = Host(activated=True)
    host.write(Command(activate=True, go=True, position=255, speed=0, force=0))
    host.status(0.5)
    host.write(Command(activate=True, position=255, speed=0, force=0))
    there = host.status().position
    later = host.wait(1.0)
    assert later.position == there
    assert not later.going


def test_requests_before_and_during_activation_are_priority_faults() -> None:
    host = Host(activation_time=1.0)
    host.write(Command(go=True, position=100))
    assert host.status().fault == 7
    host.write(GO)
    during = host.status()
    assert (during.fault, during.going) == (5, False)
    assert host.wait(1.2).fault == 0
    assert host.wait(1.5).position == 230


def test_silence_of_a_second_is_told_once() -> None:
    host = Host(activated=True)
    host.status()
    assert host.status(1.5).fault == 9
    assert host.status().fault == 0


def test_the_automatic_release_ends_in_a_fault_that_only_a_reset_clears() -> None:
    host = Host(activated=True, position=100)
    host.frame("09 10 03 E8 00 03 06 31 00 00 00 00 00" + crc("091003E80003063100 00000000"))
    assert host.status().fault == 0x0B
    done = host.wait(4.0)
    assert (done.fault, done.position) == (0x0F, 3)
    host.write(GO)
    assert host.wait(0.5).position == 3
    host.write(Command())
    assert host.status().fault == 0
    host.write(Command(activate=True))
    assert host.wait(2.0).ready


def crc(text: str) -> str:
    from rtee.buses.modbus_frames import crc16

    return crc16(bytes.fromhex(text)).hex()


def test_major_faults_stop_it_and_last_until_a_reset() -> None:
    host = Host(activated=True)
    host.write(GO)
    host.status(0.2)
    host.gripper.inject("overcurrent")
    stopped = host.status()
    assert stopped.fault == 0x0E
    assert host.wait(0.5).position == stopped.position
    host.gripper.clear()
    assert host.status().fault == 0x0E
    host.write(Command())
    assert host.status().fault == 0


def test_a_power_cycle_costs_the_activation_but_not_the_position() -> None:
    host = Host(activated=True, position=150)
    host.gripper.power_cycle(host.now)
    status = host.status()
    assert (status.activated, status.position) == (False, 150)


@pytest.mark.parametrize(("socket", "model"), [(False, "2f_85"), (True, "2f_140")])
def test_a_program_of_others_drives_it(socket: bool, model: Literal["2f_85", "2f_140"]) -> None:
    rq = pytest.importorskip("pyrobotiqgripper")
    gripper = Robotiq2FEmulator(Robotiq2FProperties(model=model, activation_time=0.4))
    with SimulatedLine([gripper], tcp=socket) as line:
        if socket:
            _, host, port = line.address.replace("//", "").split(":")
            client = rq.RobotiqGripper(
                connection_type="RTU_VIA_TCP", tcp_host=host, tcp_port=int(port)
            )
        else:
            client = rq.RobotiqGripper(com_port=line.address)
        try:
            client.activate()
            assert gripper.activations == 1
            client.move(120, speed=255, force=100)
            assert gripper.axis.position == pytest.approx(120, abs=1)
            gripper.axis.obstacle = VirtualObject(150, 40.0)
            client.close()
            assert 150 <= gripper.axis.position <= 157
        finally:
            client.disconnect()


def test_a_hand_e_closes_at_the_speeds_and_grips_with_the_forces_of_its_sheet() -> None:
    host = Host(model="hand_e", activated=True)
    counts = 230.0 - 3.0
    for byte, speed, force in ((0, 0.020, 20.0), (255, 0.150, 130.0)):
        host.gripper.axis.obstacle = None
        host.write(Command(activate=True, go=True, position=0, speed=255, force=255))
        host.wait(2.0)
        host.write(Command(activate=True, go=True, position=255, speed=byte, force=byte))
        host.wait(0.1)
        here = host.gripper.axis.position
        host.wait(0.1)
        way = (host.gripper.axis.position - here) * 0.050 / counts
        # `wait` takes 0.1 s and one reading of 10 ms.
        assert way == pytest.approx(0.11 * speed, rel=0.02)
        host.gripper.axis.obstacle = VirtualObject(200, 1e3)
        status = host.wait(4.0)
        assert status.grasp is Grasp.CONTACT_CLOSING
        assert host.gripper.axis.effort == pytest.approx(force)
