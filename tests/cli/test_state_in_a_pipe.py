"""`rtee state` where its output goes to no terminal; every command is a process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from rtee_process import RTEE

HAND = "robotiq_2f_85"


@pytest.fixture
def place(repository: Path, tmp_path: Path) -> Iterator[dict[str, str]]:
    """The environment of a gripper that runs."""
    tmp_path.chmod(0o700)
    config = {"RTEE_CONFIG_PATH": str(repository / "config"), "PYTHONUNBUFFERED": "1"}
    found = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), **config}
    run = subprocess.Popen(
        [*RTEE, "run", HAND, "--no-log"], env=found, stdout=subprocess.PIPE, text=True
    )
    assert run.stdout is not None
    assert run.stdout.readline().startswith(f"{HAND}: ")
    yield found
    run.send_signal(signal.SIGINT)
    run.communicate()


def test_a_pipe_gets_one_state_and_more_of_them_until_it_is_closed(place: dict[str, str]) -> None:
    # Without an end of its own, the time-out of the test would end it.
    done = subprocess.run(
        [*RTEE, "state", "--json"], env=place, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    [line] = done.stdout.splitlines()
    found = json.loads(line)
    assert (found["hand"], found["force"], found["force_source"]) == (HAND, None, "")
    done = subprocess.run([*RTEE, "state"], env=place, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("finger_joint ") == 1
    follow = subprocess.Popen(
        [*RTEE, "state", "--json", "--follow", "--rate", "50"],
        env=place,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert follow.stdout is not None
    assert follow.stderr is not None
    ticks = [json.loads(follow.stdout.readline())["tick"] for _ in range(3)]
    assert ticks == sorted(set(ticks))
    follow.stdout.close()  # as `| head -3` does
    assert follow.wait() == 0
    assert follow.stderr.read() == ""
    follow.stderr.close()


def test_once_and_follow_exclude_each_other(place: dict[str, str]) -> None:
    done = subprocess.run(
        [*RTEE, "state", "--once", "--follow"], env=place, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "exclude each other" in done.stderr
