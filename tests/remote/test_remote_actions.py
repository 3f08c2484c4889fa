from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import pytest

import rtee
from rtee.actions.build import StepPlan
from rtee.actions.fingerprints import Fingerprints
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference
from rtee.errors import ActionError, GoalRejected, RequestRejected
from rtee.hand.model import Hand
from rtee.trials.store import outdated

from .serving import make_library, serving

pytestmark = pytest.mark.anyio


async def test_queries_answer_as_the_library_does(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        assert await remote.actions() == list(library)
        assert await remote.actions("timed") == library.all("timed")
        assert await remote.actions(name="pinchtight", elements=["thumb"]) == library.all(
            "primitive", "PinchTight", ["thumb"]
        )
        assert await remote.primitives() == library.primitives()
        assert await remote.partners("pinch_tight", "index") == ("thumb",)
        for question in (remote.partners("dance", "index"), remote.actions("lively")):
            with pytest.raises(RequestRejected, match="unknown"):
                await question
        assert await remote.robot_description() == hand.urdf.text


async def test_a_new_generic_action_is_there_for_everybody_at_once(
    hand: Hand, library: ActionLibrary
) -> None:
    async with (
        serving(hand, library) as served,
        rtee.connect("small") as one,
        rtee.connect("small") as two,
    ):
        await one.add_generic("half", {"near": 0.5}, description="half closed")
        (half,) = await two.actions(name="HALF")
        assert half.posture.involved == ("near",)
        assert half.description == "half closed"
        assert (await two.do("half")).position["near"] == pytest.approx(0.5, abs=0.02)
        event = await served.event("actions_changed")
        assert "half" in event.text
        assert event.source == one.client
    assert not library.is_stored("half")


async def test_actions_are_stored_when_asked(
    hand: Hand, library: ActionLibrary, tmp_path: Path
) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        await remote.add_generic("half", {"near": 0.5}, store=True)
        parts = [ActionReference("half", (), 0.5), ActionReference("trig", ("thumb",))]
        await remote.add_composed("both", parts, independent=True)
        await remote.store_action("both")
        steps = [StepPlan(ActionReference("both"), "first", 0.1, 0.2)]
        await remote.add_timed("late", steps, store=True)
    stored = ActionLibrary.load(hand, tmp_path / "actions")
    both = stored.find("both")
    assert both.posture.position["near"] == pytest.approx(0.25)
    assert stored.find("late").steps[0].after == 0.2


async def test_removing_and_renaming(hand: Hand, library: ActionLibrary, tmp_path: Path) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        await remote.rename_action("fist", "grab")
        assert [action.name for action in await remote.actions("composed")] == ["grab"]
        await remote.remove_action("poke")
        assert await remote.actions("generic") == []
        for question in (remote.remove_action("poke"), remote.rename_action("poke", "x")):
            with pytest.raises(RequestRejected, match="unknown action 'poke'"):
                await question
    assert ActionLibrary.load(hand, tmp_path / "actions").names == library.names


@pytest.mark.parametrize(
    ("name", "values", "reason"),
    [
        ("a/x", {"near": 0.5}, "not allowed"),
        ("x", {"near": 9.0}, "upper limit 1.5 rad"),
        ("x", {"near": float("nan")}, "finite"),
        ("x", {"pollex": 0.0}, "unknown actuator 'pollex'"),
        ("x", {}, "at least one actuator"),
        ("fist", {"near": 0.5}, "already is an action"),
        ("trig", {"near": 0.5}, "primitive"),
    ],
)
async def test_bad_actions_are_refused_with_a_reason(
    hand: Hand, library: ActionLibrary, name: str, values: dict[str, float], reason: str
) -> None:
    before = list(library)
    async with serving(hand, library), rtee.connect("small") as remote:
        with pytest.raises(RequestRejected, match=reason):
            await remote.add_generic(name, values, store=True)
    assert list(library) == before


async def test_replacing(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        await remote.add_composed("fist", [ActionReference("Trig", ("index",))], replace=True)
        (fist,) = await remote.actions(name="fist")
        assert fist.posture.involved == ("near",)


async def test_edited_files_are_read_again(
    hand: Hand, library: ActionLibrary, tmp_path: Path
) -> None:
    path = tmp_path / "actions" / "generic" / "poke.yaml"
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        path.write_text(path.read_text().replace("0.04", "0.02"))
        os.utime(path, ns=(1, 1))
        (poke,) = await remote.actions(name="poke")
        assert poke.posture.position["push"] == 0.02
        assert "read again" in (await served.event("actions_changed")).text
        path.write_text("name: poke\n")
        with pytest.raises(RequestRejected, match=r"poke\.yaml"):
            await remote.actions()
        assert (await remote.do("poke")).reached


async def test_information_for_planners(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        at_rest, bent = await remote.info(), await remote.info({"near": 1.0})
        assert at_rest.fingers[0].tip_pose is not None
        assert bent.fingers[0].tip_pose is not None
        assert not (at_rest.fingers[0].tip_pose == bent.fingers[0].tip_pose).all()
        assert (at_rest.fingers[1].tip_pose == bent.fingers[1].tip_pose).all()
        with pytest.raises(RequestRejected, match="unknown actuator"):
            await remote.info({"pollex": 1.0})


async def test_a_library_without_a_folder_stores_nothing(hand: Hand) -> None:
    async with serving(hand, make_library(hand)), rtee.connect("small") as remote:
        with pytest.raises(RequestRejected, match="no folder"):
            await remote.store_action("fist")


async def test_what_trials_found_is_told(hand: Hand, tmp_path: Path) -> None:
    make_library(hand, tmp_path / "actions")
    async with (
        serving(hand, library := ActionLibrary.load(hand, tmp_path / "actions")),
        rtee.connect("small") as remote,
    ):
        assert await remote.trials() == ""
        (tmp_path / "trials.yaml").write_text("trials: []\n")
        text = await remote.trials()
        assert text.startswith("trials: []\n")
        assert text.endswith(f"present: '{Fingerprints.of(tmp_path, library).files}'\n")
    async with serving(hand, make_library(hand)), rtee.connect("small") as remote:
        assert await remote.trials() == ""


async def test_trials_are_told_though_all_actions_are_gone(hand: Hand, tmp_path: Path) -> None:
    (tmp_path / "trials.yaml").write_text("trials: []\n")
    async with (
        serving(hand, ActionLibrary.load(hand, tmp_path / "actions")),
        rtee.connect("small") as remote,
    ):
        text = await remote.trials()
    assert "present_actions" not in text
    assert outdated(text + "made_with: 0\n", Path("trials.yaml")) == frozenset()


async def test_wrong_types_are_said_in_words(hand: Hand, library: ActionLibrary) -> None:
    wrong: Any
    async with serving(hand, library), rtee.connect("small") as remote:
        for wrong in (None, 5, "near", ["near"], {"near": "far"}, {"near": math.nan}):
            with pytest.raises(GoalRejected, match="set-point"):
                await remote.add_generic("point", wrong)
        for wrong in (5, "near", {"near": "far"}):
            with pytest.raises(GoalRejected, match="position"):
                await remote.info(wrong)
        for wrong in ("fist", 5):
            with pytest.raises(ActionError, match=f"must be a StepPlan, .*, not {wrong!r}"):
                await remote.add_timed("twice", [wrong])
            with pytest.raises(ActionError, match="must be a StepPlan"):
                library.sequence("twice", [wrong])
