"""What a reader accepts, every consumer accepts: from the model to a grasp and other programs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from hand.robots import JAW, PALM, Robot, arm, box, fingers, jaws, linkage, sphere
from rtee.cli.main import main
from rtee.hand.subtree import Subtree

SRDF = '<robot name="{}">{}</robot>'


def marked() -> Robot:
    robot = jaws()
    for side in ("left", "right"):
        robot.link(f"{side}_tip", sphere(0.002)).weld(
            f"{side}_distal", f"{side}_tip", (0, 0, 0.045)
        )
    return robot


def capsules() -> str:
    capsule = (
        '<origin xyz="0 0 0.025"/><geometry><capsule radius="0.006" length="0.04"/></geometry>'
    )
    robot = Robot("capsules").link("base", PALM)
    for side, x in (("left", -0.03), ("right", 0.03)):
        robot.link(f"{side}_tip", capsule)
        robot.joint(f"{side}_joint", "base", f"{side}_tip", (x, 0, 0.01), (0, -x / 0.03, 0))
    return robot.text


def quaternions() -> str:
    plain = 'xyz="-0.03 0 0.01" rpy="0 0 0"'
    turned = 'xyz="-0.03 0 0.01" quat_xyzw="0 0.1 0 0.995"'
    return jaws().text.replace(plain, turned)


def soft_limits() -> str:
    soft = (
        '<safety_controller soft_lower_limit="0.1" soft_upper_limit="0.8" k_velocity="9"/></joint>'
    )
    return jaws().text.replace("</joint>", soft)


def sliding() -> Robot:
    robot = Robot("wsg").link("base", box(0.08, 0.06, 0.02))
    for side, low, high in (("left", -0.055, -0.005), ("right", 0.005, 0.055)):
        robot.link(f"finger_{side}", box(0.01, 0.02, 0.05, (0, 0, 0.03)))
        robot.joint(
            f"j{side}", "base", f"finger_{side}", (0, 0, 0.01), (1, 0, 0), (low, high),
            kind="prismatic",
        )  # fmt: skip
    return robot


def claw() -> Robot:
    robot = Robot("claw").link("base", box(0.1, 0.1, 0.05))
    last = arm(robot, "base")
    robot.link("jaw", JAW).link("fixed_jaw", JAW).weld(last, "fixed_jaw", (-0.02, 0, 0.09))
    return robot.joint("gripper", last, "jaw", (0.02, 0, 0.09), (0, -1, 0), (-0.2, 1.0))


def on_arm() -> Robot:
    robot = Robot("on_arm").link("base_link", box(0.1, 0.1, 0.05))
    last = arm(robot, "base_link")
    return jaws(robot, base="palm").weld(last, "palm", (0, 0, 0.11))


def one_motor_on_arm() -> str:
    right = '<joint name="right_joint" type="revolute">'
    return on_arm().text.replace(right, f'{right}<mimic joint="left_joint"/>')


def two_hands() -> Robot:
    robot = Robot("robot").link("torso", box(0.2, 0.4, 0.5))
    for side, y in (("left", 0.3), ("right", -0.3)):
        robot.link(f"{side}_mount").weld("torso", f"{side}_mount", (0, y, 0.2), (0.4, 0, 0))
        last = arm(robot, f"{side}_mount", f"{side}_")
        fingers(robot, ("index", "middle", "thumb"), "palm", f"{side}_")
        robot.weld(last, f"{side}_palm", (0, 0, 0.1))
    return robot


def strange_names() -> str:
    text = jaws().text
    for name in ("left_distal", "right_distal", "left_joint", "right_joint"):
        text = text.replace(f'"{name}"', f'"{name.replace("_", " ")} 関節/é"')
    return text


MOVEIT = (
    '<group name="arm"><chain base_link="base_link" tip_link="palm"/></group><group name="gripper">'
    '<link name="palm"/><link name="left_distal"/><link name="right_distal"/>'
    '<joint name="left_joint"/></group><group_state name="open" group="gripper">'
    '<joint name="left_joint" value="0.1"/></group_state>'
    '<end_effector name="eef" parent_link="palm" group="gripper"/>'
    '<passive_joint name="right_joint"/>'
    '<disable_collisions link1="palm" link2="left_distal" reason="Adjacent"/>'
    '<disable_collisions link1="palm" link2="nowhere" reason="Never"/>'
)
"""An SRDF as MoveIt's assistant writes it, with a link that is not there, and a passive joint."""

CLAW = (
    '<group name="fixed"><link name="fixed_jaw"/></group>'
    '<group name="moving"><chain base_link="arm_link_5" tip_link="jaw"/></group>'
    '<group name="end_effector_fingers"><group name="fixed"/><group name="moving"/></group>'
)

MODELS: Mapping[str, Callable[[], Robot | str]] = {
    "jaws": jaws,
    "marked": marked,
    "linkage": linkage,
    "capsules": capsules,
    "quaternions": quaternions,
    "soft_limits": soft_limits,
    "sliding": sliding,
    "claw": claw,
    "on_arm": on_arm,
    "moveit": one_motor_on_arm,
    "two_hands": two_hands,
    "rigid": two_hands,
    "strange_names": strange_names,
}

PINCH = ("PinchTight", "PinchLoose")


@pytest.mark.samples("claw")
@pytest.mark.parametrize("name", MODELS)
def test_it_goes_all_the_way(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def rtee(*words: object, status: int = 0) -> str:
        monkeypatch.setattr(sys, "argv", ["rtee", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        assert ended.value.code == status, f"rtee {words}: {said.out}{said.err}"
        return said.out + said.err

    monkeypatch.chdir(tmp_path)
    tmp_path.chmod(0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    made = MODELS[name]()
    urdf = tmp_path / "model.urdf"
    urdf.write_text(made if isinstance(made, str) else made.text, encoding="utf-8")
    further: list[str] = []
    if name in ("moveit", "claw"):
        groups = MOVEIT if name == "moveit" else CLAW
        (tmp_path / "model.srdf").write_text(SRDF.format(name, groups))
        further = ["--srdf", "model.srdf"]
    if name in ("two_hands", "rigid"):
        further = ["--root", "left_palm"] + (["--outside", "rigid"] if name == "rigid" else [])
    rtee("new", name, "--urdf", urdf, *further)
    said = rtee("extract", name, "--save", "--report", "page.html", "--jobs", "1")
    pinch = next(word for word in PINCH if word in said)
    fingers_ = next(line for line in said.splitlines() if line.startswith(pinch)).split("  ")
    elements = next(part for part in fingers_[1:] if part.strip()).strip().split(", ")
    assert "<html" in (tmp_path / "page.html").read_text()[:200]
    assert pinch in rtee("openings", name)
    rtee("run", name, "--duration", "0.1", "--no-log", "--rate", "100")
    rtee("export", name, "out")
    assert {path.suffix for path in (tmp_path / "out").iterdir()} >= {".urdf", ".xml", ".srdf"}
    rtee("extract", "--urdf", f"out/{name}.urdf", "--srdf", f"out/{name}.srdf", "--jobs", "1")
    for words in (
        ("grasp-plan", name, "--object", "box:0.02x0.02x0.04"),
        ("try", name, pinch, *elements, "--object", "box:0.02x0.02x0.04"),
    ):
        # Whether the object is held is not asked here; a model that cannot be used is status 2.
        monkeypatch.setattr(sys, "argv", ["rtee", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        assert ended.value.code in (0, 1), f"{words}: {said.out}{said.err}"


def test_the_root_is_the_frame_of_what_is_told(tmp_path: Path) -> None:
    from rtee.hand.load import load_model

    path = two_hands().write(tmp_path)
    hand = load_model(path, edits=[Subtree("left_palm")])
    assert (hand.base, hand.urdf.root) == ("left_palm", "left_palm")
