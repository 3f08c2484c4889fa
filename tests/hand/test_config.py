from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from hand.models import YAML, line_of
from rtee.errors import ConfigError
from rtee.hand import yamlfile
from rtee.hand.config import HandConfig, read_document
from rtee.hand.load import load_configured, load_hand
from rtee.running.prepare import RunOptions, prepare


def rewrite(configured: Path, old: str, new: str) -> str:
    """Change the gripper's hand.yaml."""
    assert old in YAML
    text = YAML.replace(old, new, 1)
    (configured / "gripper" / "hand.yaml").write_text(text)
    return text


def test_configured_hand(configured: Path) -> None:
    hand = load_hand("gripper", config_dirs=[configured])
    left, right = hand.actuators
    assert hand.name == "gripper"
    assert hand.description == "A gripper"
    assert list(hand.rest) == [0.1, 0.0]
    assert (left.velocity, left.effort, left.upper) == (2.0, 5.0, 0.8)
    assert (right.velocity, right.effort, right.upper) == (1.0, 2.0, 0.7)
    assert (right.acceleration, right.jerk) == (20.0, 400.0)


@pytest.mark.parametrize("path", ["gripper", "gripper/hand.yaml"])
def test_by_path(configured: Path, path: str) -> None:
    assert load_hand(configured / path).name == "gripper"
    assert load_hand(f"{configured}/{path}").name == "gripper"


@pytest.mark.parametrize(
    ("model", "option"), [("h.urdf", "--urdf"), ("h.urdf.xacro", "--urdf"), ("h.xml", "--mjcf")]
)
def test_a_model_is_not_a_hand(tmp_path: Path, model: str, option: str) -> None:
    for path in (model, str(tmp_path / model)):
        with pytest.raises(ConfigError, match="is a model, not a hand") as told:
            load_hand(path)
        assert f"`rtee new NAME {option} {path}`" in str(told.value)


def test_a_hand_to_run_is_parsed_once(
    configured: Path, monkeypatch: pytest.MonkeyPatch, repository: Path
) -> None:
    """Though its devices know the lines that they are from."""
    parsed = []
    reader = yamlfile.yaml_reader

    def counted() -> Any:
        parsed.append(1)
        return reader()

    monkeypatch.setattr(yamlfile, "yaml_reader", counted)
    folder = repository / "config" / "robotiq_2f_85"
    rows = (folder / "hand.yaml").read_text().splitlines()
    (device,) = prepare(str(folder), RunOptions(emulated=True)).devices
    assert device.spec.source == f"{folder / 'hand.yaml'}:{1 + rows.index('  gripper:')}"
    assert len(parsed) == 1


def test_defaults_of_the_configuration(configured: Path) -> None:
    rewrite(configured, YAML, "name: gripper\nurdf: gripper.urdf\n")
    hand, config = load_configured("gripper", config_dirs=[configured])
    assert config == HandConfig(name="gripper", urdf="gripper.urdf")
    assert config.loop.rate == 1000.0
    assert config.safety.on_exit == "hold"
    assert config.driver == "kinematic"
    assert hand.finger_names == ("left", "right")
    spec = hand.actuators[0]
    assert spec.acceleration == pytest.approx(spec.velocity / 0.1)
    assert spec.jerk == pytest.approx(spec.acceleration / 0.05)


WRONG = [
    ("title:", "tilte:", "tilte: unknown key; did you mean 'title'?", "tilte"),
    ("rest: {left: 0.1}", "rest: {left: .nan}", "'.nan' is not a finite number", ".nan"),
    ("rest: {left: 0.1}", "rest: {left: -.inf}", "is not a finite number", "-.inf"),
    ("rest: {left: 0.1}", "rest: {lefd: 0}", "rest.lefd: unknown actuator; did you mean", "lefd"),
    ("rest: {left: 0.1}", "rest: {left: 2}", "rest.left: rest position 2 lies outside", "rest"),
    ("rest: {left: 0.1}", "rest: {left: yes}", "rest.left: should be a valid number", "rest"),
    ("rest: {left: 0.1}", "rest:\n\tleft: 0.1", "a tab in the indentation; use blanks", "\tleft"),
    ("rest: {left: 0.1}", "name: twice", "'name' occurs twice, first in line 1", "name: twice"),
    ("rest: {left: 0.1}", "rest: &a {left: 0}", "anchors and aliases are refused", "&a"),
    ("rest: {left: 0.1}", "rest: !!python/tuple [1]", "the tag 'python/tuple' is refused", "!!"),
    ("rest: {left: 0.1}", "rest: {left: !x 1}", "the tag '!x' is refused", "!x"),
    ("rest: {left: 0.1}", "rest: [", "hand.yaml is not YAML", None),
    ("rest: {left: 0.1}", "rest: {1: 2, [a]: 3}", "a key should be a word", None),
    (
        "upper: 0.7",
        "upper: 0.9",
        "limits.right.upper: 0.9 is outside the URDF's limits 0 … 0.8",
        None,
    ),
    (
        "upper: 0.7",
        "upper: 0.0",
        "limits.right: the lower limit 0 is not below the upper limit 0",
        None,
    ),
    ("velocity: 1.0", "velocity: 3", "limits.right.velocity: 3 is above the URDF's velocity", None),
    ("velocity: 1.0", "velocity: -1", "limits.right.velocity: should be greater than 0", None),
    ("velocity: 1.0", "velocty: 1", "limits.right.velocty: unknown key; did you mean", "velocty"),
    ("right: {", "thumb: {", "limits.thumb: unknown actuator", "thumb"),
    ("name: gripper", "name: ../x", "hand name '../x' starts with a dot", "../x"),
    ("name: gripper", "name: a/b", "hand name 'a/b' holds a character", "a/b"),
    ("name: gripper", "name: other", "'other' should be the name of its folder", "other"),
    ("name: gripper", "nam: gripper", "nam: unknown key; did you mean 'name'?", None),
    ("urdf: gripper.urdf\n", "", "urdf: is missing", None),
    ("urdf: gripper.urdf", "urdf: no.urdf", "the file 'no.urdf' does not exist beside", "no.urdf"),
    ("urdf: gripper.urdf", 'urdf: "a\\0b"', "is not printable", "a\\0b"),
    ("actuators: all", "actuators: [left]", "no device drives the actuator 'right'", None),
    ("actuators: all", "actuators: [x]", "devices.both.actuators.0: unknown actuator 'x'", None),
    ("actuators: all", "actuators: 3", "devices.both.actuators: should be", "actuators: 3"),
    ("driver: kinematic, ", "", "devices.both.driver: is missing", "both"),
    ("both:", "a b:", "device name 'a b' holds", None),
    ("devices:", "driver: devices\nlimbs:", "limbs: unknown key", "limbs"),
    ("devices:", "loop: {stall: {tme: 1}}\ndevices:", "loop.stall.tme: unknown key; did", "tme"),
    ("devices:", "thermal: {warn: 90}\ndevices:", "thermal: should rise", "thermal"),
    ("devices:", "loop: {stall: {time: 200}}\ndevices:", "loop: a stall is noticed", "loop"),
    ("devices:", "loop: {stream: {deadline: 60}}\ndevices:", "loop.stream.deadline: ", "deadline"),
    (
        "devices:",
        "loop: {grasp: {grip_effort: 0}}\ndevices:",
        "grip_effort: should be",
        "grip_effort",
    ),
    (
        "devices:",
        "ros2: {gripper_joint: lft}\ndevices:",
        "ros2.gripper_joint: unknown actuator 'lft'; did you mean 'left'",
        "ros2",
    ),
    # millimetres, degrees
    ("devices:", "flange: {xyz: [0, 0, 11]}\ndevices:", "flange.xyz.2: should be less", "flange"),
    ("devices:", "flange: {rpy: [0, 0, 90]}\ndevices:", "flange.rpy.2: should be less", "flange"),
    ("devices:", "profile: {kind: fast}\ndevices:", "profile.kind: should be 'jerk_limited'", None),
]


@pytest.mark.parametrize(("old", "new", "message", "place"), WRONG)
def test_wrong_values(
    configured: Path, old: str, new: str, message: str, place: str | None
) -> None:
    text = rewrite(configured, old, new)
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        load_hand("gripper", config_dirs=[configured])
    assert caught.value.exit_status == 2
    assert caught.value.path is not None
    assert caught.value.path.name == "hand.yaml"
    assert caught.value.line is not None
    assert "\n" not in str(caught.value)
    if place is not None:
        assert caught.value.line == line_of(text, place)


def test_two_devices_for_one_actuator(configured: Path) -> None:
    rewrite(configured, "devices:\n", "devices:\n  one: {driver: x, actuators: [left]}\n")
    with pytest.raises(ConfigError, match="actuator 'left' is already driven by 'one'"):
        load_hand("gripper", config_dirs=[configured])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "hand.yaml is empty"),
        (b"# nothing\n", "hand.yaml is empty"),
        (b"- a\n- b\n", "should be keys with values"),
        (b"name: \xff\xfe", "hand.yaml is not UTF-8 text"),
        (b"a: " + b"[" * 50_000, "hand.yaml:1: hand.yaml is nested too deeply"),
        (b"- " * 5_000, "hand.yaml is not YAML: nested too deeply"),
        (b"a: 1\n--- \nb: 2\n", "expected a single document in the stream, but found another"),
        (b"a: &a [x]\nb: [*a, *a]\n", "anchors and aliases are refused"),
        (b"x" * 1_000_001, "hand.yaml is larger than 1 MB"),
    ],
)
def test_not_a_mapping(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "hand.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=re.escape(message)):
        read_document(tmp_path)


def test_missing(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"hand\.yaml does not exist"):
        read_document(tmp_path)
    with pytest.raises(ConfigError, match=r"is not a hand.s folder: it has no hand\.yaml"):
        load_hand(tmp_path)
