"""A gripper whose zero is closed, from `rtee new` to a grip; every command is a process."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hand.models import FRANKA
from rtee_process import RTEE

PINCH = "PinchTight:leftfinger,rightfinger*0.5"
LINE = "rest: {panda_finger_joint1: 0.04}"


def rtee(folder: Path, *arguments: str, status: int = 0) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
    environment.pop("RTEE_CONFIG_PATH", None)
    done = subprocess.run(
        [*RTEE, *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the gripper, its primitives extracted."""
    folder = tmp_path_factory.mktemp("gripper")
    folder.chmod(0o700)
    (folder / "franka.urdf").write_text(FRANKA)
    assert LINE in rtee(folder, "new", "franka", "--urdf", "franka.urdf").stdout
    done = rtee(folder, "extract", "franka", "--save")
    assert "pinch:" not in done.stdout + done.stderr
    return folder


@pytest.fixture
def closed(made: Path, tmp_path: Path) -> Path:
    """A folder with the same gripper, which rests closed, its primitives extracted so."""
    tmp_path.chmod(0o700)
    folder = tmp_path / "config" / "franka"
    folder.mkdir(parents=True)
    for name in ("franka.urdf", "franka.srdf", "hand.yaml"):
        text = (made / "config" / "franka" / name).read_text()
        (folder / name).write_text(text.replace(f"{LINE}\n", ""))
    done = rtee(tmp_path, "extract", "franka", "--save")
    assert "the rest posture is a pinch" in done.stderr
    assert f"type into hand.yaml: {LINE}" in done.stderr
    return tmp_path


@pytest.fixture
def running(made: Path) -> Iterator[Path]:
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(made), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [*RTEE, "run", "franka", "--no-log", "--rate", "200"],
        cwd=made,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline().startswith("franka: 1 actuator")
    yield made
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate()
    assert "pinch" not in errors


def width(folder: Path) -> float:
    state = json.loads(rtee(folder, "state", "--once", "--json").stdout)
    return float(state["actuators"]["panda_finger_joint1"]["position"])


def test_extraction_stores_openings_and_a_newer_action_lacks_one(
    made: Path, tmp_path: Path
) -> None:
    shutil.copytree(made / "config", tmp_path / "config")
    tmp_path.chmod(0o700)
    before = openings(tmp_path)
    assert before["PinchTight"] == pytest.approx(0.08, abs=1e-3)
    done = rtee(tmp_path, "compose", "half", PINCH, "--hand", "franka")
    assert "half has no opening" in done.stderr
    assert "`rtee openings franka --save` makes the tables" in done.stderr
    rtee(tmp_path, "openings", "franka", "--save")
    assert openings(tmp_path) == {**before, "half": pytest.approx(0.08, abs=1e-3)}


def openings(folder: Path) -> dict[str, float]:
    """Return the widest opening of each action [m]."""
    told = json.loads(rtee(folder, "openings", "franka", "--json").stdout)["openings"]
    return {each["action"]: each["widest"] for each in told}


def test_pinching_closes_and_opening_opens(running: Path) -> None:
    assert "reached" in rtee(running, "do", "PinchTight").stdout
    assert width(running) == pytest.approx(0.0, abs=2e-3)
    assert "reached" in rtee(running, "open").stdout
    assert width(running) == pytest.approx(0.04, abs=2e-3)


@pytest.mark.parametrize("shape", ["sphere:0.02", "box:0.04x0.04x0.1", "cylinder:0.01x0.12"])
def test_it_holds_things(made: Path, shape: str) -> None:
    pytest.importorskip("mujoco")
    assert "held" in rtee(made, "try", "franka", "PinchTight", "--object", shape).stdout


def test_run_warns_of_a_rest_that_is_a_pinch(closed: Path) -> None:
    done = rtee(closed, "run", "franka", "--no-log", "--duration", "0.1")
    assert "franka: the rest posture is a pinch" in done.stderr
    assert LINE in done.stderr


def test_the_doctor_warns_of_a_rest_that_is_a_pinch(closed: Path, made: Path) -> None:
    found = json.loads(rtee(closed, "doctor", "franka", "--json").stdout)["the hand"]
    assert found[0]["subject"] == "rest"
    assert found[0]["verdict"] == "warning"
    assert LINE in found[0]["remedy"]
    found = json.loads(rtee(made, "doctor", "franka", "--json").stdout)["the hand"]
    assert [check["verdict"] for check in found] == ["ok", "warning"]
    assert found[1]["subject"] == "devices"


def test_neither_the_doctor_nor_run_needs_geometry(closed: Path) -> None:
    """As on a robot's computer without Pinocchio and Coal."""
    hide = "import sys; sys.modules['coal'] = sys.modules['pinocchio'] = None\n"
    code = hide + "from rtee.drivers.diagnosis.model import check_model\n"
    code += "print(check_model('config/franka')[0])\n"
    code += "sys.argv = 'rtee run franka --no-log --duration 0.1'.split()\n"
    code += "from rtee.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=closed,
        env={**os.environ, "XDG_RUNTIME_DIR": str(closed)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert LINE in done.stdout.splitlines()[0]
    assert LINE in done.stderr
