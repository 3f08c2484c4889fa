"""The emulated EGU by the bytes of its sheet."""

from __future__ import annotations

import struct

import pytest

from rtee.buses.modbus_frames import rtu_frame
from rtee.drivers.axis import VirtualObject
from rtee.drivers.schunk_egu.codec import (
    Control,
    Input,
    Output,
    Parameter,
    Status,
    data_of,
    float_of,
    float_registers,
)
from rtee.drivers.schunk_egu.emulator import SchunkEguEmulator, SchunkEguProperties

RUN = Control.RUN


class Host:
    """Speaks raw frames to an emulator, with a clock of its own."""

    def __init__(self, **properties: object) -> None:
        properties.setdefault("watch", 1e3)
        properties.setdefault("position", 0.251)
        made = SchunkEguProperties(**properties)  # type: ignore[arg-type]
        self.gripper = SchunkEguEmulator(made)
        self.now = 3.0

    def frame(self, text: str, after: float = 0.001) -> str:
        self.now += after
        return b"".join(self.gripper.feed(bytes.fromhex(text), self.now)).hex(" ").upper()

    def read(self, after: float = 0.001) -> Input:
        answer = bytes.fromhex(self.frame("0C 03 00 3F 00 08 75 1D", after))
        return Input.from_registers(struct.unpack(">8H", answer[3:-2]))

    def write(self, control: Control, position: int = 0, speed: int = 0, force: int = 0) -> None:
        words = Output(control, position, speed, force).to_registers()
        pdu = bytes.fromhex("10 00 47 00 08 10") + struct.pack(">8H", *words)
        assert self.frame(rtu_frame(12, pdu).hex()) == "0C 10 00 47 00 08 70 C7"

    def command(self, control: Control, *values: int) -> Input:
        before = self.read().status & Status.RECEIVED
        self.write(RUN)
        self.write(RUN | control, *values)
        after = self.read()
        assert after.status & Status.RECEIVED != before, "it was not taken"
        return after

    def wait(self, seconds: float) -> Input:
        for _ in range(round(seconds / 0.02)):
            self.read(0.02)
        return self.read()

    def ready(self) -> Input:
        self.write(RUN)
        return self.command(Control.ACKNOWLEDGE)


def test_it_comes_up_as_the_captured_one_and_is_acknowledged() -> None:
    host = Host()
    image = host.read()
    assert data_of(image.to_registers()).hex(" ") == (
        "80 00 00 80 fb 00 00 00 00 00 00 00 d9 00 00 00"
    )
    now = host.ready()
    assert now.status & (Status.READY | Status.ERROR | Status.RECEIVED) == (
        Status.READY | Status.RECEIVED
    )
    assert now.error == 0


def test_a_move_is_done_when_its_result_is_there() -> None:
    host = Host()
    host.ready()
    now = host.command(Control.MOVE, 10_000, 20_000)
    assert not now.status & (Status.SUCCESS | Status.REACHED)
    before = host.read(0.1).position
    assert host.read(0.1).position - before == pytest.approx(2000, rel=0.05)
    done = host.wait(1.0)
    assert done.position == pytest.approx(10_000, abs=20)
    assert done.status & Status.SUCCESS
    assert done.status & Status.REACHED


def test_the_same_command_again_needs_a_rise_or_the_repeat_bit() -> None:
    host = Host(position=80.0)
    host.ready()
    word = RUN | Control.MOVE
    host.write(word, 10_000, 50_000)
    host.wait(1.0)
    moves = host.gripper.moves
    host.write(word, 20_000, 50_000)
    assert host.gripper.moves == moves
    host.write(word | Control.REPEAT, 20_000, 50_000)
    assert host.gripper.moves == moves + 1
    assert host.wait(1.0).position == pytest.approx(20_000, abs=20)


@pytest.mark.parametrize("percent", [1, 50, 100])
def test_a_grip_holds_with_its_share_of_the_force(percent: int) -> None:
    host = Host(position=30.0)
    host.ready()
    host.gripper.axis.obstacle = VirtualObject(20.0, 1e4, closing=-1.0)
    host.command(Control.GRIP, 0, 0, percent)
    now = host.wait(2.0)
    assert now.status & Status.GRIPPED
    assert abs(host.gripper.axis.effort) == pytest.approx(1.5 * percent)
    host.command(Control.RELEASE)
    now = host.wait(1.0)
    assert now.status & Status.REACHED
    assert now.position == pytest.approx(30_000, abs=50)


def test_a_grip_that_meets_nothing_says_so() -> None:
    host = Host(position=10.0)
    host.ready()
    host.command(Control.GRIP, 0, 0, 50)
    now = host.wait(2.0)
    assert now.status & Status.NO_WORKPIECE
    assert not now.status & Status.GRIPPED


@pytest.mark.parametrize(
    ("control", "values"),
    [
        (Control.MOVE, (10_000, 0)),
        (Control.MOVE, (90_000, 20_000)),
        (Control.MOVE, (10_000, 300_000)),
        (Control.GRIP, (0, 0, 0)),
        (Control.GRIP, (0, 0, 101)),
        (Control.MOVE | Control.GRIP, (10_000, 20_000, 50)),
    ],
)
def test_what_is_not_feasible_is_refused(control: Control, values: tuple[int, ...]) -> None:
    host = Host()
    host.ready()
    assert host.command(control, *values).status & Status.NOT_FEASIBLE
    assert host.gripper.moves == 0


def test_a_clear_first_bit_is_a_fast_stop() -> None:
    host = Host()
    host.ready()
    host.command(Control.MOVE, 30_000, 20_000)
    host.write(Control(0))
    now = host.read()
    assert (now.error, bool(now.status & Status.ERROR)) == (0xD9, True)
    assert host.wait(0.3).position == now.position
    assert host.ready().error == 0


def test_a_fast_stop_is_acknowledged_by_the_toggle() -> None:
    host = Host()
    before = host.ready().status & Status.RECEIVED
    host.write(Control(0))
    assert host.read().status & Status.RECEIVED != before
    # Only its falling edge is a command.
    after = host.read().status & Status.RECEIVED
    host.write(Control(0))
    assert host.read().status & Status.RECEIVED == after


def test_the_parameters_of_the_makers_tools_move_it() -> None:
    """The maker's demo writes target, speed, force and direction, then a command code."""
    host = Host(position=80.0)

    def write(parameter: Parameter, values: tuple[int, ...]) -> str:
        head = struct.pack(">BHHB", 16, parameter.register, len(values), 2 * len(values))
        pdu = head + struct.pack(f">{len(values)}H", *values)
        return host.frame(rtu_frame(12, pdu).hex())

    def number(parameter: Parameter, value: float) -> None:
        assert write(parameter, float_registers(value)).startswith("0C 10")

    host.write(RUN)
    write(Parameter.COMMAND, (0x8B00,))
    assert host.read().status & Status.READY
    number(Parameter.SET_POSITION, 30.0)
    number(Parameter.SET_SPEED, 50.0)
    write(Parameter.COMMAND, (0xB000,))
    done = host.wait(1.5)
    assert (done.position, bool(done.status & Status.REACHED)) == (
        pytest.approx(30_000, abs=40), True,
    )  # fmt: skip
    host.gripper.axis.obstacle = VirtualObject(20.0, 1e4, closing=-1.0)
    number(Parameter.SET_FORCE, 50.0)
    number(Parameter.SET_SPEED, 0.0)
    write(Parameter.DIRECTION, (0,))
    write(Parameter.COMMAND, (0xB400,))
    assert host.wait(1.0).status & Status.GRIPPED
    assert abs(host.gripper.axis.effort) == pytest.approx(75.0)
    number(Parameter.RELEASE_DELTA, 5.0)
    write(Parameter.COMMAND, (0x1100,))
    assert host.wait(1.0).position == pytest.approx(25_000, abs=60)
    assert write(Parameter.COMMAND, (0x0100,)).startswith("0C 90 03")
    write(Parameter.COMMAND, (0x9000,))
    assert host.read().error == 0xD9


def test_silence_is_a_lost_communication() -> None:
    host = Host(watch=0.5)
    host.ready()
    host.command(Control.MOVE, 30_000, 20_000)
    assert host.read(0.6).error == 0xEF


def test_parameters_are_read_by_number_less_one() -> None:
    host = Host()
    host.ready()

    def words(parameter: Parameter, count: int) -> list[int]:
        pdu = struct.pack(">BHH", 3, parameter.register, count)
        answer = bytes.fromhex(host.frame(rtu_frame(12, pdu).hex()))
        return list(struct.unpack(f">{count}H", answer[3:-2]))

    assert float_of(words(Parameter.MOST_POSITION, 2)) == 80.0
    assert float_of(words(Parameter.MOST_FORCE, 2)) == 150.0
    assert float_of(words(Parameter.POSITION, 2)) == pytest.approx(0.251)
    assert words(Parameter.MODULE, 1) == [18 << 8]
    assert words(Parameter.FIELDBUS, 1) == [7 << 8]
    assert host.frame(rtu_frame(12, bytes.fromhex("03 20 00 00 01")).hex()).startswith("0C 83 02")
    assert host.frame(rtu_frame(12, bytes.fromhex("10 00 47 00 01 02 00 01")).hex()).startswith(
        "0C 90 03"
    )
