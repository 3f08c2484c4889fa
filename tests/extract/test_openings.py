"""Openings: exact for parallel grippers, honest about where they fall, refused when stale."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hand.robots import PALM, Robot, box

from rtee.actions.library import ActionLibrary
from rtee.actions.openings import Openings, OpeningTable, read_openings, to_document, write_openings
from rtee.actions.types import ActionReference, Composed, Generic, Posture, Timed
from rtee.errors import ActionError, ConfigError
from rtee.extract.openings import make_openings, opening_of
from rtee.hand.geometry import HandGeometry
from rtee.hand.load import load_hand, load_model
from rtee.hand.yamlfile import emit

CONFIG = Path(__file__).parents[2] / "config"


def library(name: str) -> ActionLibrary:
    return ActionLibrary.load(load_hand(CONFIG / name), CONFIG / name / "actions")


@pytest.mark.parametrize("name", ["robotiq_2f_85", "robotiq_2f_140", "cia402_gripper"])
def test_parallel_grippers_are_exact_to_a_tenth_of_a_millimetre(name: str) -> None:
    known = library(name)
    hand = known.hand
    geometry = HandGeometry(hand)
    tips = tuple(geometry.of_links(*finger.tip_links) for finger in hand.fingers[:2])
    opening = known.openings.of(known.find("Grasp"))
    goal = known.find("Grasp").waypoints[-1].position[hand.actuator_names[0]]
    for intensity in np.linspace(0.0, opening.intensity[-1], 301):
        u = hand.rest + intensity * (np.array([goal]) - hand.rest)
        poses = geometry.kinematics.placements(u)
        truth = geometry.closest(tips, poses, convex=False)[0]
        assert opening.at(intensity) == pytest.approx(max(truth, 0.0), abs=1e-4)
        assert opening.at(opening.intensity_at(truth)) == pytest.approx(truth, abs=1e-4)


@pytest.mark.samples("robotiq_2f_85", "onrobot_3fg15")
@pytest.mark.parametrize("name", ["robotiq_2f_85", "heri_ii", "onrobot_3fg15"])
def test_the_stored_tables_are_those_of_the_hand_as_it_is(name: str) -> None:
    known = library(name)
    made = make_openings(known.hand, known)
    assert made.tables
    stored = read_openings(CONFIG / name, known.hand)
    assert not stored.outdated
    assert emit(to_document(made)) == emit(to_document(stored))


def test_levers_are_the_slope_of_the_opening_by_virtual_work() -> None:
    known = library("heri_ii")
    opening = known.openings.of(known.find("PinchTight", ("finger_2", "thumb")))
    hand, posture = known.hand, known.find("PinchTight").waypoints[-1]
    way = {name: posture.position[name] - hand.actuator(name).rest for name in opening.actuators}
    for intensity in (0.2, 0.4, 0.6):  # before the tips touch, at 0.68
        levers = opening.levers_at(intensity)
        slope = (opening.at(intensity - 0.01) - opening.at(intensity + 0.01)) / 0.02
        assert sum(levers[n] * way[n] for n in way) == pytest.approx(slope, rel=0.05)


def test_a_way_on_which_tips_pass_each_other_ends_where_they_are_nearest() -> None:
    known = library("robotiq_3f")
    opening = known.openings.of(known.find("Grasp"))
    assert opening.intensity[-1] < 0.6
    assert "used up to" in opening.note
    assert np.all(np.diff(opening.width) < 0.0)
    assert opening.sides == (("finger_1", "finger_2"), ("finger_middle",))


def test_three_tips_around_a_middle_open_by_the_diameter_between_them() -> None:
    known = library("onrobot_3fg15")
    opening = known.openings.of(known.find("Grasp"))
    assert opening.around
    assert opening.widest == pytest.approx(0.150 - 0.0135, abs=5e-4)
    assert opening.narrowest == pytest.approx(0.0346 - 0.0135, abs=2e-3)


def meeting(tip: Sequence[str], tmp_path: Path, *, knuckles: bool) -> OpeningTable:
    """Return the opening of two fingers that lean outwards; ``knuckles``: of two joints each."""
    tmp_path.mkdir(exist_ok=True)
    robot = Robot("two").link("base", PALM)
    for side, x in (("left", -0.05), ("right", 0.05)):
        at, axis, above = (x, 0.0, 0.01), (0, -x / 0.05, 0), "base"
        if knuckles:
            robot.link(f"{side}_knuckle", box(0.01, 0.01, 0.01, (0, 0, 0.005)))
            robot.joint(f"{side}_1", "base", f"{side}_knuckle", at, axis, (0, 0.8))
            at, above = (0.0, 0.0, 0.03), f"{side}_knuckle"
        lean = (0.0, x / 0.05 * 0.7, 0.0)
        robot.link(f"{side}_tip", *tip)
        robot.joint(f"{side}_2", above, f"{side}_tip", at, axis, (0, 1.2), rpy=lean)
    hand = load_model(robot.write(tmp_path))
    posture = Posture(dict.fromkeys(hand.actuator_names, 0.8), hand.actuator_names)
    opening = opening_of(HandGeometry(hand), Generic("close", posture))
    assert opening is not None
    return opening


def test_a_fingertip_counts_whole_however_many_shapes_it_is_modelled_by(tmp_path: Path) -> None:
    whole = box(0.012, 0.012, 0.04, (0, 0, 0.02))
    parts = [box(0.012, 0.012, 0.01, (0, 0, 0.005 + 0.01 * k)) for k in range(4)]
    one = meeting([whole], tmp_path / "one", knuckles=True)
    several = meeting(parts, tmp_path / "several", knuckles=True)
    assert one.widest == pytest.approx(0.1 - 0.012 * math.cos(0.7), abs=1e-5)  # at the knuckles
    for intensity in np.linspace(0.0, one.intensity[-1], 50):
        assert several.at(intensity) == pytest.approx(one.at(intensity), abs=2e-4)


def test_the_hinge_of_a_jaw_is_no_fingertip(tmp_path: Path) -> None:
    tip = box(0.012, 0.012, 0.01, (0, 0, 0.055))
    hinge = box(0.03, 0.012, 0.01, (0, 0, 0.005))
    opening = meeting([hinge, tip], tmp_path, knuckles=False)
    # Inner edges of the tips, first the lower, then the upper ones; the hinges stay 70 mm apart.
    widest = 0.1 + 0.1 * math.sin(0.7) - 0.012 * math.cos(0.7)
    narrowest = 0.1 - 0.12 * math.sin(0.1) - 0.012 * math.cos(0.1)
    assert opening.widest == pytest.approx(widest, abs=1e-5)
    assert opening.narrowest == pytest.approx(narrowest, abs=1e-5)


def test_a_finger_between_two_others_opposes_the_nearest() -> None:
    known = library("schunk_svh")
    opening = known.openings.of(known.find("MultiPinchTight_3", ("index", "middle", "ring")))
    assert opening.sides == (("index", "middle"), ("ring",))


def test_actions_without_opposing_tips_have_none() -> None:
    known = library("schunk_svh")
    geometry = HandGeometry(known.hand)
    assert opening_of(geometry, known.find("Trig", ("index",))) is None
    timed = Timed("drill", ())
    assert opening_of(geometry, timed) is None
    with pytest.raises(ActionError, match="timed action, which has no opening"):
        Openings(known.hand).of(timed)
    with pytest.raises(ActionError, match="no two fingertips oppose each other"):
        known.openings.of(known.find("Trig", ("index",)))


def test_a_stale_table_is_refused_and_one_command_makes_it_again(tmp_path: Path) -> None:
    home = tmp_path / "robotiq_2f_85"
    shutil.copytree(CONFIG / "robotiq_2f_85", home)
    known = ActionLibrary.load(load_hand(home), home / "actions")
    part = ActionReference("SingleJointMultipleTips_2", ("finger_joint",), 0.5)
    known.add(known.compose("Grasp", [part]), store=True, replace_same=True)
    with pytest.raises(ActionError, match="made for another posture; `rtee openings robotiq_2f_85"):
        known.openings.of(known.find("Grasp"))
    assert known.openings.of(known.find("PinchTight")).widest > 0.08
    write_openings(home, make_openings(known.hand, known))
    assert known.openings.of(known.find("Grasp")).narrowest == pytest.approx(0.045, abs=0.01)

    other = replace(known.hand, urdf=replace(known.hand.urdf, text=known.hand.urdf.text + "\n"))
    assert read_openings(home, other).outdated
    (home / "openings.yaml").unlink()
    with pytest.raises(ActionError, match="are not known; `rtee openings"):
        known.openings.of(known.find("Grasp"))
    (home / "openings.yaml").write_text("format: 1\nmodel: x\nopenings: [{action: 3}]\n")
    with pytest.raises(ConfigError, match="is not a valid file of openings"):
        _ = known.openings


def test_measured_pairs_correct_the_table(tmp_path: Path) -> None:
    home = tmp_path / "robotiq_2f_85"
    shutil.copytree(CONFIG / "robotiq_2f_85", home)
    model = library("robotiq_2f_85").openings.of(library("robotiq_2f_85").find("Grasp"))
    at = model.intensity_at(0.03)
    with (home / "hand.yaml").open("a") as file:
        file.write(f"openings: {{Grasp: [[{at:.6f}, 0.031]]}}\n")
    known = ActionLibrary.load(load_hand(home), home / "actions")
    found = known.openings.of(known.find("Grasp"))
    assert found.at(at) == pytest.approx(0.031, abs=1e-5)
    assert found.widest == pytest.approx(model.widest + 0.001, abs=1e-5)
    assert np.all(np.diff(found.width) < 0.0)
    assert found.corrected([]) is found


@pytest.mark.parametrize("pairs", [[(0.0, 0.0)], [(0.0, 0.01), (1.0, 0.09)]])
def test_measured_pairs_that_leave_no_way_are_a_mistake(pairs: list[tuple[float, float]]) -> None:
    known = library("robotiq_2f_85")
    wrong = replace(known.hand, openings={"Grasp": tuple(pairs)})
    openings = replace(known.openings, hand=wrong)
    with pytest.raises(ActionError, match=r"of Grasp measured in hand\.yaml do not decrease"):
        openings.of(known.find("Grasp"))


def test_a_generic_action_has_an_opening_of_the_fingers_it_moves() -> None:
    known = library("robotiq_2f_85")
    posture = Posture({"finger_joint": 0.5}, ("finger_joint",))
    opening = opening_of(HandGeometry(known.hand), Generic("half", posture))
    assert opening is not None
    assert set(opening.fingers) == {"finger_1", "finger_2"}
    assert not math.isnan(opening.narrowest)
    composed = Composed("half", (), posture)
    again = opening_of(HandGeometry(known.hand), composed)
    assert again is not None
    assert again.posture == opening.posture
