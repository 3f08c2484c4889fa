"""Planned grasps in dynamics."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")

from rtee.drivers.mujoco.simulation import Simulation
from rtee.objects.shape import Table
from rtee.planning.objects import read_object
from rtee.planning.plan import plan_grasps
from rtee.trials.bench import TrialBench, bench
from rtee.trials.headless import HeadlessHand
from rtee.trials.planned import check_plan, checked
from rtee.trials.trial_run import TrialRun
from rtee.trials.variation import Variation


@pytest.fixture(scope="module")
def gripper(repository: Path) -> TrialBench:
    return bench(str(repository / "config/robotiq_2f_85"))


@pytest.mark.parametrize("text", ["box:0.04x0.04x0.1", "capsule:0.02x0.1"])
def test_a_planned_grasp_holds(gripper: TrialBench, text: str) -> None:
    thing = read_object(text)
    ranking = plan_grasps(gripper.hand, gripper.library, thing)
    found = checked(gripper, thing, ranking, 1)
    check = found.plans[0].check
    assert check is not None
    assert check.held
    assert check.reason == ""
    assert check.slip < 0.01
    assert "held in dynamics" in found.plans[0].reasons[-1]


@pytest.mark.samples("*0.012")
@pytest.mark.parametrize("text", ["box:0.05x0.04x0.03", "box:0.16x0.16x0.012"])
def test_what_stands_on_a_table_is_held_without_pressing_on_it(
    gripper: TrialBench, text: str
) -> None:
    # The plate is wider than the jaws open: it has to stand out over the table's edge.
    thing = read_object(text)
    ranking = plan_grasps(gripper.hand, gripper.library, thing, table=Table((0.0, 0.0, 1.0)))
    plan = ranking.plans[0]
    assert plan.overhang == pytest.approx(0.064 if "0.16" in text else 0.0)
    check = check_plan(gripper, thing, ranking, plan)
    assert check.held
    assert check.pressed < 1.0


@pytest.mark.heavy
def test_fingers_that_wait_for_one_another_hold_what_they_would_push(repository: Path) -> None:
    fingers = bench(str(repository / "config/inspire_rh56"))
    thing = read_object("box:0.04x0.04x0.06")
    ranking = plan_grasps(fingers.hand, fingers.library, thing, table=Table((0.0, 0.0, 1.0)))
    plan = ranking.plans[0]
    assert plan.force is not None
    aside = Variation(1.0, 1.0, (0.002, -0.003, 0.003), (0.04, 0.0, -0.02), 0.6)
    assert check_plan(fingers, thing, ranking, plan).held
    assert check_plan(fingers, thing, ranking, plan, aside).held
    # To the same place by intensity: the thumb and the fingers press with unequal efforts.
    pushed = dataclasses.replace(plan, force=None)
    assert not check_plan(fingers, thing, ranking, pushed).held


def test_the_hand_does_not_begin_inside_what_stands_beside_its_place(
    gripper: TrialBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    thing = read_object("box:0.04x0.04x0.06")
    ranking = plan_grasps(gripper.hand, gripper.library, thing, table=Table((0.0, 0.0, 1.0)))
    speeds: list[float] = []

    def noted(headless: HeadlessHand[Simulation], *given: Any, **options: Any) -> TrialRun:
        speeds.append(headless.simulation.surroundings.speed)
        return TrialRun(headless, *given, **options)

    monkeypatch.setattr("rtee.trials.planned.TrialRun", noted)
    # As far as the open jaws are wide: one of them is where the box stands.
    aside = Variation(1.0, 1.0, (0.0, 0.03, 0.0), (0.0, 0.0, 0.0), 0.5)
    check_plan(gripper, thing, ranking, ranking.plans[0], aside)
    assert max(speeds) < 0.05


def test_pieces_of_a_mesh_are_held(gripper: TrialBench, repository: Path) -> None:
    thing = read_object(str(repository / "experiments/objects/marker.stl"), mass=0.02)
    ranking = plan_grasps(gripper.hand, gripper.library, thing)
    check = check_plan(gripper, thing, ranking, ranking.plans[0])
    assert check.held


def test_a_grasp_that_is_lost_is_ranked_last(gripper: TrialBench) -> None:
    thing = read_object("box:0.04x0.04x0.1")
    ranking = plan_grasps(gripper.hand, gripper.library, thing)
    first = ranking.plans[0]
    away = np.array(first.pose)
    away[2, 3] += 0.3  # out of the fingers' reach
    missed = dataclasses.replace(first, pose=tuple(tuple(row) for row in away.tolist()))
    wrong = dataclasses.replace(ranking, plans=(missed, *ranking.plans[1:]))
    found = checked(gripper, thing, wrong, 1)
    # The next one is tried, too, since the first was lost, and no other after it holds.
    assert [plan.check and plan.check.held for plan in found.plans[:2]] == [True, None]
    assert found.plans[-1].check is not None
    assert not found.plans[-1].check.held
    assert "lost in dynamics: it was not grasped" in found.plans[-1].reasons[-1]


def test_the_weight_pulls_along_the_axis_that_is_asked_for(gripper: TrialBench) -> None:
    # Held sideways, the object's weight lies on the edges of the pads.
    thing = read_object("box:0.04x0.04x0.06")
    ranking = plan_grasps(gripper.hand, gripper.library, thing, weight_axis=(1.0, 0.0, 0.0))
    check = check_plan(gripper, thing, ranking, ranking.plans[0])
    assert ranking.weight_axis == (1.0, 0.0, 0.0)
    assert check.held
