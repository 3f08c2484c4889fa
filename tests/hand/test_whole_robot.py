"""Hands on arms, several hands in one file, whole robots: the hand alone is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hand.robots import ARM, JAW, PALM, Robot, arm, box, fingers, jaws, linkage
from rtee.errors import ConfigError, ModelError, UnknownLink
from rtee.extract.extraction import extract
from rtee.hand.config_schema import Outside
from rtee.hand.kinematics import Kinematics
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import JointRole
from rtee.hand.scaffold import make_hand
from rtee.hand.subtree import Subtree

FIVE = ("thumb", "index", "middle", "ring", "little")


def single_jaw(*, solid: bool = True, prefix: str = "") -> Robot:
    """Return an arm of five joints with a jaw that closes on its last link."""
    robot = Robot("so").link("base", box(0.1, 0.1, 0.05))
    last = arm(robot, "base", prefix)
    robot.link("jaw", *([JAW] if solid else []))
    return robot.joint("gripper", last, "jaw", (0.012, 0, 0.09), limits=(-0.17, 1.74))


def on_arm(joints: tuple[str, ...] = ARM) -> Robot:
    """Return a gripper of two jaws, with a palm of its own, on an arm."""
    robot = Robot("on_arm").link("base_link", box(0.1, 0.1, 0.05))
    last = arm(robot, "base_link", joints=joints)
    return jaws(robot, base="palm").weld(last, "palm", (0, 0, 0.11))


def two_hands(arms: tuple[str, ...] = ARM) -> Robot:
    robot = Robot("bimanual").link("torso", box(0.2, 0.4, 0.5))
    for side, y in (("left", 0.3), ("right", -0.3)):
        robot.link(f"{side}_mount").weld("torso", f"{side}_mount", (0, y, 0.2), (0.4, 0, 0))
        last = arm(robot, f"{side}_mount", f"{side}_", arms)
        fingers(robot, FIVE[:3], "palm", f"{side}_").weld(last, f"{side}_palm", (0, 0, 0.1))
    return robot


def humanoid() -> Robot:
    robot = two_hands()
    for side, y in (("left", 0.1), ("right", -0.1)):
        legs = tuple(
            f"{side}_{name}" for name in ("hip_y", "hip_r", "hip_p", "knee", "ank_p", "ank_r")
        )
        robot.link(f"{side}_hip").weld("torso", f"{side}_hip", (0, y, -0.3))
        arm(robot, f"{side}_hip", f"{side}_leg_", legs)
    robot.link("head", box(0.1, 0.1, 0.2)).joint("neck", "torso", "head", (0, 0, 0.4))
    return robot


def test_the_joints_of_an_arm_are_no_fingers(tmp_path: Path) -> None:
    hand = load_model(single_jaw().write(tmp_path))
    assert hand.actuator_names == ("gripper",)
    assert hand.fingers[0].links[0] == "arm_link_5"
    assert any("'shoulder_pan'" in n and "those of an arm" in n for n in hand.notes)
    assert all(
        hand.joints[hand.joint_index(name)].role is JointRole.IGNORED for name in ARM
    )  # fmt: skip
    names = {e for p in extract(hand, jobs=1).primitives for e in p.elements}
    assert not names & set(ARM)


def test_an_arm_without_names_is_known_by_its_joints(tmp_path: Path) -> None:
    text = single_jaw().text
    for number, name in enumerate(ARM, 1):
        text = text.replace(f'"{name}"', f'"{number}"')
    path = tmp_path / "so.urdf"
    path.write_text(text.replace("arm_link_", "part_"))
    assert load_model(path).actuator_names == ("gripper",)


def test_a_finger_of_three_joints_is_no_arm(tmp_path: Path) -> None:
    robot = Robot("finger").link("base", PALM)
    for number in range(3):
        above = f"p{number - 1}" if number else "base"
        robot.link(f"p{number}", JAW).joint(f"j{number}", above, f"p{number}", (0, 0, 0.05))
    assert load_model(robot.write(tmp_path)).actuator_names == ("j0", "j1", "j2")


def test_a_jaw_without_geometry_is_named(tmp_path: Path) -> None:
    hand = load_model(single_jaw(solid=False).write(tmp_path))
    assert hand.actuator_names == ("gripper",)
    assert hand.fingers == ()
    assert any("link 'jaw' moves, but it has no collision geometry" in n for n in hand.notes)


@pytest.mark.parametrize("seen", [False, True])
def test_a_shaft_that_jaws_follow_is_not_named_but_a_jaw_is(seen: bool, tmp_path: Path) -> None:
    robot = Robot("shaft").link("base", PALM)
    robot.link("shaft", inside=f"<visual>{JAW}</visual>" if seen else "")
    robot.joint("motor", "base", "shaft", axis=(0, 0, 1))
    for jaw, x in (("left", -0.03), ("right", 0.03)):
        turned = "motor" if x < 0 else "motor -1"
        robot.link(jaw, JAW).joint(f"{jaw}_jaw", "base", jaw, (x, 0, 0.05), mimic=turned)
    notes = load_model(robot.write(tmp_path)).notes
    # What is seen to move, and cannot touch, is a mistake of the file.
    assert any("link 'shaft' moves" in note for note in notes) == seen


def test_the_fixed_jaw_is_proposed_and_added_when_asked(tmp_path: Path) -> None:
    path = single_jaw().write(tmp_path)
    made = make_hand("told", path, into=tmp_path / "config")
    (note,) = (n for n in made.notes if "there is only one finger" in n)
    assert '<group name="fixed"><link name="arm_link_5"/></group>' in note
    made = make_hand("asked", path, into=tmp_path / "config", ask=lambda question, likely: True)
    assert made.hand.finger_names == ("jaw", "fixed")
    assert made.hand.actuator_names == ("gripper",)
    assert made.hand.finger("fixed").actuators == ()
    # The line of the note does the same.
    srdf = made.folder.parent / "told" / "told.srdf"
    text = srdf.read_text().replace(
        '<group name="end_effector_fingers">',
        '<group name="fixed"><link name="arm_link_5"/></group>'
        '<group name="end_effector_fingers"><group name="fixed"/>',
    )
    srdf.write_text(text)
    assert set(load_hand(srdf.parent).finger_names) == {"jaw", "fixed"}


@pytest.mark.parametrize("outside", list(Outside))
def test_the_hand_below_a_root_has_its_own_frame(tmp_path: Path, outside: Outside) -> None:
    alone = load_model(jaws(base="palm").write(tmp_path))
    path = on_arm().write(tmp_path)
    hand = load_model(path, edits=[Subtree("palm", outside)])
    assert hand.base == "palm"
    assert hand.actuator_names == alone.actuator_names
    assert (hand.joint_names, hand.fingers) == (alone.joint_names, alone.fingers)
    u = np.array([0.3, 0.5])
    for link in ("left_distal", "right_distal"):
        found, truth = (Kinematics(h).link_pose(link, u) for h in (hand, alone))
        assert found == pytest.approx(truth, abs=1e-12)
    assert ("base_link" in hand.urdf.links) == (outside is Outside.RIGID)
    if outside is Outside.RIGID:
        whole = Kinematics(load_model(path))
        at_palm = np.linalg.inv(whole.link_pose("palm", np.zeros(2)))
        for link in ("base_link", "arm_link_1", "arm_link_3"):
            truth = at_palm @ whole.link_pose(link, np.zeros(2))
            assert Kinematics(hand).link_pose(link, u) == pytest.approx(truth, abs=1e-12)
    primitives = [
        {(p.name, p.elements): [e.depth for e in p.evidence] for p in extract(h, jobs=1).primitives}
        for h in (alone, hand)
    ]
    assert primitives[0] == primitives[1]


def test_hand_yaml_may_say_the_root(tmp_path: Path) -> None:
    two_hands().write(tmp_path)
    yaml = tmp_path / "hand.yaml"
    yaml.write_text("name: right\nurdf: bimanual.urdf\nroot: right_palm\n")
    hand = load_hand(yaml)
    assert hand.base == "right_palm"
    assert hand.finger_names == ("thumb", "index", "middle")
    assert all(name.startswith("right_") for name in hand.actuator_names)
    assert "left_palm" not in hand.urdf.text
    yaml.write_text("name: right\nurdf: bimanual.urdf\nroot: right_plam\n")
    with pytest.raises(UnknownLink, match="did you mean 'right_palm'"):
        load_hand(yaml)
    yaml.write_text("name: right\nurdf: bimanual.urdf\noutside: rigid\n")
    with pytest.raises(ConfigError, match="needs 'root:'") as refused:
        load_hand(yaml)
    assert refused.value.line == 3


@pytest.mark.parametrize("robot", [two_hands(), two_hands(ARM[:3]), two_hands(()), humanoid()])
def test_several_hands_are_listed_with_what_to_type(robot: Robot, tmp_path: Path) -> None:
    path = robot.write(tmp_path)
    with pytest.raises(ModelError) as refused:
        make_hand("both", path, into=tmp_path / "config")
    message = str(refused.value)
    assert "2 hands" in message
    assert "--root left_palm (3 fingers) or --root right_palm (3 fingers)" in message
    assert not (tmp_path / "config" / "both").exists()
    for side in ("left", "right"):
        made = make_hand(side, path, into=tmp_path / "config", subtree=Subtree(f"{side}_palm"))
        assert made.hand.base == f"{side}_palm"
        assert made.hand.finger_names == ("thumb", "index", "middle")
        assert len(made.hand.actuators) == 6


def test_a_hand_on_a_cart_is_not_taken_together_with_its_wheels(tmp_path: Path) -> None:
    robot = on_arm()
    for k in range(4):
        robot.link(f"wheel_{k}", box(0.02, 0.1, 0.1))
        robot.joint(
            f"drive_{k}", "base_link", f"wheel_{k}", (0.1 * k, 0, 0), limits=None, kind="continuous"
        )
    with pytest.raises(ModelError, match=r"a hand and other parts; take a hand by --root palm"):
        make_hand("cart", robot.write(tmp_path), into=tmp_path / "config")


def test_legs_are_no_fingers(tmp_path: Path) -> None:
    robot = Robot("dog").link("trunk", box(0.4, 0.2, 0.1))
    for k in range(4):
        robot.link(f"hip_{k}").weld("trunk", f"hip_{k}", (0.1 * k, 0, 0))
        arm(robot, f"hip_{k}", f"leg_{k}_", tuple(f"j{i}" for i in range(6)))
    with pytest.raises(ModelError, match="no hand was found"):
        make_hand("dog", robot.write(tmp_path), into=tmp_path / "config")


@pytest.mark.parametrize("robot", [jaws(), linkage(), fingers(Robot("five"), FIVE), on_arm()])
def test_one_hand_is_taken_without_questions(robot: Robot, tmp_path: Path) -> None:
    made = make_hand("one", robot.write(tmp_path), into=tmp_path / "config")
    assert len(made.hand.fingers) >= 2
    assert not any(name in made.hand.actuator_names for name in ARM)


GRIPPER_GROUPS = {
    "links and joints": '<link name="palm"/><link name="left_distal"/><link name="right_distal"/>'
    '<joint name="left_joint"/><joint name="right_joint"/>',
    "links": '<link name="palm"/><link name="left_distal"/><link name="right_distal"/>',
    "tips": '<link name="left_distal"/><link name="right_distal"/>',
    "joints": '<joint name="left_joint"/><joint name="right_joint"/>',
    "chains": '<chain base_link="palm" tip_link="left_distal"/>'
    '<chain base_link="palm" tip_link="right_distal"/>',
}


@pytest.mark.samples("palm-tips", "None-chains", "palm-links and joints")
@pytest.mark.parametrize("inside", GRIPPER_GROUPS.values(), ids=GRIPPER_GROUPS.keys())
@pytest.mark.parametrize("root", [None, "palm"])
def test_the_group_of_the_end_effector_is_followed(
    tmp_path: Path, inside: str, root: str | None
) -> None:
    srdf = tmp_path / "moveit.srdf"
    srdf.write_text(
        '<robot name="on_arm"><group name="arm"><chain base_link="base_link" tip_link="palm"/>'
        f'</group><group name="gripper">{inside}</group>'
        '<group_state name="home" group="arm"><joint name="elbow_flex" value="0.4"/></group_state>'
        '<group_state name="open" group="gripper"><joint name="left_joint" value="0.1"/>'
        '</group_state><end_effector name="eef" parent_link="palm" group="gripper"/></robot>'
    )
    edits = [Subtree(root)] if root else []
    hand = load_model(on_arm().write(tmp_path), srdf, edits=edits)
    assert hand.actuator_names == ("left_joint", "right_joint")
    assert {finger.tip for finger in hand.fingers} == {"left_distal", "right_distal"}
    assert hand.rest.tolist() == [0.1, 0.0]
    made = make_hand(
        "m",
        tmp_path / "on_arm.urdf",
        srdf,
        into=tmp_path / "c",
        subtree=edits[0] if edits else None,
    )
    assert made.hand.actuator_names == hand.actuator_names
    assert made.hand.rest.tolist() == [0.1, 0.0]


def test_chains_that_carry_others_are_no_fingers(tmp_path: Path) -> None:
    srdf = tmp_path / "x.srdf"
    chains = {
        "arm": ("base_link", "palm"),
        "l": ("palm", "left_distal"),
        "r": ("palm", "right_distal"),
    }
    groups = "".join(
        f'<group name="{n}"><chain base_link="{a}" tip_link="{b}"/></group>'
        for n, (a, b) in chains.items()
    )
    srdf.write_text(f'<robot name="on_arm">{groups}</robot>')
    hand = load_model(on_arm().write(tmp_path), srdf)
    assert hand.finger_names == ("l", "r")
    assert hand.actuator_names == ("left_joint", "right_joint")


def test_a_joint_that_follows_one_outside_the_hand_is_refused(tmp_path: Path) -> None:
    text = on_arm().text
    followed = '<joint name="right_joint" type="revolute"><mimic joint="wrist_roll"/>'
    path = tmp_path / "r.urdf"
    path.write_text(text.replace('<joint name="right_joint" type="revolute">', followed))
    with pytest.raises(ModelError, match="'right_joint' follows 'wrist_roll', which is outside"):
        load_model(path, edits=[Subtree("palm")])


def test_a_wrist_that_the_user_keeps_stays_an_actuator(tmp_path: Path) -> None:
    robot = Robot("wristed").link("flange", PALM)
    jaws(robot, base="palm").joint("wrist", "flange", "palm", (0, 0, 0.05), (0, 0, 1), (-1, 1))
    path = robot.write(tmp_path)
    kept = make_hand(
        "kept", path, into=tmp_path, ask=lambda question, likely: "wrist" not in question
    )
    assert kept.hand.actuator_names == ("wrist", "left_joint", "right_joint")
    told = make_hand("told", path, into=tmp_path)
    assert told.hand.actuator_names == ("left_joint", "right_joint")
    assert any("--root palm takes the hand alone" in note for note in told.notes)


WSG = Robot("wsg").link("base", box(0.08, 0.06, 0.02))
for _side, _low, _high in (("left", -0.055, -0.005), ("right", 0.005, 0.055)):
    WSG.link(f"finger_{_side}", box(0.01, 0.02, 0.05, (0, 0, 0.03)))
    WSG.joint(
        f"j{_side}", "base", f"finger_{_side}", (0, 0, 0.01), (1, 0, 0), (_low, _high),
        kind="prismatic",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("robot", "element"),
    [
        (WSG, '<mimic joint="jleft" multiplier="-1"/>'),
        (jaws(), '<mimic joint="left_joint" multiplier="1"/>'),
    ],
)
def test_jaws_that_mirror_each_other_are_proposed_as_one_motor(
    robot: Robot, element: str, tmp_path: Path
) -> None:
    path = robot.write(tmp_path)
    made = make_hand("told", path, into=tmp_path)
    assert any(element in note and "--ask" in note for note in made.notes)
    assert len(made.hand.actuators) == 2
    made = make_hand("asked", path, into=tmp_path, ask=lambda question, likely: True)
    assert len(made.hand.actuators) == 1
    assert element in (made.folder / "asked.urdf").read_text()


def test_jaws_of_different_limits_are_two_motors(tmp_path: Path) -> None:
    text = jaws().text.replace('upper="0.9"', 'upper="0.8"', 1)
    path = tmp_path / "r.urdf"
    path.write_text(text)
    made = make_hand("told", path, into=tmp_path)
    assert not any("mirror each other" in note for note in made.notes)


def test_jaws_that_turn_without_end_have_no_middle_to_mirror_at(tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(jaws().text.replace('type="revolute"', 'type="continuous"'))
    made = make_hand("told", path, into=tmp_path)
    assert not any("mirror each other" in note for note in made.notes)


@pytest.mark.parametrize("kind", ["floating", "planar"])
@pytest.mark.parametrize("root", [None, "base"])
def test_a_joint_that_places_the_robot_in_the_world_stands_still(
    root: str | None, kind: str, tmp_path: Path
) -> None:
    robot = jaws(Robot("free").link("world")).joint("places", "world", "base", kind=kind)
    edits = [] if root is None else [Subtree(root)]
    hand = load_model(robot.write(tmp_path), edits=edits)
    assert hand.actuator_names == ("left_joint", "right_joint")
    assert [f"is {kind}" in note for note in hand.notes if "'places'" in note] == (
        [True] if root is None else []
    )


def test_other_joints_that_float_are_refused(tmp_path: Path) -> None:
    robot = jaws().link("ball", box(0.01, 0.01, 0.01)).joint("flies", "base", "ball")
    path = robot.write(tmp_path)
    path.write_text(path.read_text().replace('"flies" type="revolute"', '"flies" type="floating"'))
    with pytest.raises(ModelError, match="joint 'flies' has the type 'floating'"):
        load_model(path)
