from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rtee.hand.load import load_model
from rtee.hand.model import Hand

Load = Callable[..., Hand]

AS_THE_SRDF = (
    "heri_II",
    "heri_II_linear",
    "onrobot_3fg15",
    "qbhand",
    "robotiq_3f",
    "schunk",
    "test_ee",
    "test_ee_spread",
    "two_finger",
    "two_finger_mimic",
)


def test_the_tips_are_those_of_the_srdf(real: Path, real_hand: Hand) -> None:
    found = load_model(real / f"{real.name}.urdf")
    named, in_tree = ({finger.tip for finger in hand.fingers} for hand in (real_hand, found))
    if real.name in AS_THE_SRDF:
        assert in_tree == named
    elif real.name == "dagana":
        # A jaw that does not move cannot be told from the palm.
        assert in_tree == named - {"dagana_gripper_top_link"}
    else:
        assert in_tree == named
        bars = {finger.bars for finger in found.fingers}
        assert bars == {("left_inner_knuckle",), ("right_inner_knuckle",)}


@pytest.mark.parametrize("name", ["schunk", "qbhand"])
def test_names_by_the_usual_words(shared: Path, name: str) -> None:
    hand = load_model(shared / "hands" / name / f"{name}.urdf")
    last = "pinky" if name == "schunk" else "little"
    assert set(hand.finger_names) == {"thumb", "index", "middle", "ring", last}
    assert all("carries" in finger.reason for finger in hand.fingers)


def robot(*joints: tuple[str, str, str], solid: str = "") -> str:
    """Return a robot of revolute (``r``) and fixed (``f``) joints from one link to another."""
    links = dict.fromkeys(link for _, a, b in joints for link in (a, b))
    shape = "<collision><geometry><sphere radius='0.01'/></geometry></collision>"
    text = "".join(f"<link name='{n}'>{shape if n in solid.split() else ''}</link>" for n in links)
    for i, (kind, parent, child) in enumerate(joints):
        limit = "<limit lower='0' upper='1' velocity='1' effort='1'/>" if kind == "r" else ""
        text += (
            f"<joint name='j{i}' type='{'revolute' if kind == 'r' else 'fixed'}'>"
            f"<parent link='{parent}'/><child link='{child}'/>{limit}</joint>"
        )
    return f"<robot name='r'>{text}</robot>"


def test_bases_lie_where_branches_part(load: Load) -> None:
    text = robot(
        ("f", "world", "palm"),
        ("r", "palm", "fold"),
        ("r", "fold", "ring"),
        ("r", "fold", "little"),
        ("r", "palm", "index"),
        solid="palm fold ring little index",
    )
    hand = load(text, None)
    assert {f.name: f.links for f in hand.fingers} == {
        "ring": ("fold", "ring"),
        "little": ("fold", "little"),
        "index": ("palm", "index"),
    }
    assert hand.finger("ring").actuators == ("j1", "j2")
    assert hand.finger("ring").own == ("j2",)


def test_ends_that_do_not_move_are_no_fingers(load: Load) -> None:
    text = robot(
        ("r", "palm", "jaw"), ("f", "palm", "cover"), ("r", "palm", "empty"), solid="palm jaw cover"
    )
    assert [finger.tip for finger in load(text, None).fingers] == ["jaw"]


def test_ends_fixed_to_one_another_are_one_finger(load: Load) -> None:
    text = robot(
        ("r", "palm", "a"),
        ("f", "a", "pad"),
        ("f", "a", "frame"),
        ("f", "frame", "nail"),
        ("r", "palm", "b"),
        solid="palm a pad nail b",
    )
    assert [finger.tip for finger in load(text, None).fingers] == ["nail", "b"]


def test_a_link_without_geometry_at_the_end_is_not_the_tip(load: Load) -> None:
    text = robot(("r", "palm", "a"), ("f", "a", "frame"), ("r", "palm", "b"), solid="palm a b")
    assert [finger.tip for finger in load(text, None).fingers] == ["a", "b"]
    assert load(text, None).fingers[0].links == ("palm", "a")


def test_names_are_unique_and_allowed(load: Load) -> None:
    text = robot(
        *(("r", "palm", link) for link in ("f 1 end", "f/2/end", "f-3-end")),
        solid="palm",
    ).replace("end'>", "end'><collision><geometry><sphere radius='1'/></geometry></collision>")
    assert load(text, None).finger_names == ("f_1_end", "f_2_end", "f-3-end")
    text = robot(
        *(("r", "palm", f"hand_{i}_link") for i in (1, 2)), solid="palm hand_1_link hand_2_link"
    )
    assert load(text, None).finger_names == ("finger_1", "finger_2")


def fingers_called(*names: str) -> str:
    """Return a hand whose fingers each consist of two links with such names."""
    joints = [
        ("r", parent, child)
        for name in names
        for parent, child in (
            ("palm", name.format("proximal", 3)),
            (name.format("proximal", 3), name.format("distal", 1)),
        )
    ]
    return robot(*joints, solid=" ".join(["palm", *(child for _, _, child in joints)]))


ALL_FIVE = ("thumb", "index", "middle", "ring", "little")


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (("rh_th{}", "rh_ff{}", "rh_mf{}", "rh_rf{}", "rh_lf{}"), ALL_FIVE),
        (("TH_{}", "FF_{}", "MF_{}", "RF_{}", "LF_{}"), ALL_FIVE),
        (("THJ{1}", "FFJ{1}", "MFJ{1}"), ALL_FIVE[:3]),
        (("index_{}", "ff_{}"), ("ff", "index")),
        (("f1_{}", "f2_{}", "f3_{}"), ("finger_1", "finger_2", "finger_3")),
        (("finger1_{}", "finger2_{}", "thumb_{}"), ("finger_1", "finger_2", "thumb")),
        (("hand_F1{}", "hand_F2{}"), ("finger_1", "finger_2")),
        # Long and short fingers of HERI II; nothing says which is which.
        (("LFP1_{}", "LFP2_{}"), ("LFP1", "LFP2")),
    ],
)
def test_names_by_what_people_write(
    load: Load, names: tuple[str, ...], found: tuple[str, ...]
) -> None:
    hand = load(fingers_called(*names), None)
    assert set(hand.finger_names) == set(found)


def test_the_reason_says_where_the_name_comes_from(load: Load) -> None:
    hand = load(fingers_called("rh_th{}", "rh_ff{}"), None)
    assert hand.finger("index").reason.endswith(
        "carries 2 moved joints; named for the prefix 'ff' of its links and joints"
    )
    hand = load(fingers_called("f1_{}", "f2_{}"), None)
    assert hand.finger("finger_1").reason.endswith("named after the number in its links and joints")


def test_the_first_finger_word_of_a_name_decides(load: Load) -> None:
    links = [(finger, f"{finger}_{part}") for finger in ALL_FIVE for part in ("middle", "distal")]
    joints = []
    for finger, link in links:
        parent = "palm" if link.endswith("middle") else f"{finger}_middle"
        joints.append(("r", parent, link))
    hand = load(robot(*joints, solid=" ".join(["palm", *(link for _, link in links)])), None)
    assert {finger.name: finger.tip for finger in hand.fingers} == {
        finger: f"{finger}_distal" for finger in ALL_FIVE
    }


def test_the_innermost_of_several_finger_words_decides_and_is_told(load: Load) -> None:
    text = robot(
        *(("r", "palm", "index_base"), ("r", "index_base", "middle_phalanx")),
        *(("r", "palm", "thumb_base"), ("r", "thumb_base", "thumb_end")),
        solid="palm index_base middle_phalanx thumb_base thumb_end",
    )
    hand = load(text, None)
    assert set(hand.finger_names) == {"index", "thumb"}
    reason = hand.finger("index").reason
    assert reason.endswith("named after the first word in its links and joints, among 'middle'")


def test_fingers_with_the_same_word_are_named_by_their_ends_and_it_is_told(load: Load) -> None:
    joints = [("r", "palm", "index_left"), ("r", "palm", "index_right"), ("r", "palm", "thumb_up")]
    hand = load(robot(*joints, solid="palm index_left index_right thumb_up"), None)
    assert set(hand.finger_names) == {"index_left", "index_right", "thumb"}
    for name in ("index_left", "index_right"):
        assert hand.finger(name).reason.endswith("as another finger is called 'index', too")
