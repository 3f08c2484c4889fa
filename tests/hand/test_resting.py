from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from hand.conftest import MODELS
from hand.models import FRANKA, GRIPPER, SRDF, anthropomorphic
from hand.robots import JAW, PALM, Robot
from rtee.actions.action_files import read_actions
from rtee.actions.resting import pinch_at_rest
from rtee.actions.types import Evidence, Posture, Primitive, PrimitiveKind
from rtee.extract.extraction import extract
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand
from rtee.hand.resting import closed_rest_of

Load = Callable[..., Hand]

SIDE_BY_SIDE = """<robot name="fork">
  <link name="palm"><collision><geometry><box size="0.1 0.1 0.02"/></geometry></collision></link>
  {}
</robot>"""
PRONG = """
  <link name="{name}"><collision>
    <origin xyz="0 0 0.04"/><geometry><box size="0.02 0.02 0.08"/></geometry>
  </collision></link>
  <joint name="{name}_bend" type="revolute">
    <parent link="palm"/><child link="{name}"/><origin xyz="{x} 0 0.02"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1.5" velocity="2" effort="5"/>
  </joint>"""


@pytest.mark.parametrize(
    ("urdf", "gap"),
    [(FRANKA, 0.0), (FRANKA.replace("0.0105 ", "0.011 ").replace("0.0068 ", "0.0073 "), 0.001)],
    ids=["touching", "nearly touching"],
)
def test_a_gripper_whose_zero_is_closed_rests_in_a_pinch(load: Load, urdf: str, gap: float) -> None:
    closed = closed_rest_of(load(urdf, None))
    assert closed is not None
    assert closed.line == "rest: {panda_finger_joint1: 0.04}"
    assert closed.gap == pytest.approx(gap, abs=1e-9)
    assert closed.opening == pytest.approx(0.08 + gap, abs=1e-6)
    assert closed.line in closed.text
    assert closed_rest_of(load(urdf, None, rest=closed.opened)) is None


def test_the_wsg_50_rests_in_a_pinch(shared: Path) -> None:
    folder = shared / "more_hands" / "wsg50"
    closed = closed_rest_of(load_model(folder / "wsg50.urdf", folder / "wsg50.srdf"))
    assert closed is not None
    left, right = "base_joint_gripper_left", "base_joint_gripper_right"
    assert closed.opened == {left: -0.055, right: 0.055}


def test_a_claw_rests_at_its_widest(shared: Path) -> None:
    """At zero it is nearly closed, but no pinch: `rtee open` would not have opened it."""
    folder = shared / "field" / "04_single_jaw_arm"
    jaws = load_model(folder / "two_jaws.urdf", folder / "two_jaws.srdf")
    assert closed_rest_of(jaws) is None
    widest = closed_rest_of(jaws, narrow=True)
    assert widest is not None
    assert widest.opened["gripper"] > 1.5
    assert widest.opening > widest.gap + 0.003


def test_actuators_that_move_no_finger_leave_a_claw_its_widest(tmp_path: Path) -> None:
    """As those of the motor's slider and screw in the model of a PR2's gripper."""
    robot = Robot("claw").link("base", PALM)
    for side, x, master in (("left", -0.02, ""), ("right", 0.02, "left_joint -1")):
        robot.link(side, JAW)
        robot.joint(f"{side}_joint", "base", side, (x, 0, 0.01), (0, -1, 0), mimic=master)
    robot.link("slider").joint("slide", "base", "slider", (0, 0, -0.01), limits=(0.01, 0.1))
    closed = closed_rest_of(load_model(robot.write(tmp_path)), narrow=True)
    assert closed is not None
    assert closed.opened == {"left_joint": 0.9}


@pytest.mark.parametrize("coupled", [True, False], ids=["one motor", "two motors"])
def test_jaws_that_are_nearest_at_zero_rest_at_their_widest(coupled: bool, tmp_path: Path) -> None:
    """As base jaws without fingers: 20 mm apart at zero, which is not a pinch."""
    robot = Robot("base_jaws").link("base", PALM)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        robot.link(side, JAW)
        robot.joint(
            f"{side}_joint", "base", side, (sign * 0.016, 0, 0.01), (1, 0, 0),
            (-0.03, 0.0) if sign < 0 else (0.0, 0.03), kind="prismatic",
            mimic="left_joint -1" if coupled and sign > 0 else "",
        )  # fmt: skip
    closed = closed_rest_of(load_model(robot.write(tmp_path)), narrow=True)
    assert closed is not None
    assert closed.gap == pytest.approx(0.02)
    assert closed.opening == pytest.approx(0.08)
    assert closed.opened == {"left_joint": -0.03} | ({} if coupled else {"right_joint": 0.03})


@pytest.mark.parametrize("name", MODELS)
def test_other_hands_do_not(shared: Path, name: str) -> None:
    folder = shared / "hands" / name
    assert closed_rest_of(load_model(folder / f"{name}.urdf", folder / f"{name}.srdf")) is None


def test_the_shipped_hands_do_not(repository: Path) -> None:
    for file in (repository / "config").glob("*/hand.yaml"):
        hand = load_hand(file.parent)
        assert closed_rest_of(hand) is None
        assert pinch_at_rest(hand, stored(file.parent, hand)) == "", hand.name


def stored(folder: Path, hand: Hand) -> list[Primitive]:
    return [a for a in read_actions(hand, folder / "actions") if isinstance(a, Primitive)]


def test_fingers_that_touch_side_by_side_do_not(load: Load) -> None:
    prongs = (PRONG.format(name=n, x=x) for n, x in (("first", -0.01), ("second", 0.01)))
    assert closed_rest_of(load(SIDE_BY_SIDE.format("".join(prongs)), None)) is None
    assert closed_rest_of(load(anthropomorphic(), None)) is None


SPREAD = """
  <link name="{name}_knuckle"/>
  <joint name="{name}_spread" type="revolute">
    <parent link="palm"/><child link="{name}_knuckle"/><origin xyz="0 0 0.02"/>
    <axis xyz="0 0 {axis}"/><limit lower="0" upper="3.1" velocity="2" effort="5"/>{mimic}
  </joint>"""


def test_fingers_that_one_actuator_spreads_do_not(load: Load) -> None:
    """As a Barrett Hand's: they stand side by side, and the spread carries them farthest."""
    prongs = ""
    for name, x, axis, mimic in (
        ("first", -0.01, 1, ""),
        ("second", 0.01, -1, '<mimic joint="first_spread"/>'),
    ):
        prong = PRONG.format(name=name, x=x).replace('0.02"/><axis', '0"/><axis')
        prongs += SPREAD.format(name=name, axis=axis, mimic=mimic)
        prongs += prong.replace('link="palm"', f'link="{name}_knuckle"')
    hand = load(SIDE_BY_SIDE.format(prongs), None)
    assert hand.finger("first").own == ("first_bend",)
    assert closed_rest_of(hand) is None
    assert pinch_at_rest(hand, extract(hand).primitives) == ""


def test_fingers_side_by_side_are_told_from_a_pinch_without_geometry(load: Load) -> None:
    prongs = (PRONG.format(name=n, x=x) for n, x in (("first", -0.01), ("second", 0.01)))
    hand = load(SIDE_BY_SIDE.format("".join(prongs)), None)
    touching = Primitive(
        PrimitiveKind.PINCH_TIGHT,
        ("first", "second"),
        (Posture({"first_bend": 0.0, "second_bend": 0.0}, hand.actuator_names),),
        (Evidence(contact_at=0.0, point=(0.0, 0.0, 0.06), normal=(1.0, 0.0, 0.0)),),
    )
    assert pinch_at_rest(hand, [touching]) == ""
    across = replace(touching.evidence[0], normal=(0.0, 1.0, 0.0))
    assert pinch_at_rest(hand, [replace(touching, evidence=(across,))])


def test_of_several_actuators_only_those_that_part_the_tips_are_moved(load: Load) -> None:
    swing = """
      <link name="left_mount"/>
      <joint name="swing" type="revolute">
        <parent link="panda_hand"/><child link="left_mount"/><axis xyz="0 1 0"/>
        <limit lower="-0.1" upper="0.1" velocity="1" effort="1"/>
      </joint></robot>"""
    head, middle, tail = FRANKA.partition('<parent link="panda_hand"/>')
    urdf = (head + '<parent link="left_mount"/>' + tail).replace("</robot>", swing)
    assert middle
    closed = closed_rest_of(load(urdf, None, rest={"swing": 0.05}))
    assert closed is not None
    assert closed.line == "rest: {swing: 0.05, panda_finger_joint1: 0.04}"


def test_names_that_yaml_would_read_as_numbers_are_quoted(load: Load) -> None:
    closed = closed_rest_of(load(FRANKA.replace("panda_finger_joint1", "1"), None))
    assert closed is not None
    assert closed.line == 'rest: {"1": 0.04}'


def test_the_stored_primitives_tell_it_without_geometry(load: Load) -> None:
    hand = load(FRANKA, None)
    found = extract(hand)
    assert any("the rest posture is a pinch" in note for note in found.notes)
    said = pinch_at_rest(hand, found.primitives)
    assert "type into hand.yaml: rest: {panda_finger_joint1: 0.04}" in said
    opened = load(FRANKA, None, rest={"panda_finger_joint1": 0.04})
    # Also as long as nothing was extracted anew.
    assert pinch_at_rest(opened, found.primitives) == ""
    again = extract(opened)
    assert not [note for note in again.notes if "pinch" in note]
    assert pinch_at_rest(opened, again.primitives) == ""
    trig, pinch = (
        next(p for p in again.primitives if p.name == n)
        for n in ("SingleJointMultipleTips_2", "PinchTight")
    )
    assert trig.posture.position["panda_finger_joint1"] == 0.0
    assert pinch.evidence[0].contact_at == pytest.approx(1.0, abs=1e-3)


STATE = """<group_state name="open" group="fingers">
    <joint name="left" value="0.2"/><joint name="right" value="0.2"/>
  </group_state></robot>"""


@pytest.mark.parametrize(
    ("rest", "note"),
    [
        ({}, "the rest posture is the SRDF's group_state 'open'"),
        (
            {"left": 0.1},
            "the rest posture is the SRDF's group_state 'open', but for left, which the "
            "configuration sets",
        ),
        ({"left": 0.1, "right": 0.2}, None),
    ],
)
def test_the_note_says_whose_rest_it_is(
    load: Load, rest: dict[str, float], note: str | None
) -> None:
    hand = load(GRIPPER, SRDF.replace("</robot>", STATE), rest=rest)
    said = [text for text in hand.notes if "rest posture" in text]
    assert said == ([] if note is None else [note])
