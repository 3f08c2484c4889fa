"""Measuring openings with gauge blocks; every command is a process."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtee.actions.library import ActionLibrary
from rtee.hand.load import load_hand

RTEE = (sys.executable, "-m", "rtee")
HAND = "robotiq_2f_85"


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
        timeout=60,
        check=False,
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture
def place(repository: Path, tmp_path: Path) -> Iterator[Path]:
    """A folder with a gripper that runs on its emulator, which holds an object half way."""
    tmp_path.chmod(0o700)
    shutil.copytree(repository / "config" / HAND, tmp_path / "config" / HAND)
    run = subprocess.Popen(
        [*RTEE, "run", HAND, "--emulated", "--object", "0.5", "--no-log"],
        env=environment(tmp_path),
        stdout=subprocess.PIPE,
        text=True,
    )
    assert run.stdout is not None
    assert run.stdout.readline().startswith(f"{HAND}: ")
    yield tmp_path
    run.send_signal(signal.SIGINT)
    run.communicate()


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
    assert "actions go with --opening" in calibrate(place, "PinchTight", typed="", status=2)
    assert "unknown action" in calibrate(place, "--opening", "Nope", typed="", status=2)
