"""The commands about devices, as typed."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from rtee_process import RTEE

from rtee.remote.directory import VARIABLE
from rtee.testing.running import running_hand


def rtee(*words: str, status: int = 0, typed: str = "") -> str:
    run = subprocess.run([*RTEE, *words], capture_output=True, text=True, input=typed, check=False)
    assert run.returncode == status, run.stdout + run.stderr
    assert "Traceback" not in run.stderr
    return run.stdout + run.stderr


def test_the_doctor_looks_at_an_emulated_hand() -> None:
    found = json.loads(rtee("doctor", "robotiq_2f_85", "--emulated", "--json"))
    assert "wrong" not in {check["verdict"] for check in found["gripper"]}
    assert found["gripper"][0] == {
        "subject": "answer",
        "verdict": "ok",
        "text": "it answers",
        "remedy": "",
    }
    assert found["computer"][0]["subject"] == "Python"


def test_the_doctor_fails_where_something_is_wrong() -> None:
    text = rtee("doctor", "robotiq_2f_85", status=1)
    assert "wrong    port: there is no /dev/ttyUSB0" in text
    assert "-> plug it in" in text


def test_the_doctor_asks_a_hand_that_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, repository: Path
) -> None:
    """It advised to kill the hand, whose port is in use: by the hand."""
    monkeypatch.chdir(repository)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "run"))
    with running_hand("robotiq_2f_85", folder=tmp_path) as hand:
        text = rtee("doctor", "robotiq_2f_85")
        assert "ok       device: robotiq_2f, active, says the running hand" in text
        hand.unplug()
        while hand.status().devices[0].lifecycle == "active":
            time.sleep(0.01)
        text = rtee("doctor", "robotiq_2f_85", status=1)
        assert "wrong    device: robotiq_2f" in text
        assert "kill" not in text


def test_a_hand_is_located_and_calibrated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = rtee("locate", "robotiq_2f_85", "--emulated", "--yes", "--times", "1")
    assert "gripper: that was 2F-85" in text
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "stops.json"
    text = rtee(
        "calibrate", "robotiq_2f_85", "--emulated", "--ideal", "--out", file.name, typed="\n"
    )
    assert "open at 3, closed at 230" in text
    # hand.yaml is also read from other folders than this one.
    assert f"options: calibration: {file}\n" in text
    assert json.loads(file.read_text())["model"] == "2f_85"


def test_a_port_that_the_running_hand_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It sent people to the doctor, which only asked the running hand."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "run"))
    rtee("new", "mine", "--from", "robotiq_2f_85")
    port, file = tmp_path / "port", tmp_path / "config" / "mine" / "hand.yaml"
    text = file.read_text().replace("/dev/ttyUSB0", str(port))
    file.write_text(text.replace("name: robotiq_2f_85", "name: mine"))
    devices = ("run", "mine", "--driver", "devices", "--no-log")
    with ExitStack() as stack:
        for words in (("emulate", "robotiq_2f", "--link", str(port)), devices):
            ran = subprocess.Popen(
                [*RTEE, *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
            )
            stack.enter_context(ran)
            stack.callback(ran.send_signal, signal.SIGTERM)
            assert ran.stdout is not None
            assert "robotiq_2f" in ran.stdout.readline() or words is devices
        for command in ("locate", "calibrate"):
            text = rtee(command, "mine", "--yes", status=1)
            assert f"'{port}': the running hand 'mine' has it open; end it first" in text


def test_a_device_that_is_none_is_named() -> None:
    # Its own option, and not `rtee recover`, which needs a running hand.
    text = rtee("locate", "schunk_svh", "--emulated", "--yes", status=1)
    assert "not homed" in text
    assert "rtee locate schunk_svh --home" in text
    text = rtee("locate", "robotiq_2f_85", "--device", "griper", "--yes", status=2)
    assert "has no device 'griper'; did you mean 'gripper'?" in text


def test_scan_finds_what_emulate_plays(tmp_path: Path) -> None:
    link = tmp_path / "port"
    player = subprocess.Popen(
        [*RTEE, "emulate", "robotiq_2f", "--link", str(link), "--set", "unit=12"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert player.stdout is not None
        assert player.stdout.readline() == f"robotiq_2f at {link}\n"
        words = ("--port", str(link), "--unit", "12", "--wait", "0.3")
        found = json.loads(rtee("scan", *words, "--json"))
        [address] = found["addresses"]
        assert address["found"][0]["driver"] == "robotiq_2f"
        assert address["found"][0]["options"]["unit"] == 12
    finally:
        player.send_signal(signal.SIGTERM)
        assert player.wait(10) == 0
        player.stdout.close()
    assert not link.is_symlink()


def test_a_driver_package_is_written(tmp_path: Path) -> None:
    text = rtee("new-driver", "my_gripper", "--in", str(tmp_path))
    assert str(tmp_path / "my_gripper" / "my_gripper" / "driver.py") in text
    assert "is not empty" in rtee("new-driver", "my_gripper", "--in", str(tmp_path), status=2)
    assert "is taken" in rtee("new-driver", "json", "--in", str(tmp_path), status=2)
    assert "no digit first" in rtee("new-driver", "2grip", "--in", str(tmp_path), status=2)


@pytest.mark.parametrize(
    "words",
    [
        ["emulate", "robotik"],
        ["emulate", "robotiq_2f", "--set", "x"],
        ["emulate", "dynamixel", "--set", "ids=[300]"],
        ["emulate", "robotiq_2f", "--link", "/dev/null/port"],
    ],
)
def test_mistakes_are_one_sentence(words: list[str]) -> None:
    assert rtee(*words, status=2).count("\n") == 1
