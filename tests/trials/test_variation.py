"""Variations are drawn alike everywhere, and what they show is reported with its confidence."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("mujoco")

from rtee.actions.fingerprints import Fingerprints
from rtee.cli._common import app_of
from rtee.cli.try_ import try_
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.hand.load import load_hand
from rtee.objects.shape import parse_object
from rtee.planning.objects import read_object
from rtee.sample import FloatArray
from rtee.trials.bench import bench
from rtee.trials.grasp_placement import Place, Places
from rtee.trials.result import CHOOSING
from rtee.trials.robust_places import robust_places
from rtee.trials.store import from_document, read_results, to_document, write_results
from rtee.trials.trial import (
    Trial,
    TrialResult,
    _carefully,
    _middle,
    _scanned,
    _simulation,
    _Tried,
    _Varied,
    run_trial,
)
from rtee.trials.variation import (
    FRICTION,
    MASS,
    POSITION,
    SIZE,
    TURN,
    Variation,
    choosing_draw,
    draw,
    interval,
)
from rtee.trials.work import attempt

GRIPPER = "robotiq_2f_85"


@pytest.mark.parametrize(
    ("successes", "tries", "low", "high"),
    [
        # Computed with statsmodels' proportion_confint(method="wilson").
        (18, 20, 0.6990, 0.9721),
        (0, 20, 0.0, 0.1611),
        (20, 20, 0.8389, 1.0),
        (50, 100, 0.4038, 0.5962),
    ],
)
def test_the_interval_is_wilsons(successes: int, tries: int, low: float, high: float) -> None:
    assert interval(successes, tries) == pytest.approx((low, high), abs=1e-4)


def test_without_tries_nothing_is_known() -> None:
    assert interval(0, 0) == (0.0, 1.0)


def test_draws_depend_on_seed_and_number_alone() -> None:
    assert draw(3, 7) == draw(3, 7)
    assert len({draw(seed, number) for seed in range(3) for number in range(20)}) == 60


def test_draws_fill_their_ranges_and_stay_in_them() -> None:
    drawn = [draw(0, number) for number in range(400)]
    for values, low, high in (
        ([v.size for v in drawn], 1.0 - SIZE, 1.0 + SIZE),
        ([v.mass for v in drawn], 1.0, 1.0 + MASS),
        ([v.friction for v in drawn], *FRICTION),
        ([x for v in drawn for x in v.position], -POSITION, POSITION),
        ([float(np.linalg.norm(v.turn)) for v in drawn], 0.0, TURN),
    ):
        span = high - low
        assert low <= min(values) < low + 0.05 * span
        assert high - 0.05 * span < max(values) <= high


def test_twenty_draws_that_choose_a_place_are_balanced() -> None:
    drawn = [choosing_draw(3, number) for number in range(2 * CHOOSING)]
    assert len(set(drawn)) == 2 * CHOOSING
    assert not set(drawn) & {draw(3, number) for number in range(2 * CHOOSING)}
    assert np.mean([v.position for v in drawn], axis=0) == pytest.approx(np.zeros(3))
    assert np.mean([v.turn for v in drawn], axis=0) == pytest.approx(np.zeros(3))
    for values, middle in (
        ([v.size for v in drawn], 1.0),
        ([v.mass for v in drawn], 1.0 + MASS / 2),
        ([v.friction for v in drawn], sum(FRICTION) / 2),
    ):
        assert np.mean(values) == pytest.approx(middle)


def test_an_object_is_moved_and_turned_about_itself() -> None:
    variation = replace(draw(0, 0), position=(0.001, 0.0, -0.002), turn=(0.0, 0.0, np.pi / 2))
    pose = np.eye(4)
    pose[:3, 3] = (0.1, 0.2, 0.3)
    moved = variation.moved(pose)
    assert moved[:3, 3] == pytest.approx([0.101, 0.2, 0.298])
    assert moved[:3, 0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)


@pytest.mark.parametrize(
    "shape", ["box:0.04x0.02x0.1", "cylinder:0.02x0.1", "sphere:0.03", "drill"]
)
def test_an_object_is_scaled_in_all_its_lengths(shape: str) -> None:
    hand = load_hand(GRIPPER)
    volumes = []
    for scale in (1.0, 1.1):
        options = SimOptions(object=shape, object_scale=scale)
        model = make_simulation(hand, options, hand.actuator_names, 0.004).model
        own = np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body("object").id)
        volumes.append(np.prod(np.where(model.geom_size[own] > 0, model.geom_size[own], 1.0)))
        lowest = parse_object(shape, ()).scaled(scale).lowest(np.eye(4))
        assert lowest == pytest.approx(scale * parse_object(shape, ()).lowest(np.eye(4)))
    assert volumes[1] > 1.09 * volumes[0]


@pytest.fixture(scope="module")
def varied() -> TrialResult:
    trial = Trial("Grasp", object="box:0.04x0.04x0.1", variations=4, seed=1, places=1)
    return attempt(GRIPPER, trial)


@pytest.mark.timeout(180)
@pytest.mark.heavy
def test_a_good_grasp_survives_its_variations(varied: TrialResult) -> None:
    assert varied.held
    assert varied.survived == 4


@pytest.mark.heavy
@pytest.mark.timeout(180)
def test_the_same_seed_gives_the_same_result(varied: TrialResult) -> None:
    assert attempt(GRIPPER, varied.trial) == varied


def test_what_is_lost_anyway_is_not_varied() -> None:
    result = attempt(GRIPPER, Trial("Grasp", object="sphere:0.06", variations=1000))
    assert not result.held
    assert result.survived == 0


def test_without_friction_nothing_is_held() -> None:
    result = attempt(GRIPPER, Trial("Grasp", object="box:0.04x0.04x0.1", friction=0.0, places=1))
    assert not result.held


def test_results_of_variations_are_kept(tmp_path: Path) -> None:
    trial = Trial("Grasp", object="box:0.04x0.04x0.1", variations=4, seed=1, places=1)
    varied = TrialResult(trial, held=True, survived=4)
    document = json.loads(json.dumps(to_document(varied)))
    assert document["variations"]["held"] == 4
    assert document["variations"]["interval"] == pytest.approx([0.51, 1.0], abs=1e-3)
    # How many places were tried is not kept.
    kept = replace(varied, trial=replace(varied.trial, places=Trial("Grasp").places))
    assert from_document(document) == kept
    write_results(tmp_path / "trials.yaml", Fingerprints("abc"), [varied])
    assert read_results(tmp_path / "trials.yaml") == {varied.trial.key: kept}


def test_results_from_before_there_were_variations_are_read() -> None:
    document = to_document(TrialResult(Trial("Grasp", variations=4), held=True, survived=4))
    del document["variations"]
    assert from_document(document).trial.variations == 0


@pytest.mark.heavy
@pytest.mark.timeout(180)
def test_the_rate_is_reported_with_its_confidence() -> None:
    words = [GRIPPER, "Grasp", "--object", "box:0.04x0.04x0.1", "--variations", "2"]
    outcome = CliRunner().invoke(app_of(try_), [*words, "--friction", "0.9"])
    assert outcome.exit_code == 0, outcome.output
    assert "2 of 2 variations (95 % confidence: 34 to 100 %)" in outcome.stdout


@pytest.mark.heavy
@pytest.mark.timeout(300)
def test_a_place_is_chosen_by_more_tries() -> None:
    shape = "box:0.04x0.04x0.1"
    words = [GRIPPER, "Grasp", "--object", shape, "--variations", "3", "--choose-by", "12"]
    outcome = CliRunner().invoke(app_of(try_), [*words, "--json"])
    assert outcome.exit_code == 0, outcome.output
    document = json.loads(outcome.stdout)
    assert document["variations"]["choosing"] == 12
    assert document["variations"]["held"] == 3
    result = from_document(document)
    assert result.trial == Trial("Grasp", object=shape, variations=3, choosing=12)


@pytest.mark.heavy
@pytest.mark.timeout(300)
def test_a_place_on_the_edge_is_moved_towards_the_middle() -> None:
    ready = bench(GRIPPER)
    trial = Trial("Grasp", object="sphere:0.02", variations=2, choosing=20)
    varied = _Varied(ready, trial, None)
    simulation = _simulation(ready, trial)
    action = ready.library.find("Grasp", ())
    thing = read_object(trial.object, trial.mass)
    middle = robust_places(simulation, ready.library, action, thing, 1)[0]
    pose = np.array(middle.pose)
    pose[2, 3] += 0.024  # to the ends of the fingertips, which still hold it
    edge = replace(middle, pose=pose)
    start = _Tried(edge, varied.run(edge).result())
    assert start.result.held
    found = _carefully([start], varied, Places(simulation, ready.hand, action))
    assert found.place.pose[2, 3] < pose[2, 3] - 0.002
    assert found.around > start.around > 0.0
    assert len(found.held) == 2


class Region:
    """Stands for the tries at a place; held is what lies in a region, however it is varied."""

    def __init__(self, trial: Trial, low: FloatArray, high: FloatArray) -> None:
        self._trial, self._low, self._high = trial, low, high

    def __call__(self, place: Place, variation: Variation | None = None) -> Region:
        beside = np.zeros(3) if variation is None else np.array(variation.position)
        point = place.pose[:3, 3] + beside
        self._inside = bool(np.all((self._low <= point) & (point <= self._high)))
        return self

    def held(self) -> bool:
        return self._inside

    def result(self) -> TrialResult:
        return TrialResult(self._trial, self._inside)


class Clear:
    """Stands for a hand that is nowhere in the way."""

    @staticmethod
    def freed(place: Place) -> FloatArray:
        return place.pose


def scanned_in(low: FloatArray, high: FloatArray, monkeypatch: pytest.MonkeyPatch) -> _Tried:
    """Return the place that is found from one at the origin, which its tries choose first."""
    ready = bench(GRIPPER)
    trial = Trial("Grasp", object="sphere:0.03", variations=20, choosing=40)
    varied = _Varied(ready, trial, None)
    monkeypatch.setattr(varied, "run", Region(trial, low, high))
    start = _Tried(Place(np.eye(4), 0.0, np.zeros(3)), TrialResult(trial, True))
    varied.choose(start, 40)
    assert len(start.held) == 40
    return _scanned(start, varied, cast("Places", Clear()))


def test_a_place_that_survives_all_its_tries_is_moved_to_the_middle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # At its start, the object is just held however it is moved; along z there is room to one side.
    wide = np.full(3, POSITION)
    found = scanned_in(-wide, wide + np.array([0.0, 0.0, 0.008]), monkeypatch)
    assert found.lost == 0
    assert found.place.pose[:3, 3] == pytest.approx([0.0, 0.0, 0.004])


def test_a_place_beside_the_middle_is_moved_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    middle, wide = np.array([0.008, 0.0, -0.004]), np.full(3, 0.8 * POSITION)
    found = scanned_in(middle - wide, middle + wide, monkeypatch)
    # To one step: the draws are random.
    assert found.place.pose[:3, 3] == pytest.approx(middle, abs=0.0041)
    assert found.place.pose[0, 3] == pytest.approx(middle[0])
    assert found.share > 0.5


@pytest.mark.parametrize(
    ("shares", "middle"),
    [
        ({0: 1.0}, 0),
        ({-2: 1.0, -1: 1.0, 0: 1.0, 1: 1.0, 2: 1.0}, 0),
        ({-1: 0.6, 0: 1.0, 1: 1.0, 2: 1.0}, 1),
        ({0: 0.7, 1: 0.9, 2: 0.9}, 2),
        ({0: 0.5, 1: 0.7, 2: 0.8, 3: 0.7}, 2),
        # One that survives more than its neighbours may do so by chance.
        ({-2: 0.2, -1: 0.4, 0: 0.95, 1: 0.9, 2: 0.9}, 1),
    ],
)
def test_the_middle_of_a_row_counts_its_neighbours(shares: dict[int, float], middle: int) -> None:
    assert _middle(shares) == middle


@pytest.mark.heavy
@pytest.mark.parametrize("choosing", [20, 40])
def test_moved_places_are_freed_of_the_hand_where_it_began(
    choosing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not of the hand as the last trial left it, lifted: there, the ball would be in its base."""
    ready = bench("onrobot_3fg15")
    moved = []

    def compare(contenders: list[_Tried], varied: _Varied, free: Places) -> _Tried:
        place = contenders[0].place
        moved.append(free.freed(place) - place.pose)
        return contenders[0]

    monkeypatch.setattr("rtee.trials.trial._carefully", compare)
    monkeypatch.setattr("rtee.trials.trial._scanned", lambda best, varied, free: best)
    trial = Trial("Grasp", object="sphere:0.05", places=1, variations=1, choosing=choosing)
    assert run_trial(ready, trial).held
    assert np.array(moved) == pytest.approx(np.zeros((1, 4, 4)))


def place_for(trial: Trial) -> tuple[_Varied, Place]:
    ready = bench(GRIPPER)
    simulation = _simulation(ready, trial)
    thing = read_object(trial.object, trial.mass)
    action = ready.library.find(trial.action, ())
    place = robust_places(simulation, ready.library, action, thing, 1)[0]
    return _Varied(ready, trial, None), place


@pytest.mark.parametrize(
    ("friction", "mass", "reason"),
    [
        (1.0, 0.1, ""),
        (0.01, 2.0, "it fell while it was lifted"),
        (0.0, 0.1, "it fell while it was shaken"),
    ],
)
def test_what_is_certain_ends_a_variation(friction: float, mass: float, reason: str) -> None:
    trial = Trial("Grasp", object="sphere:0.03", mass=mass, friction=friction)
    varied, place = place_for(trial)
    whole, short = varied.run(place), varied.run(place)
    result = whole.result()
    assert result.reason == reason
    assert short.held() == result.held
    # Only what has fallen is not watched to the end.
    ticks = [run.scene.headless.ticks for run in (whole, short)]
    assert ticks[1] < ticks[0] if reason else ticks[1] == ticks[0]


class Foreseen:
    """Stands for a variation of which is known whether it is held."""

    def __init__(self, held: bool) -> None:
        self._held = held

    def held(self) -> bool:
        return self._held


def test_tries_that_decide_nothing_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the tries would show, the same places are good, and the same one is the best."""
    ready = bench(GRIPPER)
    trial = Trial("Grasp", object="sphere:0.03", variations=20)
    varied, pose = _Varied(ready, trial, None), np.eye(4)
    random = np.random.default_rng(7)
    made = needed = 0
    for rate in np.repeat((0.2, 0.6, 0.8, 0.95), 40):
        tables = [(random.random(10) < rate).tolist() for _ in range(5)]
        slips = random.choice([0.001, 0.002, 0.003], 5).tolist()
        tried: list[_Tried] = []
        good: int | None = None
        for number, (table, slip) in enumerate(zip(tables, slips, strict=True)):
            coming = iter(table)
            monkeypatch.setattr(varied, "run", lambda *_, it=coming: Foreseen(next(it)))
            result = TrialResult(trial, held=bool(random.random() < 0.9), slip=slip)
            here = _Tried(Place(pose, 0.0, np.zeros(3)), result)
            tried.append(here)
            best = max(tried[:-1], key=lambda one: one.rank, default=None)
            if varied.good(here, best):
                good = number
                break
        # The same without leaving anything out.
        whole = []
        expected: int | None = None
        for number, (here, table) in enumerate(zip(tried, tables, strict=False)):
            count = 0 if not here.result.held else 10 if all(table[:5]) else 5
            whole.append(_Tried(here.place, here.result, table[:count]))
            if count == 10 and whole[-1].lost <= 1:
                expected = number
                break
        assert good == expected
        assert len(whole) == len(tried)
        if good is None:
            places = range(len(tried))
            best_of_tried = max(places, key=lambda number: tried[number].rank)
            assert best_of_tried == max(places, key=lambda number: whole[number].rank)
            assert tried[best_of_tried].held == whole[best_of_tried].held
        made += sum(len(one.held) for one in tried)
        needed += sum(len(one.held) for one in whole)
    assert made < needed


def test_a_sweep_takes_no_friction_of_its_own() -> None:
    words = [GRIPPER, "--all", "--friction", "0.5"]
    outcome = CliRunner().invoke(app_of(try_), words)
    assert outcome.exit_code == 2
    assert "--friction and --all exclude each other" in outcome.output
