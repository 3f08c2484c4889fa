"""Measuring openings with gauge blocks; every command is a process."""

from __future__ import annotations

import math
import os
import pty
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from patient import HAND, patient_gripper
from rtee_process import RTEE

from rtee.actions.library import ActionLibrary
from rtee.cli.devices import _Blocks
from rtee.hand.load import load_hand
from rtee.remote.goal_values import shares
from rtee.types import Result

REAL = (sys.executable, "-m", "rtee")


def environment(place: Path) -> dict[str, str]:
    config = {"RTEE_CONFIG_PATH": str(place / "config"), "PYTHONUNBUFFERED": "1"}
    return {**os.environ, "XDG_RUNTIME_DIR": str(place), **config}


def calibrate(place: Path, *words: str, typed: str, status: int = 0) -> str:
    done = subprocess.run(
        [*RTEE, "calibrate", HAND, *words],
        env=environment(place),
        input=typed,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture
def place(repository: Path, tmp_path: Path) -> Iterator[Path]:
    """A folder with a gripper that runs on its emulator, which holds an object half way."""
    tmp_path.chmod(0o700)
    patient_gripper(tmp_path / "config", repository)
    run = subprocess.Popen(
        [*RTEE, "run", HAND, "--emulated", "--ideal", "--object", "0.5", "--no-log"],
        env=environment(tmp_path),
        stdout=subprocess.PIPE,
        text=True,
    )
    assert run.stdout is not None
    assert run.stdout.readline().startswith(f"{HAND}: ")
    yield tmp_path
    run.send_signal(signal.SIGINT)
    run.communicate()


@pytest.mark.heavy
def test_blocks_are_measured_and_kept_one_by_one(place: Path) -> None:
    file = place / "config" / HAND / "hand.yaml"
    comments = [line for line in file.read_text().splitlines() if line.lstrip().startswith("#")]
    said = calibrate(place, "--opening", "PinchTight:finger_1,finger_2", typed="9m\n44mm\n\n")
    assert "not 9000 mm" in said
    assert "44 mm at 0." in said
    hand = load_hand(file.parent)
    library = ActionLibrary.load(hand, file.parent / "actions")
    pinch = library.find("PinchTight")
    [(intensity, width)] = library.openings.measured(pinch)
    assert width == 0.044
    assert 0.4 < intensity < 0.6
    assert library.openings.of(pinch).at(intensity) == pytest.approx(0.044, abs=1e-5)
    assert all(line in file.read_text() for line in comments)
    # A second time goes on: what was taken is shown, and the same block replaces its pair.
    said = calibrate(place, "--opening", "PinchTight:finger_2,finger_1", typed="44mm\n\n43mm\n\n")
    assert "measured before: 44 mm" in said
    pairs = load_hand(file.parent).openings
    widths = [sorted(round(1e3 * width) for _, width in each) for each in pairs.values()]
    assert widths == [[43, 44]]


def test_what_cannot_be_calibrated_is_refused(place: Path) -> None:
    assert "ACTION needs --opening" in calibrate(place, "PinchTight", typed="", status=2)
    assert "unknown action" in calibrate(place, "--opening", "Nope", typed="", status=2)


@pytest.mark.anyio
async def test_motors_without_an_effort_limit_close_with_their_own(repository: Path) -> None:
    """A hand whose URDF has no efforts could not be calibrated at all."""
    folder, asked = repository / "config" / HAND, list[object]()

    class Remote:
        async def effort_limits(self, share: float, only: list[str]) -> dict[str, float]:
            asked.append(only)
            return shares({}, share, only)

        async def do(self, *_: str, **options: object) -> Result:
            asked.append(options["effort"])
            return Result("", "", stalled=True)

    library = ActionLibrary.load(load_hand(folder), folder / "actions")
    pinch = library.find("PinchTight")
    hand = load_hand(folder)
    library.hand = replace(
        hand, actuators=tuple(replace(each, effort=math.inf) for each in hand.actuators)
    )
    blocks = _Blocks(cast("Any", Remote()), library, folder, pinch, library.openings.of(pinch))
    assert await blocks._go(1.0)
    assert asked == [[], {}]


def test_a_hand_without_actions_has_nothing_to_measure(repository: Path, tmp_path: Path) -> None:
    tmp_path.chmod(0o700)
    folder = tmp_path / "config" / HAND
    shutil.copytree(repository / "config" / HAND, folder)
    shutil.rmtree(folder / "actions")
    said = calibrate(tmp_path, "--opening", typed="", status=2)
    assert said.count("\n") == 1
    assert f"'rtee extract {HAND} --save' finds them" in said


class Terminal:
    """`rtee calibrate` as somebody sees it: on a terminal of its own, where Ctrl-C is a key."""

    def __init__(self, place: Path, *words: str) -> None:
        command = [*RTEE, "calibrate", HAND, "--opening", *words]
        self.said, self.seen = "", 0
        self.pid, self.ours = pty.fork()
        if not self.pid:
            os.execvpe(command[0], command, environment(place))

    def until(self, text: str) -> None:
        """Read until a text has been said."""
        while (found := self.said.find(text, self.seen)) < 0:
            try:
                self.said += os.read(self.ours, 4096).decode(errors="replace")
            except OSError:
                raise AssertionError(f"it ended without saying '{text}': {self.said}") from None
        self.seen = found + len(text)

    def type(self, text: str) -> None:
        os.write(self.ours, text.encode())

    def end(self) -> int:
        """Read to the end; return the exit status."""
        while True:
            try:
                read = os.read(self.ours, 4096)
            except OSError:
                break
            if not read:
                break
            self.said += read.decode(errors="replace")
        os.close(self.ours)
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


RUN = ("run", HAND, "--no-log", "--rate", "200", "--option", "objects={finger_joint: 0.5}")
"""A stand-in of the gripper with something half way: no wire that a busy computer could starve."""


@pytest.fixture
def standing_in(repository: Path, tmp_path: Path) -> Iterator[Path]:
    """A folder with a gripper whose stand-in runs."""
    tmp_path.chmod(0o700)
    shutil.copytree(repository / "config" / HAND, tmp_path / "config" / HAND)
    # The 31 ms that follow from its wire may pass on a busy computer before a thread runs.
    file = tmp_path / "config" / HAND / "hand.yaml"
    text = file.read_text()
    assert text.count("    driver: robotiq_2f\n") == 1
    file.write_text(
        text.replace("    driver: robotiq_2f\n", "    driver: robotiq_2f\n    deadline: 60.0\n")
    )
    run = subprocess.Popen(
        [*RTEE, *RUN], env=environment(tmp_path), stdout=subprocess.PIPE, text=True
    )
    assert run.stdout is not None
    assert run.stdout.readline().startswith(f"{HAND}: ")
    yield tmp_path
    run.send_signal(signal.SIGINT)
    run.communicate()


PINCH = "PinchTight:finger_1,finger_2"
WIDTH, BLOCK = "width of the next block", "press Enter"


def test_ctrl_c_at_a_question_writes_nothing(standing_in: Path) -> None:
    place = standing_in
    folder = place / "config" / HAND
    before = (folder / "hand.yaml").read_text()
    for typed in ("", "44mm\n"):  # at the question for a width, and with a block in the hand
        terminal = Terminal(place, PINCH)
        terminal.until(WIDTH)
        if typed:
            terminal.type(typed)
            terminal.until(BLOCK)
        terminal.type("\x03")
        assert terminal.end() == 130, terminal.said
        assert "Traceback" not in terminal.said
        assert (folder / "hand.yaml").read_text() == before


def test_ctrl_c_keeps_what_was_taken_and_the_next_time_goes_on(standing_in: Path) -> None:
    place = standing_in
    folder = place / "config" / HAND
    before = (folder / "hand.yaml").read_text()
    terminal = Terminal(place, PINCH)
    terminal.until(WIDTH)
    terminal.type("44mm\n")
    terminal.until(BLOCK)
    terminal.type("\n")
    terminal.until("stored in")
    terminal.until(WIDTH)
    terminal.type("43mm\n")
    terminal.until(BLOCK)
    terminal.type("\n\x03")  # while it closes on the second block
    assert terminal.end() == 130, terminal.said
    assert "Traceback" not in terminal.said
    [pairs] = load_hand(folder).openings.values()
    assert [round(1e3 * width) for _, width in pairs] in ([44], [43, 44])
    assert not [path for path in folder.rglob("*") if path.suffix in (".tmp", ".part")]
    comments = [line for line in before.splitlines() if "#" in line]
    assert all(line in (folder / "hand.yaml").read_text() for line in comments)
    again = Terminal(place, PINCH)
    again.until("measured before: 44 mm")
    again.until(WIDTH)
    again.type("\n")
    assert again.end() == 0, again.said


@pytest.mark.heavy
def test_a_hand_that_came_with_rtee_is_copied_first(repository: Path, tmp_path: Path) -> None:
    site, work = tmp_path / "site", tmp_path / "work"
    shutil.copytree(repository / "rtee", site / "rtee")
    shutil.copytree(repository / "config" / HAND, site / "rtee" / "_config" / HAND)
    work.mkdir()
    tmp_path.chmod(0o700)
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("RTEE", "XDG"))}
    installed = {
        **kept,
        "PYTHONPATH": str(site),
        "PYTHONUNBUFFERED": "1",
        "HOME": str(work),
        "XDG_RUNTIME_DIR": str(tmp_path),
    }
    shipped = site / "rtee" / "_config" / HAND / "hand.yaml"
    before = shipped.read_bytes()
    run = subprocess.Popen(
        [*REAL, *RUN], cwd=work, env=installed, stdout=subprocess.PIPE, text=True
    )
    try:
        assert run.stdout is not None
        assert run.stdout.readline().startswith(f"{HAND}: ")
        done = subprocess.run(
            [*REAL, "calibrate", HAND, "--opening", PINCH],
            cwd=work,
            env=installed,
            input="44mm\n\n\n",
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
    finally:
        run.send_signal(signal.SIGINT)
        run.communicate()
    mine = work / "config" / HAND
    assert f"it is copied to config/{HAND}" in done.stdout + done.stderr
    assert shipped.read_bytes() == before
    [pairs] = load_hand(mine).openings.values()
    assert [round(1e3 * width) for _, width in pairs] == [44]
    comments = [line for line in before.decode().splitlines() if "#" in line]
    assert all(line in (mine / "hand.yaml").read_text() for line in comments)
