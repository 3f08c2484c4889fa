"""A bad value in a variable of the environment is one sentence in every command that reads it."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from rtee_process import RTEE

BAD = {
    "ROS_DOMAIN_ID": ("300", "ROS_DOMAIN_ID=300 is not a domain"),
    "ZENOH_CONFIG_OVERRIDE": ("a/b=c", "ZENOH_CONFIG_OVERRIDE: a/b=c is not a setting of Zenoh"),
    "ZENOH_SESSION_CONFIG_URI": ("/nowhere", "ZENOH_SESSION_CONFIG_URI: No such file"),
    "ZENOH_ROUTER_CHECK_ATTEMPTS": ("x", "ZENOH_ROUTER_CHECK_ATTEMPTS=x should be"),
    "ZENOH_RUNTIME": ("foo", "ZENOH_RUNTIME=foo does not describe Zenoh's threads"),
}
SERVE = "ros2 serve wsg50"
CASES = [*((name, SERVE) for name in BAD), ("ROS_DOMAIN_ID", "ros2 list")]
CASES += [("ZENOH_CONFIG_OVERRIDE", "run wsg50 --ros2 --duration 0.1 --no-log")]


@pytest.mark.samples("ROS_DOMAIN_ID-ros2 list", "ZENOH_CONFIG_OVERRIDE-run*")
@pytest.mark.parametrize(("name", "command"), CASES)
def test_it_is_one_sentence(tmp_path: Path, repository: Path, name: str, command: str) -> None:
    tmp_path.chmod(0o700)
    value, sentence = BAD[name]
    done = subprocess.run(
        [*RTEE, *command.split()],
        cwd=repository,
        env={**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), name: value},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 2, done.stderr
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith("rtee: ")
