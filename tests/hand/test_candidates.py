from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from hand.models import FRANKA, GRIPPER, anthropomorphic
from rtee.hand.candidates import carriers, in_words, passive_candidates
from rtee.hand.load import load_model
from rtee.hand.model import Hand

Load = Callable[..., Hand]

KINOVA = """<robot name="kinova">
  <link name="palm"><collision><geometry><box size="0.1 0.1 0.02"/></geometry></collision></link>
  {}
</robot>"""
KINOVA_FINGER = """
  <link name="finger_{i}"><collision>
    <origin xyz="0 0 0.02"/><geometry><box size="0.01 0.02 0.04"/></geometry>
  </collision></link>
  <link name="finger_tip_{i}"><collision>
    <origin xyz="0 0 0.02"/><geometry><box size="0.01 0.02 0.04"/></geometry>
  </collision></link>
  <joint name="joint_finger_{i}" type="revolute">
    <parent link="palm"/><child link="finger_{i}"/><origin xyz="{x} {y} 0.01"/>
    <axis xyz="0 {axis} 0"/><limit lower="0" upper="1.51" velocity="1" effort="2"/>
  </joint>
  <joint name="joint_finger_tip_{i}" type="revolute">
    <parent link="finger_{i}"/><child link="finger_tip_{i}"/><origin xyz="0 0 0.044"/>
    <axis xyz="0 {axis} 0"/><limit lower="0" upper="2" velocity="1" effort="2"/>
  </joint>"""


def kinova() -> str:
    """Return a gripper in the style of Kinova's: of each finger the tip has no motor."""
    places = ((1, -0.04, -0.03, 1), (2, -0.04, 0.03, 1), (3, 0.04, 0.0, -1))
    return KINOVA.format(
        "".join(KINOVA_FINGER.format(i=i, x=x, y=y, axis=axis) for i, x, y, axis in places)
    )


def named(hand: Hand, *, likely: bool) -> set[str]:
    return {c.joint for c in passive_candidates(hand) if c.likely is likely}


@pytest.mark.parametrize("name", ["heri_II", "heri_II_linear"])
def test_the_springs_of_heri_ii_are_likely(shared: Path, name: str) -> None:
    folder = shared / "hands" / name
    hand = load_model(folder / f"{name}.urdf")
    known = load_model(folder / f"{name}.urdf", folder / f"{name}.srdf")
    passive = set(hand.actuator_names) - set(known.actuator_names)
    assert named(hand, likely=True) == passive
    assert named(hand, likely=False) == set()


def test_outer_joints_of_pairs_are_possible(load: Load) -> None:
    hand = load(kinova(), None)
    tips = {f"joint_finger_tip_{i}" for i in (1, 2, 3)}
    assert hand.finger_names == ("finger_1", "finger_2", "finger_3")
    assert named(hand, likely=False) == tips
    assert named(hand, likely=True) == set()
    words = in_words(passive_candidates(hand))
    assert len(words) == 3
    assert "'joint_finger_tip_1' may have no motor" in words[0]


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (
            "</robot>",
            '<gazebo reference="joint_finger_tip_2"><springStiffness>1</springStiffness></gazebo>'
            "</robot>",
            "has a spring for the simulator",
        ),
        ('upper="2" velocity="1" effort="2"', 'upper="2" velocity="1" effort="0"', "no effort"),
        (
            "</robot>",
            "".join(
                f'<transmission name="t{i}"><joint name="joint_finger_{i}"/></transmission>'
                for i in (1, 2, 3)
            )
            + "</robot>",
            "has no <transmission>, as others have",
        ),
    ],
)
def test_signs_of_a_missing_motor_are_told(load: Load, old: str, new: str, why: str) -> None:
    hand = load(kinova().replace(old, new), None)
    found = {c.joint: c.why for c in passive_candidates(hand) if c.likely}
    assert "joint_finger_tip_2" in found
    assert all("tip" in name for name in found)
    assert why in found["joint_finger_tip_2"]


def test_fingers_drawn_by_a_motor_elsewhere(load: Load) -> None:
    tendon = """
      <link name="spool"/>
      <joint name="motor" type="revolute"><parent link="palm"/><child link="spool"/>
        <axis xyz="0 1 0"/><limit lower="0" upper="2.5" velocity="1" effort="9"/></joint></robot>"""
    text = kinova().replace("</robot>", tendon)
    head, middle, tail = text.partition('<axis xyz="0 1 0"/><limit lower="0" upper="2" ')
    text = head + '<mimic joint="motor"/>' + middle + tail
    found = {c.joint: c.why for c in passive_candidates(load(text, None)) if c.likely}
    assert set(found) == {"joint_finger_1"}
    assert "follow 'motor', as by a tendon" in found["joint_finger_1"]


@pytest.mark.parametrize("text", [GRIPPER, FRANKA])
def test_other_hands_have_no_candidates(load: Load, text: str) -> None:
    assert passive_candidates(load(text, None)) == ()


def test_every_outer_one_of_parallel_joints_is_possible(load: Load) -> None:
    hand = load(anthropomorphic(), None)
    assert named(hand, likely=True) == set()
    # Joint 3 bends the finger at its base, behind the one that swings it sideways.
    outer = {f"rh_{finger}J{joint}" for finger in ("FF", "MF", "RF", "LF") for joint in (2, 1)}
    assert named(hand, likely=False) >= outer
    assert not named(hand, likely=False) & {"rh_FFJ4", "rh_FFJ3"}


@pytest.mark.parametrize("coupled", [False, True])
def test_the_joints_of_a_wrist_carry_all_fingers(load: Load, *, coupled: bool) -> None:
    assert carriers(load(anthropomorphic(coupled=coupled), None)) == ("rh_WRJ2", "rh_WRJ1")


def test_no_other_actuator_carries_all_fingers(shared: Path) -> None:
    for urdf in sorted((shared / "hands").glob("*/*.urdf")):
        assert carriers(load_model(urdf)) == (), urdf.stem


def test_what_moves_fingers_against_each_other_or_is_all_there_is_does_not(load: Load) -> None:
    assert carriers(load(FRANKA, None)) == ()
    turn = '<link name="flange"/><joint name="turn" type="revolute"><parent link="flange"/>'
    turn += (
        '<child link="panda_hand"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
    )
    hand = load(FRANKA.replace("</robot>", turn + "</robot>"), None)
    assert carriers(hand) == ("turn",)
    follower = '<mimic joint="turn"/>'
    text = FRANKA.replace("</robot>", turn + "</robot>")
    text = text.replace('<mimic joint="panda_finger_joint1"/>', follower)
    assert carriers(load(text, None)) == ()


def test_the_first_of_two_limits_counts_and_is_told(shared: Path) -> None:
    hand = load_model(shared / "more_hands" / "wsg50" / "wsg50.urdf")
    said = [note for note in hand.notes if "a second <limit> in <joint> is not read" in note]
    assert len(said) == 1
    assert "and 1 more" in said[0]
