"""Touch sensors in hand.yaml: where their taxels are, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from rtee.errors import ConfigError
from rtee.hand.load import load_hand
from rtee.hand.touch import finger_of, on_hand, scale_of
from rtee.touch import TouchSensor

from .test_tip_friction import hand_folder


def test_a_grid_is_turned_with_its_frame(tmp_path: Path) -> None:
    text = (
        "touch:\n  pad: {link: left_tip, xyz: [0, 0, 0.01], rpy: [0, 1.5707963267948966, 0],\n"
        "        grid: [2, 3], pitch: [0.002, 0.004], scale: 0.25}\n"
    )
    hand = load_hand(hand_folder(tmp_path, text))
    sensor = on_hand(TouchSensor("pad", 6, unit="counts", full=4.0), hand)
    assert (sensor.link, sensor.finger, sensor.unit, sensor.full) == ("left_tip", "left", "N", 1.0)
    assert scale_of(TouchSensor("pad", 6, unit="counts"), hand) == 0.25
    assert scale_of(sensor, hand) == 1.0, "newtons stay newtons, in a simulation and on replay"
    # Turned by a right angle about y: z of the frame is the link's x, x the link's -z.
    assert sensor.normal == pytest.approx(np.tile([1.0, 0.0, 0.0], (6, 1)))
    assert sensor.position[0] == pytest.approx([0.0, -0.004, 0.011])
    assert sensor.position[-1] == pytest.approx([0.0, 0.004, 0.009])
    assert sensor.placed


def test_positions_and_normals_are_taken_as_they_are(tmp_path: Path) -> None:
    text = "{link: palm, positions: [[0, 0, 0], [1, 0, 0]], normals: [[0, 0, 2], [3, 0, 0]]}"
    hand = load_hand(hand_folder(tmp_path, f"touch:\n  two: {text}\n"))
    sensor = on_hand(TouchSensor("two", 2), hand)
    assert sensor.normal.tolist() == [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    assert (sensor.finger, finger_of(hand, "palm")) == ("", "")


def test_a_sensor_that_only_its_driver_places_keeps_that(tmp_path: Path) -> None:
    hand = load_hand(hand_folder(tmp_path))
    sensor = on_hand(TouchSensor("pad", link="right_tip"), hand)
    assert (sensor.finger, sensor.placed, sensor.unit) == ("right", False, "N")
    assert math.isnan(sensor.full)
    with pytest.raises(ValueError, match="which the hand does not have"):
        on_hand(TouchSensor("pad", link="left_toe"), hand)


def test_a_link_alone_says_which_finger_feels(tmp_path: Path) -> None:
    hand = load_hand(hand_folder(tmp_path, "touch:\n  pad: {link: left_tip}\n"))
    many = on_hand(TouchSensor("pad", 87), hand)
    assert (many.finger, many.placed) == ("left", False)
    assert on_hand(TouchSensor("pad"), hand).placed, "a single taxel is at the origin"


def test_what_hangs_on_a_finger_is_its_own_and_its_base_is_not(tmp_path: Path) -> None:
    pad = (
        '<link name="left_pad"/><joint name="pad" type="fixed"><parent link="left_tip"/>'
        '<child link="left_pad"/></joint>'
    )
    folder = hand_folder(tmp_path, "touch:\n  pad: {link: left_pad}\n", outside=pad)
    assert on_hand(TouchSensor("pad", 16), load_hand(folder)).finger == "left"
    # Here one chain begins where the other one ends, and the base is in one of them only.
    dagana = load_hand(Path(__file__).parents[2] / "config" / "dagana")
    links = ("gripper_base", "gripper_top_link", "gripper_bottom_link")
    fingers = [finger_of(dagana, f"dagana_{link}") for link in links]
    assert fingers == ["", "finger_1", "finger_2"]


def test_a_scale_alone_leaves_the_place_to_the_driver(tmp_path: Path) -> None:
    hand = load_hand(hand_folder(tmp_path, "touch:\n  pad: {scale: 0.5}\n"))
    declared = TouchSensor("pad", unit="counts", link="right_tip", position=np.zeros((1, 3)))
    sensor = on_hand(declared, hand)
    assert (sensor.unit, sensor.link, sensor.finger, sensor.placed) == (
        "N",
        "right_tip",
        "right",
        True,
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{link: left_tpi}", "unknown link 'left_tpi'; did you mean 'left_tip'?"),
        ("{link: left_tip, grid: [2, 2], positions: [[0, 0, 0]]}", "a grid or positions, not both"),
        ("{link: left_tip, positions: [[0, 0, 0]], normals: [[0, 0, 0]]}", "of non-zero length"),
        ("{link: left_tip, positions: [[0, 0, 0]], normals: []}", ""),
        ("{link: left_tip, normals: [[0, 0, 1]]}", "as many normals as positions"),
        ("{link: left_tip, grid: [0, 2]}", "greater than or equal to 1"),
        ("{link: left_tip, sacle: 2.0}", "did you mean 'scale'?"),
        ("{grid: [1, 1]}", "should name the link"),
    ],
)
def test_mistakes_name_the_line(tmp_path: Path, text: str, message: str) -> None:
    folder = hand_folder(tmp_path, f"touch:\n  pad: {text}\n")
    if not message:
        assert load_hand(folder).touch["pad"].normals == ()
        return
    with pytest.raises(ConfigError, match=r"hand\.yaml:5") as caught:
        load_hand(folder)
    assert message in str(caught.value)
