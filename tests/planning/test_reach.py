"""Contacts, gripper poses and joint vectors of planners, reached by real hands."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Generic, Posture
from rtee.cli.openings import tool_centres
from rtee.errors import ConfigError
from rtee.extract.openings import opening_of
from rtee.hand.config_schema import FlangeSection
from rtee.hand.frames import origin
from rtee.hand.geometry import HandGeometry
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand
from rtee.planning.collisions import GraspCollisions
from rtee.planning.grasp_solution import Collision, WantedContact, from_document, to_document
from rtee.planning.gripper_poses import (
    GripperPose,
    from_base_poses,
    from_graspnet,
    grasp_frame,
    reach_gripper_pose,
)
from rtee.planning.joint_vectors import fit_joints
from rtee.planning.objects import read_object
from rtee.planning.reach import MARGIN, TOLERANCE, reach_contacts
from rtee.planning.tips import Fingertips
from rtee.types import from_rest

ROOT = Path(__file__).parents[2]
HANDS = ("schunk_svh", "robotiq_3f", "heri_ii", "leap_hand")
POSE = np.array([[0.0, -1.0, 0.0, 0.4], [1.0, 0.0, 0.0, -0.1], [0.0, 0.0, 1.0, 0.3], [0, 0, 0, 1]])


class Made:
    """A hand with what searches need."""

    def __init__(self, name: str) -> None:
        folder = ROOT / "config" / name
        self.hand = load_hand(folder)
        self.library = ActionLibrary.load(self.hand, folder / "actions")
        self.tips = Fingertips(self.hand)

    def contacts(self, seed: int) -> tuple[list[WantedContact], list[str]]:
        """Return contacts that a posture near one of the hand's actions makes, and the fingers."""
        rng, hand, tips = np.random.default_rng(seed), self.hand, self.tips
        actions = list(self.library)
        goal = np.array(hand.rest)
        for posture in actions[rng.integers(len(actions))].waypoints:
            for name in posture.involved:
                goal[hand.actuator_index(name)] = posture.position[name]
        u = from_rest(np.array(hand.rest), goal, rng.uniform(0.3, 0.9))
        u = u + 0.05 * rng.normal(size=u.size) * (np.array(hand.upper) - hand.lower)
        tips.go(np.clip(u, hand.lower, hand.upper))
        fingers = rng.permutation(tips.fingers)[: rng.integers(2, 4)].tolist()
        middle = tips.middle(fingers)
        found = []
        for finger in fingers:
            _, point, normal = tips.near(finger, middle)
            found.append(WantedContact(tuple(point), tuple(normal)))
        return found, fingers


@pytest.fixture(scope="module", params=HANDS)
def made(request: pytest.FixtureRequest) -> Made:
    return Made(request.param)


_JAW = """
  <joint name="{name}" type="prismatic">
    <parent link="base"/><child link="{name}_tip"/>
    <origin xyz="0 {y} 0"/><axis xyz="0 {way} 0"/>
    <limit lower="0" upper="0.04" velocity="0.1" effort="10"/>
  </joint>
  <link name="{name}_tip"><collision><geometry><box size="0.02 0.01 0.02"/></geometry></collision>
  </link>
"""


def around_its_base(folder: Path) -> Hand:
    """Return two jaws that meet at the origin of the base link."""
    jaws = _JAW.format(name="a", y=-0.05, way=1) + _JAW.format(name="b", y=0.05, way=-1)
    (folder / "jaws.urdf").write_text(f'<robot name="jaws"><link name="base"/>{jaws}</robot>')
    groups = "".join(
        f'<group name="{name}"><chain base_link="base" tip_link="{name}_tip"/></group>'
        for name in ("a", "b")
    )
    (folder / "jaws.srdf").write_text(f'<robot name="jaws">{groups}</robot>')
    return load_model(folder / "jaws.urdf", folder / "jaws.srdf", name="jaws")


def test_a_palm_in_the_middle_of_the_contacts_needs_an_approach(tmp_path: Path) -> None:
    hand = around_its_base(tmp_path)
    contacts = [
        WantedContact((0.0, -0.02, 0.0), (0.0, 1.0, 0.0)),
        WantedContact((0.0, 0.02, 0.0), (0.0, -1.0, 0.0)),
    ]
    with pytest.raises(ConfigError, match="give the direction of its approach"):
        reach_contacts(hand, (), contacts)
    reached = reach_contacts(hand, (), contacts, approach=(0.0, 0.0, 2.0))
    assert np.array(reached.pre_palm_pose)[:3, 3] == pytest.approx((0.0, 0.0, -0.1))


def test_tips_that_meet_at_the_base_take_no_pose_of_a_gripper(tmp_path: Path) -> None:
    hand = around_its_base(tmp_path)
    close = Generic("close", Posture({"a": 0.04, "b": 0.04}, ("a", "b")))
    opening = opening_of(HandGeometry(hand), close)
    assert opening is not None
    with pytest.raises(ConfigError, match="their direction of reach is not known"):
        reach_gripper_pose(hand, [(close, opening)], GripperPose(POSE, 0.03))


@pytest.fixture(scope="module")
def svh() -> Made:
    return Made("schunk_svh")


@pytest.fixture(scope="module")
def gripper() -> Made:
    return Made("robotiq_2f_85")


@pytest.mark.samples("robotiq_3f-0", "heri_ii-0", "leap_hand-0")
@pytest.mark.parametrize("seed", range(4))
def test_contacts_of_a_reachable_posture_are_reached(made: Made, seed: int) -> None:
    wanted, _ = made.contacts(seed)
    found = reach_contacts(made.hand, made.library, wanted, tips=made.tips)
    made.tips.go(_full(made, found.posture))
    for contact, residual in zip(wanted, found.residuals, strict=True):
        assert abs(residual.distance) <= TOLERANCE
        # Said of the posture, and not only by the search itself.
        assert abs(made.tips.near(residual.finger, np.array(contact.point))[0]) <= 2 * TOLERANCE
    made.tips.go(_full(made, found.pre_grasp))
    room = [
        made.tips.near(r.finger, np.array(c.point))[0]
        for r, c in zip(found.residuals, wanted, strict=True)
    ]
    rest = all(
        value == pytest.approx(made.hand.actuator(name).rest)
        for name, value in found.pre_grasp.items()
    )
    assert min(room) >= MARGIN - 1e-9 or rest
    lower, upper = np.array(made.hand.lower), np.array(made.hand.upper)
    u = _full(made, found.posture)
    assert np.all((u >= lower - 1e-9) & (u <= upper + 1e-9))


def _full(made: Made, posture: dict[str, float]) -> np.ndarray:
    u = np.array(made.hand.rest)
    for name, value in posture.items():
        u[made.hand.actuator_index(name)] = value
    return u


def test_named_fingers_are_kept_and_frames_carried_along(svh: Made) -> None:
    wanted, fingers = svh.contacts(1)
    named = [WantedContact(c.point, c.normal, f) for c, f in zip(wanted, fingers, strict=True)]
    here = reach_contacts(svh.hand, svh.library, named, tips=svh.tips)
    assert list(here.fingers) == fingers
    moved = [
        WantedContact(
            tuple(POSE[:3, :3] @ c.point + POSE[:3, 3]), tuple(POSE[:3, :3] @ c.normal), c.finger
        )
        for c in named
    ]
    there = reach_contacts(
        svh.hand, svh.library, moved, palm_pose=POSE, approach=(0, 0, -2), tips=svh.tips
    )
    assert there.posture == pytest.approx(here.posture, abs=1e-4)
    assert np.array(there.palm_pose) == pytest.approx(POSE)
    back = np.array(there.pre_palm_pose)[:3, 3] - POSE[:3, 3]
    assert back == pytest.approx([0.0, 0.0, 0.1])
    for a, b in zip(here.residuals, there.residuals, strict=True):
        assert POSE[:3, :3] @ a.point + POSE[:3, 3] == pytest.approx(np.array(b.point), abs=1e-3)


def test_points_alone_are_met_from_outside(svh: Made) -> None:
    wanted, _ = svh.contacts(2)
    points = [WantedContact(c.point) for c in wanted]
    found = reach_contacts(svh.hand, svh.library, points, tips=svh.tips)
    assert max(r.angle for r in found.residuals) < math.radians(60)


FAR = WantedContact((1.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("contacts", "options", "words"),
    [
        ([FAR], {}, "2 to 10 contacts, not 1"),
        ([FAR] * 11, {}, "2 to 10 contacts, not 11"),
        ([FAR, FAR], {}, "the contacts 1 and 2 are at the same place"),
        ([FAR, WantedContact((0.0, 0.0, math.nan))], {}, "three finite numbers"),
        ([FAR, WantedContact((0.0, 0.0, 0.1), (0.0, 0.0, 0.0))], {}, "normal must not be 0"),
        ([FAR, WantedContact((0.0, 0.0, 0.1), finger="nose")], {}, "unknown finger 'nose'"),
        ([WantedContact((0.1 * i, 0, 0.1), finger="thumb") for i in (0, 1)], {}, "two contacts"),
        ([WantedContact((0.05 * i, 0, 0.1)) for i in range(7)], {}, "7 contacts for 5 fingertips"),
        ([FAR, WantedContact((0.0, 0.0, 0.1))], {"tolerance": 0.0}, "tolerance must be above 0"),
        ([FAR, WantedContact((0.0, 0.0, 0.1))], {"approach": (0, 0, 0)}, "approach must be three"),
        ([FAR, WantedContact((0.0, 0.0, 0.1))], {"palm_pose": np.ones((4, 4))}, "not a rigid"),
        ([FAR, WantedContact((-1.0, 0.0, 0.0))], {}, r"cannot be reached: \w+ stays \d+ mm"),
    ],
)
def test_contacts_that_make_no_sense_are_refused(
    svh: Made, contacts: list[WantedContact], options: dict[str, object], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        reach_contacts(svh.hand, svh.library, contacts, tips=svh.tips, **options)  # type: ignore[arg-type]


# --- poses of grippers -----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["robotiq_2f_85", "robotiq_3f", "schunk_svh", "onrobot_3fg15"])
@pytest.mark.parametrize("width", [0.03, 0.05])
def test_the_hand_comes_to_where_the_gripper_is(name: str, width: float) -> None:
    made = Made(name)
    actions = made.library.openings.known(made.library)
    grasp = GripperPose(POSE, width)
    found = reach_gripper_pose(made.hand, actions, grasp, tips=made.tips)
    chosen = made.library.find(found.action, found.elements)
    opening = made.library.openings.of(chosen)
    assert opening.at(found.intensity) == pytest.approx(width, abs=1e-5)
    assert opening.at(found.pre_intensity) >= min(width + 0.0099, opening.widest - 1e-6)
    frame = grasp_frame(made.tips, chosen, opening, found.intensity)
    assert np.array(found.palm_pose) @ frame == pytest.approx(POSE, abs=1e-9)
    # The tips are on both sides of the middle along the closing axis, half the width away.
    made.tips.go(_full(made, found.posture))
    inverse = np.linalg.inv(frame)
    middle = frame[:3, 3]
    for side, sign in zip((opening.sides[0], sum(opening.sides[1:], ())), (1, -1), strict=True):
        near = np.mean([made.tips.near(f, middle)[1] for f in side], axis=0)
        along = (inverse[:3, :3] @ near + inverse[:3, 3])[1]
        assert sign * along > 0.2 * width
    back = np.array(found.pre_palm_pose)[:3, 3] - np.array(found.palm_pose)[:3, 3]
    assert back == pytest.approx(-0.1 * POSE[:3, 0])


def test_a_parallel_gripper_is_placed_to_a_tenth_of_a_millimetre(gripper: Made) -> None:
    actions = gripper.library.openings.known(gripper.library)
    found = reach_gripper_pose(
        gripper.hand, actions, GripperPose(np.eye(4), 0.04), tips=gripper.tips
    )
    gripper.tips.go(_full(gripper, found.posture))
    palm = np.array(found.palm_pose)
    for y in (0.02, -0.02):
        inside = np.linalg.inv(palm) @ np.array([-0.005, y, 0.0, 1.0])
        distances = [gripper.tips.near(f, inside[:3])[0] for f in gripper.tips.fingers]
        assert min(map(abs, distances)) < 1e-4


def test_what_is_reached_is_given_for_the_flange(gripper: Made) -> None:
    flange = FlangeSection("tool0", (0.0, 0.0, 0.02))
    hand = replace(gripper.hand, flange=flange)
    library = ActionLibrary(hand, list(gripper.library), gripper.library.folder)
    actions = library.openings.known(library)
    found = reach_gripper_pose(hand, actions, GripperPose(POSE, 0.04), tips=gripper.tips)
    for at, palm in (
        (found.flange_pose, found.palm_pose),
        (found.pre_flange_pose, found.pre_palm_pose),
    ):
        assert np.array(at) @ origin(flange.xyz, flange.rpy) == pytest.approx(np.array(palm))
    # Where the fingertips meet: at the end of a grasp of this width, where the gripper's are.
    table = library.openings.of(library.find("Grasp", ()))
    widest, narrowest = tool_centres(library, table)
    there = np.linalg.inv(np.array(found.flange_pose)) @ POSE[:, 3]
    assert widest[2] < there[2] < narrowest[2]


def graspnet(width: float = 0.04, depth: float = 0.02) -> list[float]:
    return [0.9, width, 0.02, depth, *POSE[:3, :3].ravel(), *POSE[:3, 3], 7]


def test_graspnet_arrays_are_read() -> None:
    (one,) = from_graspnet(graspnet())
    assert one.width == pytest.approx(0.04)
    assert one.score == pytest.approx(0.9)
    assert one.pose[:3, :3] == pytest.approx(POSE[:3, :3])
    assert one.pose[:3, 3] == pytest.approx(POSE[:3, 3] + 0.02 * POSE[:3, 0])
    assert len(from_graspnet(np.array([graspnet()] * 3, dtype=np.float32))) == 3


def test_base_poses_are_read() -> None:
    (one,) = from_base_poses(POSE, 0.05, depth=0.1034)
    assert one.pose[:3, 0] == pytest.approx(POSE[:3, 2])
    assert one.pose[:3, 1] == pytest.approx(POSE[:3, 0])
    assert np.linalg.det(one.pose[:3, :3]) == pytest.approx(1.0)
    assert one.pose[:3, 3] == pytest.approx(POSE[:3, 3] + 0.1034 * POSE[:3, 2])
    two = from_base_poses([POSE, POSE], [0.01, 0.02], depth=0.1, scores=[1.0, 0.5])
    assert [(g.width, g.score) for g in two] == [(0.01, 1.0), (0.02, 0.5)]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: from_graspnet(np.zeros(16)), "17 columns"),
        (lambda: from_graspnet([["a"] * 17]), "must consist of numbers"),
        (lambda: from_graspnet([math.nan] * 17), "finite numbers"),
        (lambda: from_graspnet([0.0] * 17), "grasp 0 is not a rigid transform"),
        (lambda: from_graspnet(graspnet(width=-1.0)), "width of grasp 0 must be 0 m or more"),
        (lambda: from_base_poses(np.eye(3), 0.1, depth=0.1), "4 by 4"),
        (lambda: from_base_poses(POSE, [0.1, 0.2], depth=0.1), "1 poses need 1 widths"),
        (lambda: from_base_poses(POSE, 0.1, depth=math.inf), "a depth must be a finite"),
        (lambda: from_base_poses(POSE, 0.1, depth=0.1, approach="x"), "two of x, y and z"),
    ],
)
def test_arrays_of_another_shape_are_refused(make: object, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make()  # type: ignore[operator]


def test_widths_beyond_the_hand_are_refused_with_the_nearest(gripper: Made) -> None:
    actions = gripper.library.openings.known(gripper.library)
    with pytest.raises(ConfigError, match=r"grasps 200\.0 mm; the nearest, .* opens .* to 8\d\.\d"):
        reach_gripper_pose(gripper.hand, actions, GripperPose(POSE, 0.2), tips=gripper.tips)
    with pytest.raises(ConfigError, match="unknown finger 'nose'"):
        reach_gripper_pose(gripper.hand, actions, GripperPose(POSE, 0.02), fingers=["nose"])


# --- joint vectors ---------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(share=st.lists(st.floats(0.0, 1.0), min_size=9, max_size=9))
def test_joint_vectors_are_fitted(share: list[float]) -> None:
    hand = _SVH
    lower, upper = np.array(hand.lower), np.array(hand.upper)
    u = lower + np.array(share) * (upper - lower)
    joints = dict(zip(hand.joint_names, hand.transmission.joints(u).tolist(), strict=True))
    found = fit_joints(hand, joints)
    assert list(found.posture.values()) == pytest.approx(u.tolist(), abs=1e-6)
    assert max(map(abs, found.residuals.values())) < 1e-6


_SVH = load_hand(ROOT / "config/schunk_svh")


def test_joints_that_disagree_leave_residuals() -> None:
    hand = load_hand(ROOT / "config/heri_ii")
    index = next(
        i for i in range(len(hand.actuators))
        if sum(hand.transmission.moves(r) == i for r in range(len(hand.joints))) > 1
    )  # fmt: skip
    rows = [r for r in range(len(hand.joints)) if hand.transmission.moves(r) == index]
    spec = hand.actuators[index]
    at = hand.transmission.joints(np.where(np.arange(len(hand.actuators)) == index, 0.5, 0.0))
    names = {f"their_{k}": hand.joint_names[row] for k, row in enumerate(rows)}
    values = {name: float(at[row]) + 0.1 * (-1) ** k
              for k, (name, row) in enumerate(zip(names, rows, strict=True))}  # fmt: skip
    found = fit_joints(hand, values, names)
    assert list(found.posture) == [spec.name]
    assert max(map(abs, found.residuals.values())) > 0.03


@pytest.mark.parametrize(
    ("joints", "words"),
    [({"elbow": 0.1}, "unknown joint 'elbow'"), ({"JOINT": math.nan}, "must be a number")],
)
def test_joint_vectors_that_make_no_sense_are_refused(joints: dict[str, float], words: str) -> None:
    hand = _SVH
    given_ = {hand.joint_names[0] if k == "JOINT" else k: v for k, v in joints.items()}
    with pytest.raises(ConfigError, match=words):
        fit_joints(hand, given_)


def test_links_that_meet_the_object_are_named(gripper: Made) -> None:
    actions = gripper.library.openings.known(gripper.library)
    grasp = GripperPose(POSE, 0.04)

    def met(obj: str, pose: np.ndarray) -> list[tuple[str, str, str]]:
        found = reach_gripper_pose(
            gripper.hand,
            actions,
            grasp,
            tips=gripper.tips,
            obj=read_object(obj),
            object_pose=pose,
        )
        return [(*each.links, each.posture) for each in found.collisions]

    assert met("box:0.03x0.04x0.08", POSE) == []
    # As long as this it reaches into the palm, as high into both fingers before they close.
    deep = met("box:0.4x0.02x0.02", POSE)
    assert {each[1] for each in deep} == {"object"}
    assert {each[2] for each in deep} == {"posture", "pre_grasp"}
    assert gripper.hand.base in {each[0] for each in deep}
    wide = met("box:0.02x0.1x0.02", POSE)
    assert len({each[0] for each in wide}) >= 2


def test_a_hand_that_meets_itself_is_told() -> None:
    made = Made("schunk_svh")
    collisions = GraspCollisions(made.hand, made.tips.geometry)
    assert collisions.at(np.array(made.hand.rest)) == ()
    # All fingers as far as they go, with the thumb across: the model's links are in each other.
    found = collisions.at(np.array(made.hand.upper), posture="pre_grasp")
    assert found
    assert all(c.depth >= 1e-3 and "before the grasp" in c.words for c in found)
    assert list(found) == sorted(found, key=lambda c: -c.depth)
    links = {link for c in found for link in c.links}
    assert links <= set(made.hand.urdf.links)


def test_a_reached_grasp_is_read_as_it_was_written(svh: Made) -> None:
    wanted, _ = svh.contacts(1)
    found = reach_contacts(svh.hand, svh.library, wanted, tips=svh.tips)
    both = replace(found, collisions=(Collision(("a", "object"), 0.002, "posture"),))
    assert from_document(json.loads(json.dumps(to_document(both)))) == both
    older = {k: v for k, v in to_document(found).items() if k != "collisions"}
    assert from_document(older).collisions == ()


def test_the_example_reads_every_kind_of_array(capsys: pytest.CaptureFixture[str]) -> None:
    import runpy

    example = runpy.run_path(str(ROOT / "examples/planner_grasps.py"))
    example["main"]("schunk_svh")
    said = capsys.readouterr().out
    for words in (
        "GraspNet, AnyGrasp: ",
        "Contact-GraspNet: ",
        "GraspGen: ",
        "index: ",
        "Joint vector: 2",
    ):
        assert words in said
