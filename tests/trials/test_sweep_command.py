"""A sweep keeps what it has found, says so when it is interrupted, and leaves nothing running."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("mujoco")

from rtee.cli._common import app_of
from rtee.cli.try_ import try_
from rtee.errors import ConfigError
from rtee.hand.own_copy import copy_hand
from rtee.trials.store import read_results

GRIPPER = "robotiq_2f_85"


@pytest.fixture
def hand(tmp_path: Path, repository: Path) -> Path:
    """A gripper of one's own that was never tried."""
    copy_hand(repository / "config" / GRIPPER, tmp_path / "config/mine")
    return tmp_path / "config/mine"


def start(hand: Path) -> subprocess.Popen[str]:
    """Start a sweep of two processes in a process group of its own, as a terminal does."""
    return subprocess.Popen(
        [sys.executable, "-m", "rtee", "try", "mine", "--all", "--variations", "0", "--jobs", "2"],
        cwd=hand.parents[1],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def wait_for_a_result(hand: Path) -> None:
    while not read_results(hand / "trials.yaml"):
        time.sleep(0.05)


def group(leader: int) -> list[int]:
    """Return the processes of a group that still run."""
    found = []
    for place in Path("/proc").iterdir():
        if place.name.isdigit():
            try:
                words = (place / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(words[2]) == leader and words[0] != "Z":
                found.append(int(place.name))
    return found


def test_ctrl_c_says_what_is_kept(hand: Path) -> None:
    sweep = start(hand)
    wait_for_a_result(hand)
    os.killpg(sweep.pid, signal.SIGINT)
    _, said = sweep.communicate()
    kept = read_results(hand / "trials.yaml")
    assert sweep.returncode == 130
    assert said == (
        f"rtee: interrupted; the results of {len(kept)} of 36 trials are kept in "
        "config/mine/trials.yaml; the same command does the others\n"
    )
    while group(sweep.pid):
        time.sleep(0.05)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc")
def test_what_is_found_outlives_a_kill_and_the_workers_do_not(hand: Path) -> None:
    sweep = start(hand)
    wait_for_a_result(hand)  # it is in the file while the sweep goes on
    assert sweep.poll() is None
    assert len(group(sweep.pid)) > 2
    sweep.kill()
    sweep.communicate()
    while group(sweep.pid):
        time.sleep(0.05)
    assert 0 < len(read_results(hand / "trials.yaml")) < 36


def test_a_hand_without_actions_is_told_what_to_type(hand: Path) -> None:
    shutil.rmtree(hand / "actions")
    with pytest.raises(ConfigError, match=r"no actions to try.*: rtee extract .* --save") as caught:
        CliRunner().invoke(app_of(try_), [str(hand), "--all"], catch_exceptions=False)
    assert caught.value.exit_status == 2
    assert not (hand / "trials.yaml").exists()
