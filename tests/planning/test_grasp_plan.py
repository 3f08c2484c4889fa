"""Grasps planned for objects: geometric truths, in hands whose measures are known."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import subprocess
import threading
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from rtee.actions.build import full_posture, generic
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference, Primitive, PrimitiveKind
from rtee.errors import ConfigError, ModelError, RequestRejected, UserError
from rtee.hand.config_schema import FlangeSection
from rtee.hand.frames import origin
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand
from rtee.hand.tessellation import Triangles, box, cylinder
from rtee.objects.shape import Table, parse_object, parse_table
from rtee.planning.closing import ActionPath, HandClosing
from rtee.planning.composition import action_of
from rtee.planning.objects import read_object
from rtee.planning.plan import grasp_plan, plan_grasps
from rtee.planning.planner import rank
from rtee.planning.poses import orientations
from rtee.planning.question import Question, ask
from rtee.planning.result import from_document, to_document
from rtee.planning.scene import GraspScene
from rtee.sample import FloatArray
from rtee.trials.result import OBJECTS
from rtee.trials.robust_places import misfit

ROOT = Path(__file__).parents[2]

# Two jaws with flat sides 20 mm wide and 30 mm high, up to 100 mm apart; x is the axis of closing.
JAWS = """<robot name="jaws">
  <link name="palm"><collision><origin xyz="0 0 -0.01"/>
    <geometry><box size="0.14 0.04 0.02"/></geometry></collision></link>
  <joint name="jaw" type="prismatic"><parent link="palm"/><child link="left"/>
    <origin xyz="-0.05 0 0"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.05" velocity="0.1" effort="40"/></joint>
  <link name="left"><collision><origin xyz="-0.005 0 0.045"/>
    <geometry><box size="0.01 0.02 0.03"/></geometry></collision></link>
  <joint name="follower" type="prismatic"><parent link="palm"/><child link="right"/>
    <origin xyz="0.05 0 0"/><axis xyz="-1 0 0"/>
    <limit lower="0" upper="0.05" velocity="0.1" effort="40"/><mimic joint="jaw"/></joint>
  <link name="right"><collision><origin xyz="0.005 0 0.045"/>
    <geometry><box size="0.01 0.02 0.03"/></geometry></collision></link>
</robot>"""


@pytest.fixture(scope="module")
def jaws(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    file = tmp_path_factory.mktemp("jaws") / "jaws.urdf"
    file.write_text(JAWS)
    return load_model(file)


@pytest.fixture
def library(jaws: Hand) -> ActionLibrary:
    closed = full_posture(jaws, {"jaw": 0.05})
    return ActionLibrary(
        jaws,
        (
            Primitive(PrimitiveKind.PINCH_TIGHT, ("left", "right"), (closed,)),
            generic(jaws, "Half", {"jaw": 0.02}),
        ),
    )


def _stl(path: Path, *parts: Triangles) -> Path:
    corners = np.concatenate([vertices[faces] for vertices, faces in parts])
    record = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    triangles = np.zeros(len(corners), dtype=record)
    triangles["corners"] = corners
    path.write_bytes(bytes(80) + len(corners).to_bytes(4, "little") + triangles.tobytes())
    return path


def _pose(plan_pose: tuple[tuple[float, ...], ...]) -> FloatArray:
    return np.array(plan_pose)


def test_parallel_jaws_touch_a_box_on_opposite_sides(library: ActionLibrary) -> None:
    ranking = plan_grasps(library.hand, library, read_object("box:0.04x0.02x0.03"))
    plan = ranking.plans[0]
    assert plan.label == "PinchTight (left, right)"
    assert plan.width == pytest.approx(min(0.04, 0.02, 0.03))
    normals = {c.finger: np.array(c.normal) for c in plan.contacts if c.finger}
    assert normals["left"] == pytest.approx([1, 0, 0], abs=1e-6)
    assert normals["right"] == pytest.approx([-1, 0, 0], abs=1e-6)
    sides = {c.finger: c.point[0] for c in plan.contacts if c.finger}
    # Half the width to either side, and the half millimetre within which surfaces touch.
    assert sides["left"] == pytest.approx(-0.01, abs=1e-3)
    assert sides["right"] == pytest.approx(0.01, abs=1e-3)


def test_the_intensity_closes_the_jaws_on_the_object(library: ActionLibrary) -> None:
    plans = plan_grasps(library.hand, library, read_object("box:0.06x0.08x0.08")).plans
    plan = next(plan for plan in plans if plan.action == "PinchTight")
    assert plan.touch == pytest.approx((0.1 - plan.width) / 0.1, abs=0.01)
    assert plan.touch < plan.intensity <= 1.0
    assert plan.preshape < plan.touch
    assert plan.opening >= plan.width + 0.01


def test_jaws_carry_what_friction_and_their_force_allow(library: ActionLibrary) -> None:
    # 40 N drive both jaws, so each presses with 20: 2 * 0.5 * 20 N of friction, 0.5 kg * 9.81.
    obj = read_object("box:0.03x0.06x0.06", mass=0.5)
    plan = plan_grasps(library.hand, library, obj, friction=0.5).plans[0]
    assert plan.load == pytest.approx(20.0 / (0.5 * 9.81), rel=0.12)
    less = plan_grasps(library.hand, library, obj, friction=0.25).plans[0]
    assert less.load == pytest.approx(plan.load / 2.0, rel=0.12)


def test_a_weight_along_the_jaws_way_presses_on_one_of_them(library: ActionLibrary) -> None:
    obj = read_object("box:0.03x0.06x0.06", mass=0.5)
    plan = plan_grasps(library.hand, library, obj, weight_axis=(1.0, 0.0, 0.0)).plans[0]
    assert plan.load == pytest.approx(40.0 / (0.5 * 9.81), rel=0.12)


def test_on_a_table_the_hand_stays_above_it_and_the_weight_pulls_to_it(
    library: ActionLibrary,
) -> None:
    obj = read_object("box:0.03x0.06x0.02", mass=0.5)
    plan = plan_grasps(library.hand, library, obj, table=Table((0.0, 0.0, 2.0))).plans[0]
    assert plan.table is not None
    top = _pose(plan.pose) @ _pose(plan.table)
    assert (_pose(plan.table) @ [0.0, 0.0, 0.0, 1.0])[2] == pytest.approx(-0.01)
    # The jaws' ends are 60 mm before the palm, and 10 mm to either side of it.
    ends = np.array([[x, y, 0.06] for x in (-0.06, 0.06) for y in (-0.01, 0.01)])
    assert ((ends - top[:3, 3]) @ top[:3, 2]).min() > 0.004
    assert plan.load == pytest.approx(20.0 / (0.5 * 9.81), rel=0.12)
    assert plan.overhang == 0.0


def _jaws_beside_a_box(folder: Path, **closed: float) -> tuple[HandClosing, FloatArray]:
    """Return two jaws with a motor each that close to positions [m], and the pose of a box.

    The box is 10 mm beside the middle: the right jaw touches it 20 mm before the left one.
    """
    file = folder / "jaws.urdf"
    file.write_text(JAWS.replace('<mimic joint="jaw"/>', ""))
    hand = load_model(file)
    posture = full_posture(hand, closed)
    action = Primitive(PrimitiveKind.PINCH_TIGHT, ("left", "right"), (posture,))
    scene = GraspScene(hand, read_object("box:0.04x0.02x0.02"))
    beside = np.eye(4)
    beside[:3, 3] = 0.01, 0.0, 0.045
    return HandClosing(scene, ActionPath.of(hand, action), 0.5), beside


def test_fingers_that_wait_for_one_another_leave_an_object_where_it_is(tmp_path: Path) -> None:
    closing, beside = _jaws_beside_a_box(tmp_path, jaw=0.05, follower=0.05)
    pushed, waited = closing.close(beside, 0), closing.waiting.close(beside, 0)
    assert pushed is not None
    assert waited is not None
    assert pushed.pose[0, 3] == pytest.approx(0.0, abs=2e-3)
    assert waited.pose[0, 3] == beside[0, 3]
    shares = dict(zip(closing.path.hand.actuator_names, waited.shares.tolist(), strict=True))
    assert shares["jaw"] == pytest.approx(0.8, abs=0.03)
    assert shares["follower"] == pytest.approx(0.4, abs=0.03)


def test_a_side_that_does_not_come_leaves_the_other_waiting(tmp_path: Path) -> None:
    # The left jaw stays 25 mm from the middle, the object's side 10 mm.
    closing, beside = _jaws_beside_a_box(tmp_path, jaw=0.025, follower=0.05)
    assert closing.close(beside, 0) is not None
    assert closing.waiting.close(beside, 0) is None


def test_sides_with_motors_of_their_own_press_with_a_force() -> None:
    fingers = grasp_plan(
        ROOT / "config/inspire_rh56", "box:0.04x0.04x0.06", table=Table((0.0, 0.0, 1.0))
    )
    first = fingers.plans[0]
    assert first.force is not None
    # More than the weight takes, and no more than leaves something to keep the posture.
    assert 2.0 * 0.1 * 9.81 < first.force < 9.0
    assert first.held_pose == first.pose
    assert {"thumb"} < set(first.fingers)
    jaws = grasp_plan(
        ROOT / "config/robotiq_2f_85", "box:0.04x0.04x0.06", table=Table((0.0, 0.0, 1.0))
    )
    assert all(plan.force is None for plan in jaws.plans)


def test_what_is_too_heavy_says_so(library: ActionLibrary) -> None:
    plan = plan_grasps(library.hand, library, read_object("box:0.03x0.06x0.06", mass=10.0)).plans[0]
    assert plan.load < 1.0
    assert any("can't carry the weight" in reason for reason in plan.reasons)
    assert plan.effort == 1.0


def test_an_action_that_stays_too_open_is_rejected(library: ActionLibrary) -> None:
    ranking = plan_grasps(library.hand, library, read_object("sphere:0.015"))
    assert [plan.action for plan in ranking.plans] == ["PinchTight"]
    assert dict(ranking.rejected)["Half"] == "its fingers do not oppose each other on the object"


def test_an_object_that_is_too_wide_does_not_fit(library: ActionLibrary) -> None:
    with pytest.raises(ConfigError, match=r"does not fit: width 140 mm, the hand opens to 100 mm"):
        plan_grasps(library.hand, library, read_object("box:0.14x0.15x0.16"))


@pytest.mark.parametrize(
    ("left_out", "said"),
    [
        ('<joint name="follower".*</link>', "the hand has only one fingertip, that of 'left', and"),
        ('<collision><origin xyz="-?0.005.*?</collision>', "the hand has no fingertip, and"),
    ],
)
def test_a_finger_that_is_alone_has_no_opening(tmp_path: Path, left_out: str, said: str) -> None:
    """It was said to open to 0 mm, as if another object might fit."""
    (tmp_path / "jaw.urdf").write_text(re.sub(f"(?s){left_out}", "", JAWS))
    hand = load_model(tmp_path / "jaw.urdf")
    library = ActionLibrary(hand, (generic(hand, "Close", {"jaw": 0.05}),))
    thing = read_object("sphere:0.02")
    with pytest.raises(ConfigError, match=f"'sphere:0.02' does not fit: .*{said}") as refused:
        plan_grasps(hand, library, thing)
    tried = misfit(library, library.find("Close"), thing, variations=1)
    assert str(refused.value).endswith(tried)
    assert said in tried
    assert " mm" not in tried


def test_a_mesh_is_planned_for_as_the_shape_it_has(library: ActionLibrary, tmp_path: Path) -> None:
    mesh = _stl(tmp_path / "block.stl", box((0.04, 0.02, 0.03)))
    ranked = plan_grasps(library.hand, library, read_object("box:0.04x0.02x0.03"))
    meshed = plan_grasps(library.hand, library, read_object(str(mesh)))
    assert [p.label for p in meshed.plans] == [p.label for p in ranked.plans]
    for one, other in zip(ranked.plans, meshed.plans, strict=True):
        assert other.score == pytest.approx(one.score, abs=0.02)
        assert other.touch == pytest.approx(one.touch, abs=0.02)
        assert _pose(other.pose) == pytest.approx(_pose(one.pose), abs=1e-3)


def test_an_open_mesh_is_told(library: ActionLibrary, tmp_path: Path) -> None:
    corners, faces = box((0.04, 0.02, 0.03))
    closed, one_less, lidless = (
        plan_grasps(
            library.hand, library, read_object(str(_stl(tmp_path / f"{n}.stl", (corners, part))))
        )
        for n, part in enumerate((faces, faces[1:], faces[2:]))
    )
    assert closed.notes == ()
    for ranking, edges in ((one_less, 3), (lidless, 4)):
        (note,) = to_document(ranking)["notes"]
        assert note.startswith(f"the mesh is open, {edges} of its edges have only one face; ")
        assert [p.label for p in ranking.plans] == [p.label for p in closed.plans]


TRIANGLE = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.05, 0.0]]), np.array([[0, 1, 2]])
SQUARE = np.array([*TRIANGLE[0], [0.05, 0.05, 0.0]]), np.array([[0, 1, 2], [1, 3, 2]])
SHEET = box((0.05, 0.05, 5e-5))


@pytest.mark.parametrize(
    ("solids", "said", "plane"),
    [
        ([TRIANGLE], "the mesh is flat", True),
        ([SQUARE], "the mesh is flat", True),
        ([SHEET], "the mesh is flat", False),
        ([TRIANGLE, box((0.04, 0.02, 0.03))], "1 of 2 parts of the mesh are flat", False),
    ],
)
def test_what_is_flat_is_no_object_for_planner_and_simulation(
    tmp_path: Path, solids: list[Triangles], said: str, plane: bool
) -> None:
    pytest.importorskip("mujoco", reason="needs the extra sim")
    from rtee.drivers.mujoco.objects import solid_parts

    mesh = _stl(tmp_path / "flat.stl", *solids)
    said = rf"flat\.stl: {said}; only what is at least 0\.0001 m"
    with pytest.raises(ModelError, match=said):
        read_object(str(mesh))
    if plane:  # MuJoCo itself refuses it
        assert solid_parts(str(mesh)) == ()
    else:
        with pytest.raises(ModelError, match=said):
            solid_parts(str(mesh))


@pytest.mark.parametrize("origin", [0.5, -0.5, 2.0])
def test_a_mesh_may_have_its_origin_anywhere(
    library: ActionLibrary, tmp_path: Path, origin: float
) -> None:
    vertices, faces = box((0.04, 0.02, 0.03))
    here = _stl(tmp_path / "here.stl", (vertices, faces))
    away = _stl(tmp_path / "away.stl", (vertices + origin, faces))
    near, far = (plan_grasps(library.hand, library, read_object(str(m))) for m in (here, away))
    assert [p.label for p in far.plans] == [p.label for p in near.plans]
    middle = np.append(np.full(3, origin), 1.0)
    for one, other in zip(near.plans, far.plans, strict=True):
        assert other.score == pytest.approx(one.score, abs=0.01)
        assert (_pose(other.pose) @ middle)[:3] == pytest.approx(_pose(one.pose)[:3, 3], abs=1e-3)


def test_a_mesh_of_a_hand_like_svh_ranks_as_its_primitive(tmp_path: Path) -> None:
    mesh = _stl(tmp_path / "rod.stl", cylinder(0.03, 0.12))
    ranked = grasp_plan(ROOT / "config/robotiq_3f", "cylinder:0.03x0.12")
    meshed = grasp_plan(ROOT / "config/robotiq_3f", str(mesh))
    assert meshed.plans[0].action == ranked.plans[0].action
    assert meshed.plans[0].width == pytest.approx(ranked.plans[0].width, abs=1e-3)


def test_the_ranking_is_the_same_every_time() -> None:
    first, second = (grasp_plan(ROOT / "config/robotiq_2f_85", "sphere:0.02") for _ in range(2))
    assert first == second
    assert [p.score for p in first.plans] == sorted((p.score for p in first.plans), reverse=True)


def test_a_ranking_survives_json() -> None:
    ranking = grasp_plan(ROOT / "config/robotiq_2f_85", "capsule:0.02x0.1")
    assert from_document(json.loads(json.dumps(to_document(ranking)))) == ranking


@pytest.mark.parametrize(
    ("text", "turns"),
    [
        ("sphere:0.03", 1),
        ("box:0.02x0.02x0.02", 1),
        ("box:0.02x0.02x0.05", 3),
        ("box:0.02x0.03x0.05", 6),
        ("cylinder:0.02x0.1", 3),
        ("capsule:0.02x0.1", 3),
    ],
)
def test_turns_that_look_the_same_are_one(text: str, turns: int) -> None:
    assert len(orientations(read_object(text))) == turns


def test_measures_of_an_object() -> None:
    obj = read_object("capsule:0.01x0.06")
    assert obj.extents == pytest.approx((0.02, 0.02, 0.06))
    assert obj.length == pytest.approx(0.03)
    assert obj.centre == pytest.approx(np.zeros(3))


def test_loose_parts_of_a_mesh_are_convex_pieces(tmp_path: Path) -> None:
    vertices, faces = box((0.02, 0.02, 0.02))
    aside = vertices + np.array([0.1, 0.0, 0.0])
    mesh = _stl(tmp_path / "two.stl", (vertices, faces), (aside, faces))
    obj = read_object(str(mesh))
    assert len(obj.pieces) == 2
    assert obj.centre == pytest.approx([0.05, 0.0, 0.0], abs=1e-6)
    assert not obj.notes


def test_a_mesh_that_lies_askew_has_a_box_of_its_own(tmp_path: Path) -> None:
    vertices, faces = box((0.02, 0.03, 0.1))
    turn = np.linalg.qr(np.array([[1.0, 2.0, 0.5], [-1.0, 0.3, 2.0], [0.4, -1.5, 1.0]]))[0]
    mesh = _stl(tmp_path / "askew.stl", (vertices @ turn.T, faces))
    assert read_object(str(mesh)).extents == pytest.approx((0.02, 0.03, 0.1), abs=1e-4)


def test_a_composed_action_is_made_where_no_single_one_is_good() -> None:
    hand = load_hand(ROOT / "config/leap_hand")
    library = ActionLibrary.load(hand, ROOT / "config/leap_hand/actions")
    trigs = ActionLibrary(hand, [a for a in library.all("primitive") if a.name == "Trig"])
    obj = read_object("cylinder:0.025x0.12")
    plan = plan_grasps(hand, trigs, obj).plans[0]
    assert not plan.action
    assert len(plan.parts) > 1
    assert {part.action for part in plan.parts} == {"Trig"}
    assert all(0.0 < part.scale <= 1.0 for part in plan.parts)
    singles = plan_grasps(hand, trigs, obj, compose=False).plans
    assert all(plan.score > single.score for single in singles)
    action = action_of(trigs, "Rod", plan, "A rod.")
    assert action.description == "A rod."
    assert {use.action for use in action.uses} == {"Trig"}


def test_a_saved_action_goes_as_far_as_planned(library: ActionLibrary) -> None:
    plan = plan_grasps(library.hand, library, read_object("sphere:0.015")).plans[0]
    plan = dataclasses.replace(plan, intensity=0.8)
    action = action_of(library, "Ball", plan, "")
    assert action.parts == (ActionReference("PinchTight", ("left", "right"), 0.8),)
    assert action.posture.position["jaw"] == pytest.approx(0.04)


@pytest.mark.parametrize("text", OBJECTS)
def test_every_standard_object_is_known_to_planner_and_simulation(text: str) -> None:
    assert read_object(text).name == parse_object(text, ()).name == text


def test_a_drill_is_planned_for_as_a_handle_with_a_motor_above_it(library: ActionLibrary) -> None:
    obj = read_object("drill", mass=0.4)
    assert len(obj.pieces) == 3
    # The motor is 140 mm long and 50 mm wide; with the handle below it, the drill is 180 mm high.
    assert obj.extents == pytest.approx((0.05, 0.14, 0.18), abs=1e-3)
    assert plan_grasps(library.hand, library, obj).plans


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sphere", "'sphere' is not an object"),
        ("cone:0.1x0.2", "'cone:0.1x0.2' is not an object"),
        ("sphere:-0.03", "is not an object"),
        ("sphere:nan", "is not an object"),
        ("sphere:inf", "is not an object"),
        ("box:0.1x0.1", "is not an object"),
        ("capsule:0.05x0.02", "at least its diameter"),
        ("missing.stl", "no such mesh"),
        ("missing.step", "is not an object"),
    ],
)
def test_what_is_no_object_is_refused(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        read_object(text)


@pytest.mark.parametrize("mass", [0.0, -1.0, float("nan"), float("inf"), 1e3])
def test_masses_that_make_no_sense_are_refused(mass: float) -> None:
    with pytest.raises(ConfigError, match="mass"):
        read_object("sphere:0.03", mass=mass)


@pytest.mark.parametrize("friction", [0.0, -0.5, float("nan"), 11.0])
def test_frictions_that_make_no_sense_are_refused(library: ActionLibrary, friction: float) -> None:
    with pytest.raises(ConfigError, match="friction"):
        plan_grasps(library.hand, library, read_object("sphere:0.03"), friction=friction)


@pytest.mark.parametrize("axis", [(0, 0, 0), (1, 2), (float("nan"), 0, 1)])
def test_weight_axes_that_make_no_sense_are_refused(
    library: ActionLibrary, axis: tuple[float, ...]
) -> None:
    with pytest.raises(ConfigError, match="weight axis"):
        plan_grasps(library.hand, library, read_object("sphere:0.03"), weight_axis=axis)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("a.stl", b"", "the file is empty"),
        ("a.stl", b"nothing", "not an STL file"),
        ("a.stl", bytes(80) + (9).to_bytes(4, "little") + bytes(50), "truncated"),
        ("a.off", b"nothing", "cannot be read"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "cannot be read"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "vertex index out of range"),
        ("a.ply", b"ply\nformat ascii 1.0\nend_header\n", "Unable to extract mesh data$"),
    ],
)
def test_files_that_are_no_mesh_are_refused(
    tmp_path: Path, name: str, data: bytes, said: str
) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ModelError, match=said) as caught:
        read_object(str(tmp_path / name))
    assert "\n" not in str(caught.value)


def test_a_mesh_in_millimetres_is_noticed(tmp_path: Path) -> None:
    mesh = _stl(tmp_path / "block.stl", box((40.0, 20.0, 30.0)))
    with pytest.raises(ModelError, match=r"in millimetres\? .* --scale 0.001"):
        read_object(str(mesh))
    assert read_object(str(mesh), scale=0.001).extents == pytest.approx((0.02, 0.03, 0.04))
    with pytest.raises(ModelError, match=r"--scale brings it to metres, and 1e-06 is too small"):
        read_object(str(mesh), scale=1e-6)


def test_a_hand_without_actions_is_told_what_to_do(jaws: Hand) -> None:
    with pytest.raises(UserError, match="rtee extract jaws --save"):
        plan_grasps(jaws, ActionLibrary(jaws), read_object("sphere:0.02"))


def test_a_jaw_of_the_body_and_a_claw_hold_a_ball() -> None:
    # The body is the fixed jaw's tip link; several shapes of the claw push at the same time.
    ranking = grasp_plan(ROOT / "config/dagana", "sphere:0.018")
    best = ranking.plans[0]
    assert {contact.finger for contact in best.contacts} == {"", "finger_2"}
    assert best.opening > 0.05
    assert best.load > 3.0


def test_a_plan_for_the_arms_flange(jaws: Hand, library: ActionLibrary) -> None:
    ball = read_object("sphere:0.015")
    plan = plan_grasps(jaws, library, ball).plans[0]
    assert (plan.flange_pose, plan.pre_flange_pose, plan.tcp) == (None, None, None)
    flange = FlangeSection("tool0", (0.0, 0.0, 0.02), (0.0, 0.0, math.pi / 2))
    mounted = dataclasses.replace(jaws, flange=flange)
    ranking = plan_grasps(mounted, ActionLibrary(mounted, list(library)), ball)
    first = ranking.plans[0]
    assert (ranking.flange, first.label) == ("tool0", plan.label)
    # The object as seen from the hand is the object as seen from the flange, and back.
    base_in_flange = origin(flange.xyz, flange.rpy)
    flange_in_object = np.array(first.flange_pose)
    object_in_base = np.array(first.pose)
    assert flange_in_object @ base_in_flange @ object_in_base == pytest.approx(np.eye(4), abs=1e-5)
    away = np.linalg.inv(np.array(first.pre_flange_pose) @ base_in_flange)[:3, 3]
    assert away - object_in_base[:3, 3] == pytest.approx(np.array(first.approach_from), abs=1e-5)
    middle = np.mean([contact.point for contact in first.contacts], axis=0)
    turned = [-middle[1], middle[0], middle[2] + 0.02]
    assert first.tcp == pytest.approx(turned, abs=1e-4)
    assert from_document(json.loads(json.dumps(to_document(ranking)))) == ranking


def test_a_pinch_comes_before_a_finger_alone(jaws: Hand, library: ActionLibrary) -> None:
    pinch = plan_grasps(jaws, library, read_object("sphere:0.015")).plans[0]
    alone = dataclasses.replace(pinch, action="Trig", score=pinch.score + 0.01)
    better = dataclasses.replace(alone, score=pinch.score + 0.1)
    assert sorted([alone, better, pinch], key=rank) == [better, pinch, alone]


@pytest.mark.heavy
@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="needs Linux's scheduler")
def test_planning_runs_as_an_ordinary_program(library: ActionLibrary) -> None:
    seen: list[tuple[int, int, set[int]]] = []

    def look(process: subprocess.Popen[str]) -> None:
        nice = os.getpriority(os.PRIO_PROCESS, process.pid)
        cpus = os.sched_getaffinity(process.pid)
        seen.append((os.sched_getscheduler(process.pid), nice, cpus))
        # On a busy computer, such a program may wait for longer than the answer is waited for.
        process.kill()

    def plan() -> None:
        # As a loop's thread: on one CPU, with real-time priority where that is allowed.
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setaffinity(0, {min(all_cpus)})
        with pytest.raises(RequestRejected, match="exit status -9"):
            ask(ROOT / "config/robotiq_2f_85", Question("sphere:0.02"), look)

    all_cpus = os.sched_getaffinity(0)
    thread = threading.Thread(target=plan)
    thread.start()
    thread.join()
    [(policy, nice, cpus)] = seen
    assert policy == os.SCHED_OTHER
    assert nice >= 10
    assert cpus >= all_cpus


@pytest.mark.parametrize("text", ["", "1,2", "0,0,0", "0,0,inf", "0,0,1,2,3", "up"])
def test_what_is_no_table_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="a table"):
        parse_table(text)
