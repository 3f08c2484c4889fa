"""A hand whose wrist is ignored, from `rtee new` to a recording that is replayed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest
from hand.models import anthropomorphic
from rtee_process import RTEE

WRIST = ("rh_WRJ2", "rh_WRJ1")


def test_its_joints_are_told_but_not_commanded(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    tmp_path.chmod(0o700)
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONUNBUFFERED": "1"}

    def rtee(*arguments: str, status: int = 0) -> str:
        done = subprocess.run(
            [*RTEE, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout + done.stderr

    (tmp_path / "h.urdf").write_text(anthropomorphic())
    assert "ignore: [rh_WRJ2, rh_WRJ1]" in rtee("new", "shadow", "--urdf", "h.urdf")
    config = tmp_path / "config" / "shadow" / "hand.yaml"
    config.write_text(config.read_text() + "rest: {rh_WRJ1: 0.2}\n")
    run = subprocess.Popen(
        [*RTEE, "run", "shadow", "--rate", "200"],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    request.addfinalizer(run.kill)
    assert run.stdout is not None
    assert run.stdout.readline().startswith("shadow: 22 actuators, 24 joints")
    rtee("generic", "point", "rh_MFJ3=1.2", "--hand", "shadow")
    rtee("do", "point")
    refusal = rtee("generic", "bow", "rh_WRJ1=0.4", "--hand", "shadow", status=2)
    assert "unknown actuator 'rh_WRJ1'" in refusal
    state = json.loads(rtee("state", "--once", "--json"))
    run.send_signal(signal.SIGINT)
    run.communicate()
    assert run.returncode == 0
    assert not set(WRIST) & set(state["actuators"])
    assert [state["joints"][name] for name in WRIST] == [0.0, 0.2]
    assert state["joints"]["rh_MFJ3"] == pytest.approx(1.2, abs=0.01)
    rtee("log", "replay", "--check", "logs")
