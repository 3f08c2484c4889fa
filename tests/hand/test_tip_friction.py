"""The friction of fingertips: from hand.yaml, else from the URDF, else not known."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtee.errors import ConfigError
from rtee.hand.load import load_hand
from rtee.hand.urdfread import read_urdf
from rtee.remote.hand_info import info_fields, info_of

LINK = (
    '<link name="{0}"><collision><geometry><sphere radius="0.01"/></geometry></collision>{1}</link>'
)
JOINT = (
    '<joint name="{0}" type="revolute"><parent link="palm"/><child link="{1}"/><axis xyz="0 1 0"/>'
    '<limit lower="0" upper="1" velocity="1" effort="1"/></joint>'
)
SRDF = (
    '<robot name="two"><group name="left"><chain base_link="palm" tip_link="left_tip"/></group>'
    '<group name="right"><chain base_link="palm" tip_link="right_tip"/></group></robot>'
)


def hand_folder(folder: Path, more: str = "", left: str = "", outside: str = "") -> Path:
    home = folder / "two"
    home.mkdir()
    links = LINK.format("palm", "") + LINK.format("left_tip", left) + LINK.format("right_tip", "")
    joints = JOINT.format("l", "left_tip") + JOINT.format("r", "right_tip")
    (home / "two.urdf").write_text(f'<robot name="two">{links}{joints}{outside}</robot>')
    (home / "two.srdf").write_text(SRDF)
    (home / "hand.yaml").write_text(f"name: two\nurdf: two.urdf\nsrdf: two.srdf\n{more}")
    return home


@pytest.mark.parametrize(
    ("left", "outside"),
    [
        ("", '<gazebo reference="left_tip"><mu1>0.7</mu1></gazebo>'),
        ("", '<gazebo reference="left_tip"><mu1 value="0.7"/></gazebo>'),
        ('<contact><lateral_friction value="0.7"/></contact>', ""),
    ],
)
def test_what_a_urdf_says_for_simulators_counts(tmp_path: Path, left: str, outside: str) -> None:
    hand = load_hand(hand_folder(tmp_path, left=left, outside=outside))
    assert hand.tip_friction == {"left": 0.7}


@pytest.mark.parametrize("text", ["", "rubber", "nan", "-1", "1e99"])
def test_what_makes_no_sense_there_is_not_known(tmp_path: Path, text: str) -> None:
    outside = f'<gazebo reference="left_tip"><mu1>{text}</mu1></gazebo>'
    folder = hand_folder(tmp_path, outside=outside)
    assert read_urdf(folder / "two.urdf").links["left_tip"].friction is None


def test_the_configuration_counts_first(tmp_path: Path) -> None:
    outside = '<gazebo reference="left_tip"><mu1>0.7</mu1></gazebo>'
    more = "tip_friction: {right: 0.4, defaults: 0.9}\n"
    hand = load_hand(hand_folder(tmp_path, more, outside=outside))
    assert hand.tip_friction == {"left": 0.9, "right": 0.4}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("tip_friction: {thumb: 0.4}\n", r"hand\.yaml:4.*unknown finger.*left, right"),
        ("tip_friction: {left: -0.4}\n", r"hand\.yaml:4.*greater than or equal to 0"),
        ("tip_friction: 0.4\n", r"hand\.yaml:4"),
    ],
)
def test_a_mistake_is_named_with_its_line(tmp_path: Path, more: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_hand(hand_folder(tmp_path, more))


def test_planners_are_told_stiffness_and_friction_and_what_is_not_known(tmp_path: Path) -> None:
    more = "tip_friction: {left: 0.4}\ndynamics:\n  r: {kp: 3.5}\n"
    info = info_of(info_fields(load_hand(hand_folder(tmp_path, more)), {}))
    left, right = info.fingers
    assert left.friction == 0.4
    assert right.friction != right.friction, "NaN"
    stiffness = {each.name: each.stiffness for each in info.actuators}
    assert stiffness["r"] == 3.5
    assert stiffness["l"] != stiffness["l"], "NaN"
    assert info.missing == (
        "the stiffness of l is not known",
        "the friction of the tips of right is not known",
    )
