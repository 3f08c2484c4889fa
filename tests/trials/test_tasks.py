"""Eggs, cups and tugs: `rtee try --task`."""

from __future__ import annotations

import json
from typing import Any

import pytest
from typer.testing import CliRunner

pytest.importorskip("mujoco")

from rtee.cli._common import app_of
from rtee.cli.try_ import try_
from rtee.drivers.mujoco.objects import OBJECT
from rtee.errors import ConfigError, GoalRejected, RteeError
from rtee.trials.bench import bench
from rtee.trials.tasks import (
    BREAKS,
    RATE,
    End,
    GraspMode,
    Task,
    TaskTrial,
    filling,
    play,
    present,
    run_task,
)

GRIPPER = "robotiq_2f_85"
BALL = "sphere:0.02"


def tried(*words: str) -> list[dict[str, Any]]:
    """Return what the command prints as JSON."""
    done = CliRunner().invoke(
        app_of(try_), [GRIPPER, "Grasp", "--object", BALL, "--variations", "1", "--json", *words]
    )
    assert done.exit_code == 0, done.output
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


def test_the_whole_effort_breaks_an_egg_and_reflexes_do_not() -> None:
    effort, force, reflexes = tried("--task", "egg")
    assert [each["mode"] for each in (effort, force, reflexes)] == list(GraspMode)
    assert effort["results"][0]["end"] == End.BROKEN
    assert effort["results"][0]["peak"] > BREAKS
    assert (reflexes["succeeded"], reflexes["tries"]) == (1, 1)
    assert reflexes["results"][0]["peak"] < BREAKS
    assert (reflexes["force"], reflexes["max_force"]) == (3.0, 7.0)


@pytest.mark.samples("tug")
@pytest.mark.parametrize("task", [Task.CUP, Task.TUG])
def test_what_is_filled_or_tugged_at_needs_reflexes(task: Task) -> None:
    (reflexes,) = tried("--task", task, "--reflexes")
    assert reflexes["succeeded"] == 1
    effort, force = tried("--task", task, "--no-reflexes")
    assert effort["succeeded"] == 1
    assert force["results"][0]["end"] == End.LOST


def test_the_same_variation_ends_the_same_and_others_differ() -> None:
    ready = bench(GRIPPER, RATE)
    trial = TaskTrial(Task.EGG, "Grasp", object=BALL)
    first = run_task(ready, trial, 1)
    assert first == run_task(ready, trial, 1)
    assert first.peak != run_task(ready, trial, 2).peak


def test_the_sentence_tells_the_rate_and_how_the_others_ended() -> None:
    words = [GRIPPER, "Grasp", "--task", "egg", "--object", BALL, "--variations", "1"]
    done = CliRunner().invoke(app_of(try_), [*words, "--force", "3N", "--max-force", "6N"])
    lines = done.stdout.splitlines()
    assert lines[0].startswith(
        "egg, Grasp on sphere:0.02, the hand's effort, no reflexes: 0 of 1 succeed "
        "(95 % confidence: 0 to 79 %); 1 broken; at most "
    )
    assert "3 to 6 N, reflexes: 1 of 1 succeed" in lines[2]


def test_a_force_too_small_to_move_the_hand_is_told() -> None:
    words = [GRIPPER, "Grasp", "--task", "egg", "--object", "sphere:0.03", "--variations", "1"]
    words += ["--no-reflexes", "--force"]
    weak = CliRunner().invoke(app_of(try_), [*words, "3N"]).stdout
    assert "1 stopped before a finger touched it (the effort for this force hardly moves" in weak
    assert "1 of 1 succeed" in CliRunner().invoke(app_of(try_), [*words, "4N"]).stdout


@pytest.mark.parametrize(
    ("words", "error", "said"),
    [
        (["Grasp", "--task", "eg"], ConfigError, "unknown task 'eg'; did you mean 'egg'?"),
        (["--task", "egg"], ConfigError, "which action?"),
        (["Grasp", "--task", "egg", "--force", "3kg"], GoalRejected, "the force must be a force"),
        (
            ["Grasp", "--task", "egg", "--force", "5N", "--max-force", "4N"],
            ConfigError,
            "--max-force must be at least --force, 5 N, not 4 N",
        ),
        (["Grasp", "--task", "egg", "--object", "sphere:0.2"], ConfigError, "does not fit"),
    ],
)
def test_mistakes_are_told_in_one_sentence(
    words: list[str], error: type[RteeError], said: str
) -> None:
    with pytest.raises(error, match=said.replace("?", r"\?")):
        CliRunner().invoke(app_of(try_), [GRIPPER, *words], catch_exceptions=False)


def test_a_simulation_that_blows_up_is_told() -> None:
    trial = TaskTrial(Task.TUG, "Grasp", object=BALL)
    scene = present(bench(GRIPPER, RATE), trial, 0)
    scene.headless.simulation.data.qvel[0] = 1e30
    assert play(trial, scene).end is End.UNSTABLE


def test_a_filled_cup_is_as_inert_as_it_is_heavy() -> None:
    """MuJoCo works some of it out once, when the model is made."""
    scene = present(bench(GRIPPER, RATE), TaskTrial(Task.CUP, "Grasp", object=BALL), 0)
    model = scene.headless.simulation.model
    body = model.body(OBJECT).id
    dof, empty = model.body_dofadr[body], float(model.body_mass[body])
    filling(scene.headless.simulation)(1.0)
    mass = float(model.body_mass[body])
    assert mass > 1.2 * empty
    assert model.dof_M0[dof] == pytest.approx(mass)
    assert model.body_invweight0[body][0] == pytest.approx(1.0 / mass)
    assert model.dof_invweight0[dof] == pytest.approx(1.0 / mass)
