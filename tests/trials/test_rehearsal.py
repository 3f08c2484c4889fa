"""A goal played in simulation before a hand does it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rtee.actions.build import generic
from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError, GoalRejected
from rtee.hand.load import hand_folder, load_configured
from rtee.trials.rehearsal import Rehearsal, rehearse
from rtee.types import Around, Fingers, Force, Goal, Intensity, Named

CUBE = "box:0.03x0.03x0.03"


def played(name: str, goal: Goal, thing: str = "", **position: float) -> Rehearsal:
    return rehearse(name, load_configured(name)[0].urdf.text, goal, thing, position)


def test_what_is_held_may_be_done() -> None:
    goal = Goal(Fingers(), Around(0.03), speed=0.5, effort=Force(10.0))
    rehearsal = played("robotiq_2f_85", goal, CUBE)
    assert rehearsal.held
    assert rehearsal.refusal(20.0) == ""
    # The blow of the closing fingers counts.
    assert (
        rehearsal.refusal(10.0) == f"it reaches {rehearsal.force:.1f} N, and a person allows 10 N"
    )


def test_what_is_lost_may_not() -> None:
    # It closes on nothing at a quarter of its way.
    rehearsal = played("robotiq_2f_85", Goal(Named("Grasp"), Intensity(0.25), speed=0.5), CUBE)
    assert not rehearsal.held
    assert rehearsal.refusal(20.0) == f"{CUBE} is lost"
    assert f"{CUBE} is lost" in rehearsal.words


def test_a_hand_that_strikes_itself_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "schunk_svh"
    shutil.copytree(hand_folder("schunk_svh")[0], folder)
    hand = load_configured(folder)[0]
    library = ActionLibrary.load(hand, folder / "actions")
    # The thumb across the palm, and all fingers closed on it.
    closed = {each.name: each.farthest for each in hand.actuators if "Spread" not in each.name}
    library.add(generic(hand, "crash", closed))
    library.save(folder / "actions")
    assert "strikes itself with " in played(str(folder), Goal(Named("crash"), speed=0.5)).refusal(
        1000.0
    )


def test_it_begins_where_the_hand_is() -> None:
    closed = played("robotiq_2f_85", Goal(Named("open"), speed=0.5), finger_joint=0.5)
    assert (
        closed.result.duration > 0.5 > played("robotiq_2f_85", Goal(Named("open"))).result.duration
    )


def test_other_files_and_impossible_goals_are_refused() -> None:
    with pytest.raises(ConfigError, match="here are not those of the running hand"):
        rehearse("robotiq_2f_85", "<robot/>", Goal(Named("open")), "", {})
    with pytest.raises(GoalRejected, match="mm"):
        played("robotiq_2f_85", Goal(Fingers(), Around(0.2)), CUBE)
