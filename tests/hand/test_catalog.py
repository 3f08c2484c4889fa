from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from rtee_process import RTEE

from rtee.cli._common import hand_folder
from rtee.errors import ConfigError
from rtee.hand.catalog import config_dirs, find_hand, hand_names, own_dirs
from rtee.hand.load import load_hand
from rtee.remote.directory import runtime_folder
from rtee.running.prepare import RunOptions, prepare


def test_folders_in_order(
    configured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        (folder / "gripper").mkdir(parents=True)
        (folder / "gripper" / "hand.yaml").touch()
    (second / "claw").mkdir()
    (second / "claw" / "hand.yaml").touch()
    monkeypatch.setenv("RTEE_CONFIG_PATH", f"{first}:{second}")
    monkeypatch.chdir(tmp_path)
    assert config_dirs()[:3] == [first, second, Path("config")]
    assert find_hand("gripper") == first / "gripper"
    assert find_hand("gripper", [second]) == second / "gripper"
    assert find_hand("claw") == second / "claw"
    assert {"claw", "gripper"} <= set(hand_names())


def test_a_home_is_expanded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("RTEE_CONFIG_PATH", "~/hands:/opt/hands")
    assert own_dirs()[:2] == [tmp_path / "hands", Path("/opt/hands")]
    monkeypatch.setenv("RTEE_RUNTIME_DIR", "~/run")
    assert runtime_folder() == tmp_path / "run"
    ready = prepare("robotiq_2f_85", RunOptions(log=Path("~/logs")))
    assert ready.recorder_settings(RunOptions(log=Path("~/logs"))).directory == tmp_path / "logs"


def test_a_hand_where_one_works_comes_last(
    configured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(configured)
    assert find_hand("gripper") == Path("gripper")
    assert load_hand("gripper").name == hand_folder("gripper").name
    assert "gripper" in hand_names()
    shutil.copytree("gripper", tmp_path / "first" / "gripper")
    monkeypatch.setenv("RTEE_CONFIG_PATH", str(tmp_path / "first"))
    assert find_hand("gripper") == tmp_path / "first" / "gripper"
    assert hand_folder("./gripper") == Path("gripper")
    monkeypatch.chdir("gripper")
    assert hand_folder(".") == Path()


@pytest.mark.parametrize("name", ["gripper/", "./gripper", "gripper.yaml", ".", ".."])
def test_a_path_without_a_hand(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"is not a hand.s folder: it has no hand\.yaml"):
        hand_folder(name)


@pytest.mark.parametrize("name", ["a" * 300 + "/", "a/" * 3000, "\0/"])
def test_a_path_that_no_file_system_takes(name: str) -> None:
    with pytest.raises(ConfigError, match=r"is not a hand.s folder"):
        hand_folder(name)


def test_folders_that_may_not_be_entered_hold_no_hand(
    configured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    monkeypatch.setenv("RTEE_CONFIG_PATH", f"{hidden}:{configured}")
    real = os.stat

    def refusing(path: object, *args: object, **kwargs: object) -> os.stat_result:
        # The system's own refusal is not for root, who may run the tests.
        if isinstance(path, str | Path) and Path(path).is_relative_to(hidden / "gripper"):
            raise PermissionError(13, "Permission denied", str(path))
        return real(path, *args, **kwargs)  # type: ignore[call-overload, no-any-return]

    monkeypatch.setattr(os, "stat", refusing)
    assert find_hand("gripper") == configured / "gripper"


def test_unknown_hand(configured: Path) -> None:
    with pytest.raises(ConfigError, match=r"unknown hand 'griper'; did you mean 'gripper'\?"):
        find_hand("griper", [configured])
    with pytest.raises(ConfigError, match=r"hand name '\.\./gripper'"):
        find_hand("../gripper", [configured])


def test_a_folder_in_the_place_of_the_file(configured: Path) -> None:
    (configured / "other" / "hand.yaml").mkdir(parents=True)
    with pytest.raises(ConfigError, match=r"other/hand\.yaml: is not a file"):
        find_hand("other", [configured])


def rtee(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*RTEE, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, **environment, "COLUMNS": "200"},
    )


def test_command_hands(configured: Path) -> None:
    (configured / "broken").mkdir()
    (configured / "broken" / "hand.yaml").write_text("name: broken\nurdf: none.urdf\n")
    done = rtee("hands", "--json", RTEE_CONFIG_PATH=str(configured))
    assert done.returncode == 0, done.stderr
    found = {row["name"]: row for row in json.loads(done.stdout)["hands"]}
    assert found["gripper"]["fingers"] == ["left_finger", "right_finger"]
    assert found["gripper"]["devices"] == {"both": "kinematic"}
    assert "hand.yaml:2: urdf: the file 'none.urdf' does not exist" in found["broken"]["error"]
    done = rtee("hands", RTEE_CONFIG_PATH=str(configured))
    assert done.returncode == 0, done.stderr
    assert "A gripper" in done.stdout
