"""What the page asks for is checked, done in a process beside the GUI, one thing at a time."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from rtee.errors import ConfigError, RequestRejected
from rtee.gui.panels.trying import Jobs, folder_of, number, shape_text
from rtee.gui.scene import arrows_of, strongest
from rtee.gui.trial_results import Tried, object_name, verdict
from rtee.hand.load import load_hand
from rtee.objects.shape import Table
from rtee.trials.job import TrialJob, meshes_of
from rtee.trials.result import Trial, TrialResult

HAND = "robotiq_2f_85"


@pytest.mark.parametrize(
    ("kind", "sizes", "text"),
    [
        ("sphere", [60.0], "sphere:0.03"),
        ("cylinder", [60.0, 120.0], "cylinder:0.03x0.12"),
        ("box", [40.0, 41.5, 100.0], "box:0.04x0.0415x0.1"),
    ],
)
def test_sizes_are_those_that_people_measure(kind: str, sizes: list[float], text: str) -> None:
    assert shape_text(kind, sizes) == text


@pytest.mark.parametrize("value", ["1", None, True, float("nan"), float("inf"), -1.0, 1e9, [1.0]])
def test_a_page_may_send_anything_for_a_number(value: Any) -> None:
    with pytest.raises(ConfigError, match="the mass should be"):
        number(value, 0.001, 100.0, "the mass")


@pytest.mark.parametrize(
    "changes",
    [
        {"mass": float("nan")},
        {"mass": 0.0},
        {"friction": -0.1},
        {"friction": float("nan")},
        {"variations": 101},
        {"actions": ()},
        {"object": ""},
        {"object": "x" * 501},
    ],
)
def test_a_job_that_makes_no_sense_is_refused(changes: dict[str, Any]) -> None:
    given = {"folder": "somewhere", "object": "sphere:0.03", "actions": (("Grasp", ()),)}
    TrialJob(**given).check()
    with pytest.raises(ConfigError):
        TrialJob(**{**given, **changes}).check()


def test_a_job_is_read_as_it_was_written() -> None:
    job = TrialJob("there", "sphere:0.03", 0.2, None, (("Trig", ("index",)), ("Grasp", ())), 7)
    assert TrialJob.from_json(job.to_json()) == job


def test_only_meshes_in_the_folder_of_objects_are_offered(tmp_path: Path) -> None:
    assert meshes_of(tmp_path) == {}
    (tmp_path / "link.stl").touch()
    place = tmp_path / "objects"
    place.mkdir()
    for name in ("mug.stl", "notes.txt"):
        (place / name).touch()
    (place / "outside.stl").symlink_to(tmp_path / "link.stl")
    assert meshes_of(tmp_path) == {"mug.stl": place / "mug.stl"}


@pytest.mark.parametrize("name", ["../robotiq_2f_85", "/etc", "a/b", "", ".", "no_such_hand"])
def test_the_name_of_a_hand_never_becomes_a_path(name: str) -> None:
    with pytest.raises(ConfigError):
        folder_of(name, load_hand(HAND))


def test_a_hand_from_elsewhere_is_not_tried(repository: Path, tmp_path: Path) -> None:
    copy = tmp_path / HAND
    shutil.copytree(repository / "config" / HAND, copy)
    with pytest.raises(ConfigError, match="cannot be tried here"):
        folder_of(HAND, load_hand(copy))


def test_a_result_is_shown_with_its_rate() -> None:
    trial = Trial("Grasp", (), "/somewhere/mug.stl", variations=20)
    held = TrialResult(trial, True, survived=18)
    assert verdict(held) == "held, 18 of 20 variations (95 % confidence: 70 to 97 %)"
    assert verdict(TrialResult(trial, False, "it fell while it was lifted")).startswith("it fell")
    assert object_name(trial.object) == "mug.stl"
    again = TrialResult(trial, True, survived=19)
    tried = Tried().with_own(held).with_own(again)
    assert tried.own["Grasp", ()] == [again]


def test_arrows_begin_at_the_contacts_and_grow_with_the_force() -> None:
    rows = np.array([[0.1, 0, 0, 10.0, 0, 0, 0], [0, 0.1, 0, 0, -1.0, 0, 1.0]])
    arrows = arrows_of(rows, 0.2)
    assert arrows[:, 0] == pytest.approx(rows[:, :3])
    ways = arrows[:, 1] - arrows[:, 0]
    assert ways[0] == pytest.approx([0.035, 0.0, 0.0])
    assert ways[1][1] < 0.0 < np.linalg.norm(ways[1]) < np.linalg.norm(ways[0])
    assert strongest(rows, ("tip", "palm")) == "tip 10.0 N, palm 1.0 N"


@pytest.mark.heavy
@pytest.mark.anyio
async def test_a_trial_is_done_apart_one_at_a_time_and_cancelled(repository: Path) -> None:
    pytest.importorskip("mujoco")
    jobs, said = Jobs(), list[dict[str, Any]]()
    folder = str(repository / "config" / HAND)
    job = TrialJob(folder, "box:0.04x0.04x0.1", actions=(("Grasp", ()),), variations=2)
    await jobs.run(job, "a trial", said.append)
    (result,) = [each["result"] for each in said if "result" in each]
    assert result["held"]
    assert result["variations"]["tried"] == 2
    progress = [each["progress"] for each in said if "progress" in each]
    assert progress == sorted(progress)
    texts = [each["text"] for each in said if "text" in each]
    assert texts == [
        f"Grasp: {what}" for what in ("without variation", "variation 1 of 2", "variation 2 of 2")
    ]

    with pytest.raises(RequestRejected, match="no_such_action"):
        await jobs.run(
            TrialJob(folder, "sphere:0.03", actions=(("no_such_action", ()),)), "it", print
        )

    begun = anyio.Event()
    long = TrialJob(folder, "sphere:0.03", actions=(("Grasp", ()),), variations=100)
    async with anyio.create_task_group() as group:
        group.start_soon(jobs.run, long, "a trial", lambda _: begun.set())
        await begun.wait()
        with pytest.raises(RequestRejected, match="a trial is still running"):
            await jobs.run(job, "another", print)
        group.cancel_scope.cancel()
    assert jobs.running == ""


@pytest.mark.anyio
async def test_grasps_are_planned_apart(repository: Path) -> None:
    pytest.importorskip("coal")
    said = list[dict[str, Any]]()
    folder = str(repository / "config" / HAND)
    job = TrialJob(folder, "box:0.04x0.04x0.1", checked=0, table=Table((0.0, 0.0, 1.0)))
    await Jobs().run(job, "planning", said.append)
    assert said[0]["text"] == "looking for grasps"
    (ranking,) = [each["ranking"] for each in said if "ranking" in each]
    assert ranking["plans"][0]["reasons"]
    assert np.array(ranking["plans"][0]["table"])[:3, 2] == pytest.approx([0, 0, 1])
    with pytest.raises(RequestRejected, match="does not fit"):
        await Jobs().run(TrialJob(folder, "sphere:0.5", checked=0), "planning", said.append)
