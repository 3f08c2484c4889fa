"""Every experiment passes its own condition."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from experiments import (
    dagana_gui,
    drill,
    heri_objects,
    same_object,
    svh,
    variants,
    wide_grasp,
)
from experiments.common import Outcome, TrialStills, cells, hold
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.errors import ConfigError
from rtee.log import read
from rtee.trials.bench import bench, recorder_for
from rtee.trials.pictures import Stills
from rtee.trials.trial import Trial, run_trial
from tests.testing.browser import find_browser


def passed(outcome: Outcome) -> bool:
    assert outcome.conditions
    assert outcome.passed, [c for c in outcome.conditions if not c.passed]
    return all(path.stat().st_size > 0 for path in outcome.files)


@pytest.mark.heavy
def test_svh_reaches_its_postures(tmp_path: Path) -> None:
    outcome = svh.run(tmp_path, pictures=False, most=2)
    assert passed(outcome)
    assert {path.suffix for path in outcome.files} == {".mcap", ".png"}
    names = [span.name for span in read(next(tmp_path.glob("*.mcap"))).spans]
    assert names[1::2] == ["open"] * len(names[::2])
    assert names[-4::2] == [svh.FIGURE_4, "schunkGrasp"]


@pytest.mark.heavy
def test_the_trigger_is_pressed_and_let_go(tmp_path: Path) -> None:
    outcome = drill.run(tmp_path, pictures=False, variations=1)
    assert passed(outcome)
    assert outcome.conditions[-1].measured.startswith("1 of 1")
    (span,) = read(next(tmp_path.glob("*.mcap"))).spans
    assert [inner.name for inner in span.inner] == ["GRASP3f", "TrigOn", "TrigOff"]


def test_a_drill_on_the_palm_is_given_farther_out() -> None:
    ready = bench("heri_ii")
    options = SimOptions(object="drill", carrier="arm")
    names, period = ready.hand.actuator_names, ready.settings.period
    simulation = make_simulation(ready.hand, options, names, period, mount=drill.REACH)
    inside = np.array(drill.PLACE)
    inside[2, 3] -= 0.005
    start = drill.given(simulation, inside)
    assert 0.003 < start[2, 3] - inside[2, 3] < 0.007
    assert simulation.surroundings.position_in_hand == pytest.approx(start[:3, 3])


@pytest.mark.heavy
def test_heri_ii_puts_an_object_into_the_container(tmp_path: Path) -> None:
    outcome = heri_objects.run(tmp_path, pictures=False, transfers=heri_objects.TRANSFERS[:1])
    assert passed(outcome)
    found = read(next(tmp_path.glob("*.mcap")))
    grasp, release = heri_objects.held_spans(found)
    assert grasp.span.name.startswith("PinchTight")
    assert grasp.span.end == release.span.start


def test_an_experiment_that_fails_says_so(tmp_path: Path) -> None:
    outcome = Outcome("held")
    hold("robotiq_2f_85", Trial("Grasp", object="sphere:0.06"), tmp_path, outcome, pictures=False)
    assert not outcome.passed
    assert not outcome.conditions[0].passed
    assert cells(outcome.conditions[0])[-1] == "NO"


@pytest.mark.heavy
@pytest.mark.browser
@pytest.mark.timeout(300)
@pytest.mark.skipif(find_browser() is None, reason="no Chromium was found")
def test_dagana_does_what_is_clicked_in_a_browser(tmp_path: Path) -> None:
    outcome = dagana_gui.run(tmp_path, pictures=False, steps=dagana_gui.STEPS[::2])
    assert passed(outcome)
    assert {path.suffix for path in outcome.files} == {".mcap", ".png"}


def test_without_a_browser_it_is_said_plainly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("RTEE_BROWSER", raising=False)
    with pytest.raises(ConfigError, match="no Chromium was found"):
        dagana_gui.run(tmp_path)
    assert not list(tmp_path.glob("*.mcap"))


@pytest.mark.parametrize("variant", variants.EXPECTED)
def test_the_variants_have_the_stated_primitives(variant: int, tmp_path: Path) -> None:
    from collections import Counter

    from rtee.extract.extraction import extract

    found = Counter(p.name for p in extract(variants.hand(variant, tmp_path)).primitives)
    assert found == variants.EXPECTED[variant]


@pytest.mark.heavy
@pytest.mark.parametrize("gripper", same_object.GRIPPERS, ids=lambda gripper: gripper.name)
def test_the_same_object_is_picked_and_placed(gripper: same_object.Gripper, tmp_path: Path) -> None:
    outcome = Outcome("placed")
    same_object.in_dynamics(gripper, tmp_path, outcome, pictures=False, variations=0)
    assert passed(outcome)
    names = [span.name for span in read(next(tmp_path.glob("*.mcap"))).spans]
    assert names[-1] == "open"


@pytest.mark.heavy
def test_the_same_object_is_grasped_on_all_wires(tmp_path: Path) -> None:
    outcome = Outcome("grasped, held and let go")
    same_object.on_wires(same_object.GRIPPERS, tmp_path, outcome)
    assert passed(outcome)
    assert len(outcome.files) == 6


@pytest.mark.heavy
@pytest.mark.parametrize(("name", "trial"), wide_grasp.TRIALS)
def test_a_wide_grasp_holds(name: str, trial: Trial, tmp_path: Path) -> None:
    outcome = Outcome("held")
    hold(name, trial, tmp_path, outcome, slip=wide_grasp.SLIP, pictures=False)
    if name == "robotiq_3f":
        wide_grasp.check_spread(outcome)
    assert passed(outcome)
    (span,) = read(sorted(tmp_path.glob("*.mcap"))[-1]).spans
    assert span.name == trial.action


@pytest.mark.heavy
def test_the_steps_of_a_timed_action_get_their_pictures(tmp_path: Path) -> None:
    pytest.importorskip("PIL")
    ready = bench("robotiq_3f")
    stills = TrialStills(Stills.of_trial(ready.hand))
    trial = wide_grasp.TRIALS[0][1]
    run_trial(ready, trial, observers=[stills.steps], watch=stills)
    names = [name for name, _ in stills.stills.taken]
    assert names == ["start", "approach", wide_grasp.WIDE, "grasp", "lift", "shake"]


@pytest.mark.heavy
def test_two_runs_of_an_experiment_are_recorded_bit_for_bit_alike(tmp_path: Path) -> None:
    recordings, ready = [], bench("robotiq_2f_85")
    for run in ("one", "two"):
        folder = tmp_path / run
        with recorder_for(ready, folder) as recorder:
            run_trial(ready, Trial("Grasp"), observers=[recorder])
        recordings.append(read(next(folder.glob("*.mcap"))))
    first, second = recordings
    assert first.channels.keys() == second.channels.keys()
    for one, two in (
        (first.actuator_states, second.actuator_states),
        (first.reference, second.reference),
    ):
        assert len(one) > 500
        for name in ("t", "position", "velocity", "effort"):
            assert getattr(one, name).tobytes() == getattr(two, name).tobytes()
    assert [entry.value for entry in first.results] == [entry.value for entry in second.results]
