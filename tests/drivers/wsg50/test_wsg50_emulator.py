"""The emulated WSG 50 by the bytes of its sheet."""

from __future__ import annotations

import pytest

from rtee.drivers.axis import VirtualObject
from rtee.drivers.wsg50.codec import (
    Command,
    Frame,
    FrameParser,
    Grasping,
    State,
    Status,
    acknowledge,
    asking,
    grasp,
    home,
    move,
    number,
    release,
    setting,
)
from rtee.drivers.wsg50.emulator import Wsg50Emulator, Wsg50Properties


class Host:
    """Speaks frames to an emulator, with a clock of its own."""

    def __init__(self, **properties: object) -> None:
        properties.setdefault("referenced", True)
        self.gripper = Wsg50Emulator(Wsg50Properties(**properties))  # type: ignore[arg-type]
        self.now = 5.0
        self.parser = FrameParser()

    def raw(self, text: str) -> str:
        self.now += 0.001
        sent = self.gripper.feed(bytes.fromhex("AA AA AA" + text), self.now)
        return b"".join(sent).hex(" ").upper()

    def ask(self, frame: Frame) -> list[Frame]:
        self.now += 0.001
        return self.parser.feed(b"".join(self.gripper.feed(frame.to_bytes(), self.now)))

    def status(self, frame: Frame) -> Status:
        return self.ask(frame)[-1].status

    def wait(self, seconds: float) -> list[Frame]:
        sent = b""
        for _ in range(round(seconds / 0.005)):
            self.now += 0.005
            sent += b"".join(self.gripper.step(self.now))
        return self.parser.feed(sent)


def test_the_sheets_dialogues() -> None:
    host = Host(position=30.0)
    pre = "AA AA AA "
    assert host.raw("06 02 00 01 02 E8 E3") == pre + "06 04 00 00 00 01 02 AD 2E"
    assert host.raw("07 00 00 35 4C") == pre + "07 02 00 00 00 62 0E"
    assert host.raw("32 04 00 00 00 A0 41 F5 22") == pre + "32 02 00 00 00 9C 93"
    assert host.raw("43 03 00 00 00 00 B8 10") == pre + "43 06 00 00 00 00 00 F0 41 39 34"
    assert host.raw("24 03 00 61 63 6B DC B9") == pre + "24 02 00 00 00 B9 7E"
    assert host.raw("50 00 00 DB 87") == pre + "50 0A 00 00 00 02 01 00 40 D2 04 00 00 43 4A"
    assert host.raw("46 03 00 00 00 00 5A 83") == pre + "46 04 00 00 00 FA 00 A6 30"
    limits = host.raw("53 00 00 3D 38")
    assert limits.startswith(pre + "53 22 00 00 00 00 00 DC 42")
    assert limits.endswith("4A 0C")
    unknown = Frame(0x90).to_bytes()[3:].hex()
    assert host.raw(unknown) == pre + "90 02 00 0E 00 FD 02"


def test_homing_is_pending_then_done() -> None:
    host = Host(referenced=False)
    assert host.status(move(30.0, 100.0, stop_on_block=True)) is Status.NOT_REFERENCED
    assert host.raw("20 01 00 00 8F 83") == "AA AA AA 20 02 00 1A 00 FC 32"
    [done] = host.wait(2.0)
    assert done.to_bytes() == bytes.fromhex("AA AA AA 20 02 00 00 00 B3 FD")
    assert host.gripper.state() == State.REFERENCED | State.STOPPED | State.REACHED


def test_a_motion_takes_its_speed_and_refuses_another() -> None:
    host = Host(position=110.0)
    assert host.status(move(10.0, 200.0, stop_on_block=True)) is Status.PENDING
    host.wait(0.2)
    before = host.gripper.axis.position
    host.wait(0.1)
    assert before - host.gripper.axis.position == pytest.approx(20.0, rel=0.01)
    assert host.status(move(90.0, 200.0, stop_on_block=True)) is Status.ALREADY_RUNNING
    # Getters and stop are answered meanwhile; the stop aborts the motion.
    assert host.status(asking(Command.WIDTH)) is Status.OK
    stopped, aborted = host.ask(Frame(Command.STOP))
    assert (stopped.command, stopped.status) == (Command.STOP, Status.OK)
    assert aborted.to_bytes() == bytes.fromhex("AA AA AA 21 02 00 13 00 BD 7E")
    there = host.gripper.axis.position
    assert host.wait(0.2) == []
    assert host.gripper.axis.position == pytest.approx(there, abs=0.01)


def test_what_lies_outside_is_refused() -> None:
    host = Host()
    for request in (
        move(50.0, 421.0, stop_on_block=True),
        move(50.0, 4.0, stop_on_block=True),
        setting(Command.SET_FORCE, 121.0),
        setting(Command.SET_ACCELERATION, 99.0),
        setting(Command.SET_SOFT_LIMITS, -1.0, 105.0),
    ):
        assert host.status(request) is Status.RANGE
    assert host.status(Frame(Command.MOVE, b"\0")) is Status.TOO_FEW_PARAMETERS
    assert host.status(Frame(Command.STOP, b"\0")) is Status.NO_PARAMETER_EXPECTED
    assert host.status(Frame(Command.TARE)) is Status.NOT_AVAILABLE


def test_a_width_beyond_the_stroke_is_the_end_of_it() -> None:
    host = Host(position=80.0)
    assert host.status(move(300.0, 100.0, stop_on_block=True)) is Status.PENDING
    host.wait(2.0)
    assert host.gripper.axis.position == pytest.approx(110.0, abs=0.1)


@pytest.mark.parametrize("force", [5.0, 20.0, 80.0])
def test_a_grasp_holds_with_the_force_limit(force: float) -> None:
    host = Host(position=80.0)
    host.gripper.axis.obstacle = VirtualObject(40.0, 1e4, closing=-1.0)
    assert host.status(setting(Command.SET_FORCE, force)) is Status.OK
    assert number(host.ask(Frame(Command.FORCE_LIMIT))[0]) == force
    assert host.status(grasp(40.0, 100.0)) is Status.PENDING
    assert [one.status for one in host.wait(1.0)] == [Status.OK]
    assert host.ask(asking(Command.GRASPING))[0].payload[2] == Grasping.HOLDING
    assert number(host.ask(asking(Command.FORCE))[0]) == pytest.approx(force)
    assert host.status(release(80.0, 100.0)) is Status.PENDING
    assert [one.status for one in host.wait(1.0)] == [Status.OK]
    assert number(host.ask(asking(Command.WIDTH))[0]) == pytest.approx(80.0, abs=0.1)


def test_a_grasp_without_a_part_fails() -> None:
    host = Host(position=80.0)
    host.status(grasp(40.0, 100.0))
    assert [one.to_bytes().hex(" ") for one in host.wait(2.0)] == ["aa aa aa 25 02 00 12 00 e4 c9"]
    assert host.ask(asking(Command.GRASPING))[0].payload[2] == Grasping.NO_PART
    assert host.gripper.axis.position == pytest.approx(35.0, abs=0.1)


def test_a_blocked_motion_says_so() -> None:
    host = Host(position=80.0)
    host.gripper.axis.obstacle = VirtualObject(40.0, 1e4, closing=-1.0)
    host.status(move(20.0, 100.0, stop_on_block=True))
    assert [one.status for one in host.wait(1.0)] == [Status.AXIS_BLOCKED]
    assert State.BLOCKED_MINUS in host.gripper.state()


def test_a_fast_stop_is_latched_until_it_is_acknowledged() -> None:
    host = Host(position=80.0)
    host.status(move(20.0, 100.0, stop_on_block=True))
    host.wait(0.1)
    assert host.ask(Frame(Command.FAST_STOP))[0].status is Status.OK
    assert host.status(move(20.0, 100.0, stop_on_block=True)) is Status.ACCESS_DENIED
    assert host.status(Frame(Command.ACKNOWLEDGE, b"no!")) is Status.PARAMETER
    assert host.status(acknowledge()) is Status.OK
    assert host.status(move(20.0, 100.0, stop_on_block=True)) is Status.PENDING


def test_a_connection_that_ends_without_a_word_may_be_a_fast_stop() -> None:
    host = Host(error_on_disconnect=True)
    host.ask(asking(Command.WIDTH))
    host.gripper.line_reset()
    assert State.FAST_STOP in host.gripper.state()
    host.status(acknowledge())
    host.status(Frame(Command.DISCONNECT))
    host.gripper.line_reset()
    assert State.FAST_STOP not in host.gripper.state()


def test_measurements_come_periodically_where_asked_for() -> None:
    host = Host(position=30.0)
    host.raw("43 03 00 01 32 00 1C 78")
    assert len(host.wait(1.0)) == pytest.approx(20, abs=1)
    host.raw("43 03 00 00 00 00 B8 10")
    assert host.wait(0.5) == []


def test_homing_takes_a_direction() -> None:
    assert Host().status(home(2)) is Status.PENDING
    assert Host().status(Frame(Command.HOME, b"")) is Status.TOO_FEW_PARAMETERS
