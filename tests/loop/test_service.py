"""The service manager hears of the loop what is so: sd_notify over real sockets."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import numpy as np
import pytest
from patient import patient_gripper
from rtee_process import RTEE

from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.hand.model import Hand
from rtee.log import read
from rtee.loop.service import FEEDS, ServiceReporter
from rtee.sample import ActuatorState

from .hands import running

URDF = """<robot name="jaw">
  <link name="palm"/>
  <link name="jaw"><collision><geometry><box size="0.01 0.01 0.05"/></geometry></collision></link>
  <joint name="drive" type="revolute">
    <parent link="palm"/><child link="jaw"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.8" velocity="2" effort="10"/>
  </joint>
</robot>
"""


class Manager:
    """Stands in for systemd: the other end of the notify socket."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address.replace("@", "\0", 1))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def receive(self, within: float = 30.0) -> list[str]:
        """Return the lines of the next message; none if none comes within a time [s]."""
        self.socket.settimeout(within)
        try:
            return self.socket.recv(4096).decode().splitlines()
        except (TimeoutError, BlockingIOError):
            return []

    def received(self) -> list[str]:
        """Return the lines of all messages that have come."""
        lines: list[str] = []
        while message := self.receive(0.0):
            lines += message
        return lines

    def wait_for(self, line: str) -> list[str]:
        """Return the message that holds a line."""
        while message := self.receive():
            if line in message:
                return message
        raise AssertionError(f"'{line}' did not come")


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    address = str(tmp_path / "notify")
    if request.param == "abstract":
        address = f"@rtee-test-{os.getpid()}"
    with Manager(address) as made:
        yield made


@pytest.fixture
def notified(tmp_path: Path) -> Iterator[Manager]:
    with Manager(str(tmp_path / "notify")) as made:
        yield made


def service_at(manager: Manager, watchdog: float = 2.0) -> ServiceReporter:
    variables = {"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": f"{watchdog * 1e6:.0f}"}
    service = ServiceReporter.of(variables)
    assert service is not None
    assert not variables, "programs that this one starts are not the service"
    return service


@pytest.mark.anyio
async def test_ticks_and_nothing_else_feed_the_watchdog(hand: Hand, manager: Manager) -> None:
    with service_at(manager) as service:
        async with running(hand) as rig:
            rig.loop.add_observer(service.watch("small"))
            assert manager.received() == [], "ready before the first tick"
            await rig.run(0.002)
            assert manager.received() == ["WATCHDOG=1", "READY=1", "STATUS=small: connecting"]
            await rig.run(2.0)
            lines = manager.received()
            assert lines.count("WATCHDOG=1") == pytest.approx(FEEDS, abs=1)
            assert "READY=1" not in lines
            assert "STATUS=small: dummy active" in lines
            assert manager.received() == [], "without a tick nothing is fed"
            service.stopping()
            await rig.run(1.0)
    assert manager.received() == ["STOPPING=1", "STATUS=small: dummy active"]


@pytest.mark.anyio
async def test_all_hands_must_tick(hand: Hand, manager: Manager) -> None:
    with service_at(manager) as service:
        async with running(hand) as one, running(hand) as other:
            one.loop.add_observer(service.watch("one"))
            other.loop.add_observer(service.watch("other"))
            await one.run(1.0)
            assert manager.received() == []
            await other.run(0.001)
            assert "READY=1" in manager.received()
            await one.run(3.0)
            assert "WATCHDOG=1" not in manager.received()
            await other.run(2.0)
            assert manager.received().count("WATCHDOG=1") == 1, "now the first one is missing"


@pytest.mark.anyio
async def test_a_manager_that_does_not_read_holds_nothing_up(hand: Hand, manager: Manager) -> None:
    with service_at(manager) as service:
        async with running(hand) as rig:
            rig.loop.add_observer(service.watch("small"))
            for _ in range(10_000):  # more than the socket keeps
                if not service._send("STATUS=full"):
                    break
            else:
                pytest.fail("the socket takes everything")
            await rig.run(1.0)
            assert set(manager.received()) == {"STATUS=full"}
            await rig.run(0.001)
            assert "READY=1" in manager.received(), "it is sent when there is room again"
            manager.socket.close()
            await rig.run(1.0)
            assert rig.watcher.kinds().count("observer_failed") == 0


def test_the_environment_says_who_is_the_service(manager: Manager) -> None:
    assert ServiceReporter.of({}) is None
    assert ServiceReporter.of({"NOTIFY_SOCKET": "relative/path"}) is None
    variables = {"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "2000000"}
    own, foreign = {"WATCHDOG_PID": str(os.getpid())}, {"WATCHDOG_PID": "1"}
    for more, every in (({}, 0.2), (own, 0.2), (foreign, 0.0), ({"WATCHDOG_USEC": "soon"}, 0.0)):
        service = ServiceReporter.of(variables | more)
        assert service is not None
        with service:
            assert service._every == pytest.approx(every)


# --- processes -----------------------------------------------------------------------------------


class Blocking(KinematicDriver):
    """Blocks the thread of the loop while there is a file ``block``."""

    async def sense(self) -> ActuatorState:
        wait_while_blocked()
        return await super().sense()


def wait_while_blocked() -> None:
    if Path("block").exists():
        Path("blocked").touch()
        while Path("block").exists():
            time.sleep(0.01)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    hand = tmp_path / "jaw"
    hand.mkdir()
    (hand / "jaw.urdf").write_text(URDF)
    (hand / "hand.yaml").write_text("name: jaw\nurdf: jaw.urdf\nloop: {rate: 200}\n")
    return tmp_path


ALONE = (sys.executable, "-m", "rtee")
"""A process of its own, for what is stopped, or ended by a signal that `RTEE` does not hand on."""


@contextmanager
def started(
    folder: Path, manager: Manager, *words: str, rtee: Sequence[str] = RTEE
) -> Iterator[subprocess.Popen[str]]:
    """Run a command of rtee as a service whose watchdog waits 2 s."""
    environment = os.environ | {
        "RTEE_CONFIG_PATH": str(folder),
        "PYTHONPATH": os.pathsep.join([*sys.path, str(Path(__file__).parents[2])]),
        "PYTHONFAULTHANDLER": "1",
        "NOTIFY_SOCKET": manager.address,
        "WATCHDOG_USEC": "2000000",
    }
    process = subprocess.Popen(
        [*rtee, *words],
        env=environment,
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def test_a_stopped_process_feeds_nothing(folder: Path, notified: Manager) -> None:
    with started(folder, notified, "run", "jaw", "--no-log", rtee=ALONE) as process:
        notified.wait_for("READY=1")
        os.kill(process.pid, signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)
        notified.received()
        assert notified.receive(within=1.0) == []
        os.kill(process.pid, signal.SIGCONT)
        notified.wait_for("WATCHDOG=1")
        process.send_signal(signal.SIGINT)
        notified.wait_for("STOPPING=1")
        assert process.wait(timeout=30) == 0


def test_a_driver_that_blocks_the_loop_stops_the_feeding(folder: Path, notified: Manager) -> None:
    command = ("run", "jaw", "--no-log", "--driver", f"{__name__}:Blocking")
    with started(folder, notified, *command, rtee=ALONE) as process:
        notified.wait_for("READY=1")
        for blocked_for_good in (False, True):
            (folder / "block").touch()
            while not (folder / "blocked").exists():
                assert process.poll() is None
                time.sleep(0.01)
            notified.received()
            assert notified.receive(within=1.0) == [], "the process runs, the loop does not"
            if not blocked_for_good:
                (folder / "block").unlink()
                (folder / "blocked").unlink()
                notified.wait_for("WATCHDOG=1")
        process.send_signal(signal.SIGABRT)  # as the unit's watchdog does
        _, errors = process.communicate(timeout=30)
    assert process.returncode == -signal.SIGABRT
    assert "in wait_while_blocked" in errors, "the journal says where it hung"


def executed(folder: Path, *command: str) -> str:
    """Return why a command to the running hand failed; empty if it did not."""
    done = subprocess.run([*RTEE, *command], cwd=folder, capture_output=True, text=True)
    return f"{done.stdout}{done.stderr}" if done.returncode else ""


def test_the_next_start_takes_over_without_a_jump(
    folder: Path, notified: Manager, repository: Path
) -> None:
    file = patient_gripper(folder, repository)
    file.write_text(file.read_text().replace("/dev/ttyUSB0", str(folder / "port")))
    run = ("run", "robotiq_2f_85", "--driver", "devices")
    with started(folder, notified, "emulate", "robotiq_2f", "--link", "port") as emulator:
        assert emulator.stdout is not None
        assert "port" in emulator.stdout.readline()
        with started(folder, notified, *run, "--home", rtee=ALONE) as process:
            notified.wait_for("STATUS=robotiq_2f_85: gripper active")
            assert not executed(folder, "do", "PinchTight", "--intensity=0.5")
            os.kill(process.pid, signal.SIGSTOP)
            process.send_signal(signal.SIGABRT)
            os.kill(process.pid, signal.SIGKILL)  # a stopped process takes no other signal
            assert process.wait(timeout=30) == -signal.SIGKILL
        with started(folder, notified, *run) as process:
            notified.wait_for("STATUS=robotiq_2f_85: gripper active")
            notified.wait_for("WATCHDOG=1")
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=30) == 0
    # The first part of each session; a lost link leaves a file of the flight recorder, too.
    [_, file] = sorted((folder / "logs").glob("*_000.mcap"))
    found = read(file)
    position, reference = found.actuator_states.position, found.reference.position
    # Where the action left it [rad], far from where the hand rests; a count is 0.003 rad.
    assert np.nanmin(position) > 0.3
    assert np.nanmax(position) - np.nanmin(position) < 0.01
    assert np.nanmax(np.abs(reference - np.nanmedian(position))) < 0.01
