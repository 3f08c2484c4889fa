"""Options that would have no effect are refused, and so are empty words."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import pytest

from rtee.cli.main import main


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("doctor robotiq_2f_85 --ideal", "--ideal needs --emulated"),
        ("doctor --device gripper", "--device needs HAND"),
        ("doctor --first-contact", "--first-contact needs HAND"),
        ("doctor robotiq_2f_85 --out x", "--out needs --first-contact"),
        ("doctor robotiq_2f_85 --files pc", "--files and HAND exclude each other"),
        ("calibrate robotiq_2f_85 PinchTight", "ACTION needs --opening"),
        ("calibrate robotiq_2f_85 --opening -y", "--yes and --opening exclude each other"),
        ("run robotiq_2f_85 --ideal", "--ideal needs --emulated"),
        ("emulate robotiq_2f --raw", "--raw needs --tcp"),
        ("emulate robotiq_2f --tcp 0 --strict-rate", "--strict-rate and --tcp exclude each other"),
        ("scan --bitrate 500000", "--bitrate needs --can"),
        ("hands --connect tcp/robot:7447", "--connect needs --running or --watch"),
        ("new mine --from schunk_svh --ask", "--ask needs --urdf or --mjcf"),
        ("extract schunk_svh --outside rigid", "--outside needs --root"),
        ("retarget schunk_svh --landmarks x", "--landmarks needs --show"),
        ("teleop --keyboard --side left Grasp", "--side needs --landmarks"),
        ("log replay x --check --repeat", "--repeat and --check exclude each other"),
        ("log replay x --series", "--series needs --check"),
        ("grasp-plan schunk_svh --object drill --replace", "--replace needs --save"),
        ("try schunk_svh Grasp --reflexes", "--reflexes needs --task"),
        ("try schunk_svh Grasp --jobs 2", "--jobs needs --all"),
        ("try schunk_svh --all --mass 1", "--mass and --all exclude each other"),
        ("try schunk_svh Grasp --until 0.7", "--until needs --all or --variations"),
        (
            "try schunk_svh Grasp --task egg --variations 2 --until 0.7",
            "--until and --task exclude each other",
        ),
        ("doctor ''", "HAND is empty"),
        ("doctor --files ''", "--files is empty"),
        ("doctor --files=", "--files is empty"),
        ("do ''", "ACTION is empty"),
        ("new mine --from schunk_svh --into ''", "--into is empty"),
        ("ros2 messages ''", "DIR is empty"),
    ],
)
def test_what_has_no_effect_is_refused(
    words: str,
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["rtee", *shlex.split(words)])
    with pytest.raises(SystemExit) as left:
        main()
    out, err = capsys.readouterr()
    assert (left.value.code, out) == (2, "")
    assert err.startswith(f"rtee: {said}; see 'rtee ")
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_empty_address_keeps_no_stop_from_the_hands_of_this_computer(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["rtee", "stop", "nobody", "--connect", ""])
    with pytest.raises(SystemExit):
        main()
    assert "the hand 'nobody' is not running on this computer" in capsys.readouterr().err


def test_what_is_said_of_a_shared_option_stays_with_its_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for command, said in (("replay", "With --check: print one JSON object"), ("info", "Print one")):
        monkeypatch.setattr(sys, "argv", ["rtee", "log", command, "--help"])
        with pytest.raises(SystemExit):
            main()
        assert f"  {said}" in capsys.readouterr().out
