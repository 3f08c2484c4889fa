"""What programs import as `rtee`: its names, and what needs no running hand."""

from __future__ import annotations

import ast
import asyncio
import subprocess
import sys
from pathlib import Path

import pytest

import rtee
from rtee.errors import ActionError
from rtee.hand.load import load_model

GRIPPER = "robotiq_2f_85"


def test_checkers_and_programs_find_the_same_names() -> None:
    tree = ast.parse(Path(str(rtee.__file__)).read_text())
    block = next(line for line in tree.body if isinstance(line, ast.If))
    for_types = {
        alias.name: line.module
        for line in block.body
        if isinstance(line, ast.ImportFrom)
        for alias in line.names
    }
    assert for_types == rtee._HOME
    assert set(dir(rtee)) == {*for_types, "__version__"}
    for name in dir(rtee):
        assert getattr(rtee, name)


def test_a_hand_knows_its_folder_and_its_keys() -> None:
    hand = rtee.load_hand(GRIPPER)
    assert hand.folder is not None
    assert {action.name for action in rtee.load_actions(hand)} == {
        action.name for action in rtee.load_actions(GRIPPER)
    }
    bare = load_model(hand.urdf.path)
    with pytest.raises(rtee.ConfigError, match=r"has no folder; load it with rtee\.load_hand"):
        rtee.load_actions(bare)
    assert hand.action_features == {"finger_joint": float}
    assert list(hand.observation_features)[:2] == ["position.finger_joint", "velocity.finger_joint"]


def test_an_action_is_written_one_way() -> None:
    of = rtee.ActionReference.of
    ring = rtee.ActionReference("trig", ("ring",), 0.8)
    assert of("trig:ring*0.8") == of(ring) == ring
    assert str(ring) == "trig:ring*0.8"
    assert of("pinch tight: index, thumb").elements == ("index", "thumb")
    assert of("pinch tight", ("index",)).action == "pinch tight"
    for wrong in ("", "trig:", "trig:a,,b", "trig*much", None):
        with pytest.raises(ActionError):
            of(wrong)  # type: ignore[arg-type]
    library = rtee.load_actions("schunk_svh")
    with pytest.raises(ActionError, match="elements must be a list of names"):
        library.find("Trig", "index")


def test_a_mistyped_trial_is_refused_before_any_begins() -> None:
    good = rtee.Trial("Grasp", object="sphere:0.03")
    with pytest.raises(rtee.UserError, match="unknown action 'Grip'"):
        rtee.run_trials(GRIPPER, [good, rtee.Trial("Grip")])
    with pytest.raises(rtee.UserError, match="shere"):
        rtee.run_trials(GRIPPER, [good, rtee.Trial("Grasp", object="shere:0.03")])


PROGRAM = f"""
import rtee
trials = [rtee.Trial("Grasp", object=f"sphere:{{radius}}") for radius in (0.8, 0.9)]
print([result.fits for result in rtee.run_trials("{GRIPPER}", trials, jobs=2)])
"""


@pytest.mark.samples("True")
@pytest.mark.parametrize("as_file", [True, False])
def test_a_program_need_not_guard_its_trials(tmp_path: Path, as_file: bool) -> None:
    """Its processes neither run it again nor look for the file of the standard input."""
    file = tmp_path / "program.py"
    file.write_text(PROGRAM)
    done = subprocess.run(
        [sys.executable, str(file) if as_file else "-"],
        input=None if as_file else PROGRAM,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("[False, False]\n", "")


def test_a_simulated_hand_in_a_notebook() -> None:
    """There, an event loop runs already."""

    async def cell() -> rtee.Outcome:
        with rtee.simulated(rtee.load_hand(GRIPPER), object="50mm") as hand:
            return hand.grasp("50mm").outcome

    assert asyncio.run(cell()) is rtee.Outcome.HELD
