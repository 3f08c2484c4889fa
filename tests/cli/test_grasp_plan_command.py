"""`rtee grasp-plan`: what it prints, what it stores, and what it refuses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Composed
from rtee.cli.main import main
from rtee.errors import install_line
from rtee.hand.load import load_hand
from rtee.hand.own_copy import copy_hand
from rtee.planning.result import from_document

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def folder(tmp_path: Path, repository: Path) -> Path:
    """A gripper of one's own."""
    copy_hand(repository / "config/robotiq_2f_85", tmp_path / "mine")
    return tmp_path / "mine"


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path) -> Run:
    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["rtee", "grasp-plan", str(folder), *words])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        return int(ended.value.code or 0), said.out, said.err

    return run


def test_it_says_which_action_and_why(run: Run) -> None:
    status, out, _ = run("--object", "cylinder:0.02x0.1", "--top", "2")
    assert status == 0
    assert "Grasp" in out
    assert "to do it: rtee do " in out
    assert "width 40 mm" in out
    assert "contacts: finger_1 " in out
    assert "the object in the hand's base frame: x 0 mm" in out


def test_what_no_grasp_can_carry_fails_and_is_not_stored(run: Run, folder: Path) -> None:
    status, out, _ = run("--object", "box:0.03x0.05x0.1", "--mass", "90", "--save", "Block")
    assert status == 1
    assert "can't carry the weight" in out
    assert "weighs 90 kg, too much for its best grasp" in out
    assert "to do it" not in out
    library = ActionLibrary.load(load_hand(folder), folder / "actions")
    assert "Block" not in {action.name for action in library}


def test_each_of_several_objects_has_an_answer(run: Run) -> None:
    status, out, _ = run("--object", "sphere:0.02", "--object", "sphere:0.06", "--json")
    first, second = json.loads(out)
    assert status == 1
    assert from_document(first).plans
    assert second["object"] == "sphere:0.06"
    assert "does not fit: width 120 mm" in second["error"]
    status, out, _ = run("--object", "sphere:0.06", "--json")
    assert (status, json.loads(out)) == (2, second)


def test_json_is_the_whole_ranking(run: Run) -> None:
    status, out, _ = run("--object", "cylinder:0.02x0.1", "--mass", "0.4", "--json", "--top", "1")
    ranking = from_document(json.loads(out))
    assert status == 0
    assert (ranking.hand, ranking.object, ranking.mass) == ("mine", "cylinder:0.02x0.1", 0.4)
    assert len(ranking.plans) == 1
    plan = ranking.plans[0]
    turn = np.array(plan.pose)[:3, :3]
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-5)
    assert {"finger_1", "finger_2"} <= set(plan.fingers)
    assert 0.0 <= plan.preshape < plan.touch < plan.intensity <= 1.0


def test_the_first_choice_is_stored(run: Run, folder: Path) -> None:
    status, out, _ = run("--object", "box:0.03x0.05x0.1", "--save", "Block")
    assert status == 0
    assert "'Block' is now an action of mine" in out
    library = ActionLibrary.load(load_hand(folder), folder / "actions")
    action = library.find("Block")
    assert isinstance(action, Composed)
    assert len(action.parts) == 1
    assert 0.0 < action.parts[0].scale <= 1.0
    assert "box:0.03x0.05x0.1" in action.description


def test_a_name_that_is_taken_is_refused_unless_it_is_to_be_replaced(run: Run) -> None:
    words = ("--object", "box:0.03x0.05x0.1", "--save", "Grasp")
    status, _, err = run(*words)
    assert status == 2
    assert "there already is an action 'Grasp'" in err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--object", "box:0.14x0.2x0.3"], "does not fit: width 140 mm, the hand opens to 8"),
        (["--object", "cone:1x1"], "'cone:1x1' is not an object"),
        (["--object", ""], "--object is empty"),
        (["--object", "sphere:0.02", "--table", "0,0,1,0.03"], "it would be below the table"),
        (["--object", "sphere:-0.1"], "is not an object"),
        (["--object", "sphere:nan"], "is not an object"),
        (["--object", "nothing.stl"], "nothing.stl: no such mesh"),
        (["--object", "sphere:0.02", "--mass", "nan"], "should be a finite number"),
        (["--object", "sphere:0.02", "--mass", "-1"], "the mass of an object"),
        (["--object", "sphere:0.02", "--friction", "0"], "a friction must be above 0"),
        (["--object", "sphere:0.02", "--scale", "0"], "the scale of a mesh must be above 0"),
        (
            ["--object", "sphere:0.02", "--weight-axis", "0,0,0"],
            "the weight axis must be three numbers",
        ),
        (
            ["--object", "sphere:0.02", "--weight-axis", "down"],
            "the weight axis must be three numbers",
        ),
        (["--object", "sphere:0.02", "--save", "../x"], "../x"),
        (["--object", "sphere:0.02", "--save", "Trig"], "is that of a primitive"),
        (["--object", "sphere:0.02", "--top", "0"], "top"),
        ([], "--object"),
    ],
)
def test_what_is_wrong_is_one_sentence(run: Run, words: list[str], said: str) -> None:
    status, out, err = run(*words)
    assert status == 2
    assert said in err
    assert out == ""
    assert err.startswith("rtee: ")
    assert err.count("\n") == 1


def test_it_names_the_extra_that_is_missing(folder: Path, tmp_path: Path) -> None:
    # A module that raises this error stands for a package that is not installed.
    (tmp_path / "hidden").mkdir()
    hidden = "raise ModuleNotFoundError('no coal', name='coal')\n"
    (tmp_path / "hidden/coal.py").write_text(hidden)
    paths = [str(tmp_path / "hidden"), os.environ.get("PYTHONPATH", str(Path.cwd()))]
    ended = subprocess.run(
        [sys.executable, "-m", "rtee", "grasp-plan", str(folder), "--object", "sphere:0.02"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2
    assert ended.stderr == (
        f"rtee: planning a grasp needs the extra 'extract': {install_line('extract')}\n"
    )
