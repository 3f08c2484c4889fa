"""Bars of a linkage belong to a finger, and are none of their own."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from hand.robots import Robot, box, fingers, linkage
from rtee.exchange.mjcf_import import import_mjcf
from rtee.hand.colours import finger_of_link
from rtee.hand.load import load_model
from rtee.hand.model import Hand

BARS = {"left": ("left_inner_knuckle",), "right": ("right_inner_knuckle",)}


def chains(*tips: str, base: str = "base", members: bool = False) -> str:
    """Return an SRDF that names chains to these links as fingers."""
    groups = "".join(
        f'<group name="{t}"><chain base_link="{base}" tip_link="{t}"/></group>' for t in tips
    )
    listed = "".join(f'<group name="{t}"/>' for t in tips)
    listed = f'<group name="end_effector_fingers">{listed}</group>' if members else ""
    return f'<robot name="linkage">{groups}{listed}</robot>'


def test_the_bars_belong_to_the_finger_on_their_side(tmp_path: Path) -> None:
    hand = load_model(linkage().write(tmp_path))
    assert {finger.name: finger.bars for finger in hand.fingers} == BARS
    assert [finger.tip for finger in hand.fingers] == ["left_finger_tip", "right_finger_tip"]
    assert finger_of_link(hand)["left_inner_knuckle"] == "left"
    assert "in a linkage with 'right_inner_knuckle'" in hand.fingers[1].reason


@pytest.mark.parametrize("members", [False, True])
def test_an_srdf_that_lists_the_bars_changes_nothing(tmp_path: Path, members: bool) -> None:
    tips = ("left_inner_knuckle", "left_finger_tip", "right_finger_tip", "right_inner_knuckle")
    srdf = tmp_path / "linkage.srdf"
    srdf.write_text(chains(*tips, members=members))
    hand = load_model(linkage().write(tmp_path), srdf)
    assert {finger.tip: finger.bars for finger in hand.fingers} == {
        "left_finger_tip": BARS["left"], "right_finger_tip": BARS["right"],
    }  # fmt: skip
    assert sum("is a bar of a linkage" in note for note in hand.notes) == 2
    srdf.write_text(chains("left_finger_tip", "right_finger_tip"))
    again = load_model(tmp_path / "linkage.urdf", srdf)
    assert {f.tip: f.bars for f in again.fingers} == {f.tip: f.bars for f in hand.fingers}


def test_the_tip_may_be_on_the_inner_knuckle(tmp_path: Path) -> None:
    robot = linkage(inner=True)
    for s, side in ((-1.0, "left"), (1.0, "right")):
        robot.link(f"{side}_pad", box(0.01, 0.02, 0.06, (0, 0, 0.03)))
        robot.joint(
            f"{side}_pad_joint", f"{side}_inner_knuckle", f"{side}_pad", (0.0, 0, 0.05),
            (0, -s, 0), (-0.7, 0), mimic="left_knuckle_joint -1",
        )  # fmt: skip
    hand = load_model(robot.write(tmp_path))
    assert {f.tip: f.bars for f in hand.fingers} == {
        "left_pad": ("left_knuckle", "left_finger_tip"),
        "right_pad": ("right_knuckle", "right_finger_tip"),
    }


@pytest.mark.parametrize("turn", [0.0, 0.7, math.pi])
def test_a_bar_on_the_finger_itself(tmp_path: Path, turn: float) -> None:
    robot = Robot("own").link("world").link("palm", box(0.08, 0.06, 0.02))
    robot.weld("world", "palm", rpy=(0.3, turn, 1.0))
    for s, side in ((-1.0, "left"), (1.0, "right")):
        robot.link(f"{side}_distal", box(0.01, 0.02, 0.05, (0, 0, 0.03)))
        follows = "" if side == "left" else "left_joint"
        robot.joint(
            f"{side}_joint", "palm", f"{side}_distal", (0.03 * s, 0, 0), (0, -s, 0), mimic=follows
        )
        robot.link(f"{side}_rod", box(0.004, 0.004, 0.02))
        robot.joint(
            f"{side}_rod_joint", f"{side}_distal", f"{side}_rod", (0, 0, 0.02), (0, s, 0),
            mimic="left_joint 0.5",
        )  # fmt: skip
    hand = load_model(robot.write(tmp_path))
    tips = {finger.tip: finger.bars for finger in hand.fingers}
    assert len(tips) == 2


def test_fingers_beside_each_other_with_one_motor_stay_fingers(tmp_path: Path) -> None:
    robot = fingers(Robot("own"), ("thumb", "index", "middle", "ring"))
    text = robot.text
    for name in ("index", "middle", "ring", "thumb"):
        for part in ("proximal", "distal"):
            if (name, part) != ("index", "proximal"):
                joint = f'<joint name="{name}_{part}_joint" type="revolute">'
                follows = '<mimic joint="index_proximal_joint"/>'
                assert joint in text
                text = text.replace(joint, joint + follows)
    path = tmp_path / "own.urdf"
    path.write_text(text)
    hand = load_model(path)
    assert hand.actuator_names == ("index_proximal_joint",)
    assert set(hand.finger_names) == {"thumb", "index", "middle", "ring"}
    assert not any(finger.bars for finger in hand.fingers)


def test_the_fingers_of_an_iris_stay_fingers(tmp_path: Path) -> None:
    robot = Robot("iris").link("base", box(0.1, 0.1, 0.02))
    for k in range(3):
        angle = k * math.tau / 3
        at = (0.03 * math.cos(angle), 0.03 * math.sin(angle), 0.02)
        robot.link(f"jaw_{k}", box(0.03, 0.006, 0.02, (0.015, 0, 0)))
        robot.joint(
            f"joint_{k}", "base", f"jaw_{k}", at, (0, 0, 1), rpy=(0, 0, angle + 0.5),
            mimic="joint_0" if k else "",
        )  # fmt: skip
    assert len(load_model(robot.write(tmp_path)).fingers) == 3


MJCF = """<mujoco><compiler angle="radian"/><worldbody><body name="base">
<geom type="box" size="0.03 0.025 0.015"/>{}</body></worldbody>
<equality>{}</equality><actuator><position joint="left_outer" ctrlrange="0 0.7"/></actuator>
</mujoco>
"""


def closed_loop() -> str:
    """Return a gripper of two four-bar linkages, each closed by a `connect`."""
    sides, loops = "", ""
    for s, side in ((-1, "left"), (1, "right")):
        sides += f"""
<body name="{side}_outer_bar" pos="{0.03 * s} 0 0.015">
  <joint name="{side}_outer" axis="0 {-s} 0" range="0 0.7"/>
  <geom type="box" size="0.006 0.01 0.015" pos="{0.01 * s} 0 0.015"/>
  <body name="{side}_tip" pos="{0.01 * s} 0 0.04">
    <joint name="{side}_coupler" axis="0 {-s} 0" range="-1.5 1.5"/>
    <geom type="box" size="0.006 0.01 0.0225" pos="0 0 0.0225"/>
  </body></body>
<body name="{side}_inner_bar" pos="{0.012 * s} 0 0.02">
  <joint name="{side}_inner" axis="0 {-s} 0" range="-0.2 1"/>
  <geom type="box" size="0.004 0.01 0.015" pos="{0.005 * s} 0 0.02"/>
</body>"""
        loops += (
            f'<connect body1="{side}_inner_bar" body2="{side}_tip" anchor="{0.01 * s} 0 0.04"/>'
        )
    return MJCF.format(sides, loops + '<joint joint1="right_outer" joint2="left_outer"/>')


def test_two_fingers_of_a_closed_loop_in_mjcf(tmp_path: Path) -> None:
    path = tmp_path / "own.xml"
    path.write_text(closed_loop())
    imported = import_mjcf(path, tmp_path)
    hand: Hand = load_model(imported.urdf, passive=imported.passive)
    assert hand.actuator_names == ("left_outer",)
    assert {f.tip: f.bars for f in hand.fingers} == {
        "left_tip": ("left_inner_bar",), "right_tip": ("right_inner_bar",),
    }  # fmt: skip
