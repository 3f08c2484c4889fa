"""Pick and place says why it failed, and a recording of several attempts is one after the other."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from experiments.transfer import MOMENTS, OFF, SLIDE, Transfer, TransferResult, run_transfer
from rtee.errors import UnknownAction
from rtee.log import read
from rtee.trials.bench import bench, recorder_for
from rtee.trials.trial import Trial, run_trial

GRIPPER = "robotiq_2f_85"


def transfer(what: Transfer, moments: list[str] | None = None) -> TransferResult:
    ready = bench(GRIPPER)
    watch = None if moments is None else lambda moment, _: moments.append(moment)
    return run_transfer(ready.hand, ready.library, ready.settings, what, watch=watch)


@pytest.mark.heavy
def test_a_box_is_carried_from_above_without_a_turn() -> None:
    moments: list[str] = []
    what = Transfer("Grasp", object="box:0.04x0.04x0.05", by=(0.1, 0.0), turn=0.0)
    result = transfer(what, moments)
    assert result.placed, result.reason
    assert result.off < OFF
    assert result.slide < SLIDE
    assert result.tilt < 0.05
    assert tuple(moments[-len(MOMENTS) :]) == MOMENTS


@pytest.mark.parametrize(
    ("radius", "reason", "tried"),
    [
        # The open tips, 86 mm apart, meet a ball of 100 mm above its middle, and slip off upwards.
        (0.05, "it fell while it was lifted", MOMENTS[:4]),
        # They do not reach around one of 120 mm.
        (0.06, "the object does not fit between the fingers", ()),
    ],
)
def test_what_is_wider_than_the_gripper_is_not_lifted(
    radius: float, reason: str, tried: tuple[str, ...]
) -> None:
    moments: list[str] = []
    result = transfer(Transfer("Grasp", object=f"sphere:{radius}", places=1), moments)
    assert not result.placed
    assert result.reason == reason
    assert tuple(moments) == tried


@pytest.mark.heavy
def test_variations_are_counted() -> None:
    what = Transfer("Grasp", object="box:0.04x0.04x0.05", by=(0.1, 0.0), places=1, variations=2)
    result = transfer(what)
    assert len(result.varied) == 2
    assert result.survived == sum(each.placed for each in result.varied)
    assert result.varied[0].off != result.varied[1].off


def test_an_object_is_put_into_the_container() -> None:
    what = Transfer(
        "Grasp", object="box:0.04x0.04x0.05", by=(0.3, 0.0), turn=0.0, container=True, places=2
    )
    assert transfer(what).placed


def test_an_unknown_action_is_refused() -> None:
    with pytest.raises(UnknownAction):
        transfer(Transfer("Wave"))


def test_attempts_are_recorded_one_after_the_other(tmp_path: Path) -> None:
    ready = bench(GRIPPER)
    lost = Trial("Grasp", object="sphere:0.03", intensity=0.0, places=2)
    with recorder_for(ready, tmp_path) as recorder:
        result = run_trial(ready, lost, observers=[recorder])
    assert not result.held
    recording = read(next(tmp_path.glob("*.mcap")))
    assert len(recording.results) == 2
    assert np.all(np.diff(recording.actuator_states.t) > 0.0)
