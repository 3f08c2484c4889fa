from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from hand.models import GRIPPER, SRDF, line_of
from rtee.errors import ModelError
from rtee.hand.model import Hand

Load = Callable[..., Hand]

CHAIN = '<chain base_link="palm" tip_link="left_jaw"/>'


def changed(old: str, new: str) -> str:
    """Return the SRDF with the first occurrence of a part changed."""
    assert old in SRDF
    return SRDF.replace(old, new, 1)


def test_fingers_are_the_members_of_the_group_of_groups(load: Load) -> None:
    srdf = changed('    <group name="right_finger"/>\n', "")
    hand = load(srdf=srdf)
    assert hand.finger_names == ("left_finger",)
    finger = hand.fingers[0]
    assert (finger.base, finger.tip, finger.links) == ("palm", "left_jaw", ("palm", "left_jaw"))
    assert finger.actuators == finger.own == ("left",)
    assert f"line {line_of(srdf, CHAIN)}" in finger.reason
    assert "group 'fingers'" in finger.reason


def test_a_urdf_in_its_place_is_refused(load: Load) -> None:
    with pytest.raises(ModelError, match=r"an SRDF cannot define joints") as refusal:
        load(srdf=GRIPPER)
    assert refusal.value.line == GRIPPER[: GRIPPER.index("<joint")].count("\n") + 1


def test_without_a_group_of_groups_every_chain_is_a_finger(load: Load) -> None:
    srdf = re.sub(r'<group name="fingers">.*?</group>\n', "", SRDF, flags=re.S)
    assert load(srdf=srdf).finger_names == ("left_finger", "right_finger")


def test_the_end_effector_decides_between_groups_of_groups(load: Load) -> None:
    other = '<group name="chains"><group name="right_finger"/></group>'
    effector = '<end_effector name="e" parent_link="palm" group="chains"/>'
    assert load(srdf=changed("</robot>", f"{other}</robot>")).finger_names == (
        "left_finger",
        "right_finger",
    )
    hand = load(srdf=changed("</robot>", f"{other}{effector}</robot>"))
    assert hand.finger_names == ("right_finger",)


def test_groups_of_links_or_joints_are_chains_too(load: Load) -> None:
    srdf = changed(CHAIN, '<link name="left_jaw"/>')
    assert load(srdf=srdf).finger("left_finger").links == ("palm", "left_jaw")
    srdf = changed(CHAIN, '<joint name="left"/>')
    assert load(srdf=srdf).finger("left_finger").links == ("palm", "left_jaw")


def test_an_srdf_without_chains_leaves_the_fingers_to_the_tree(load: Load) -> None:
    hand = load(srdf='<robot name="gripper"/>')
    assert hand.finger_names == ("left", "right")
    assert "the SRDF names no finger; the fingers were found from the tree" in hand.notes


def test_a_hand_without_collision_geometry_says_why_it_has_no_finger(load: Load) -> None:
    bare = re.sub(r"<collision.*?</collision>", "", GRIPPER, flags=re.S)
    hand = load(bare, srdf='<robot name="gripper"/>')
    assert hand.finger_names == ()
    assert any("none was found: a finger is a branch that" in note for note in hand.notes)


def test_rest_posture_of_a_group_state(load: Load) -> None:
    states = "".join(
        f'<group_state name="{name}" group="fingers"><joint name="left" value="{value}"/>'
        "</group_state>"
        for name, value in (("home", 0.1), ("Open", 0.2), ("close", 0.7))
    )
    hand = load(srdf=changed("</robot>", f"{states}</robot>"))
    assert list(hand.rest) == [0.2, 0.0]
    assert "the rest posture is the SRDF's group_state 'Open'" in hand.notes
    assert list(load(srdf=changed("</robot>", f"{states}</robot>"), rest={"left": 0.5}).rest) == [
        0.5,
        0.0,
    ]


def test_disabled_collisions(load: Load) -> None:
    pair = '<disable_collisions link1="left_jaw" link2="{}" reason="Adjacent"/>'
    hand = load(srdf=changed("</robot>", f"{pair.format('palm')}</robot>"))
    assert hand.disabled_collisions == (("left_jaw", "palm", "Adjacent"),)
    hand = load(srdf=changed("</robot>", f"{pair.format('wrist')}</robot>"))
    assert any("unknown link 'wrist'" in note for note in hand.notes)


def test_a_finger_without_geometry_is_a_note(load: Load) -> None:
    srdf = changed(
        "</robot>", '<group name="thumb"><chain base_link="palm" tip_link="nail"/></group></robot>'
    ).replace('<group name="right_finger"/>', '<group name="right_finger"/><group name="thumb"/>')
    from hand.models import GRIPPER

    urdf = GRIPPER.replace(
        "</robot>",
        '<link name="nail"/><joint name="bend" type="revolute"><parent link="palm"/>'
        '<child link="nail"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint></robot>',
    )
    hand = load(urdf, srdf)
    assert hand.finger("thumb").tip is None
    assert hand.finger("thumb").actuators == ("bend",)
    assert hand.actuator("bend").fingers == ()
    assert "finger 'thumb' has no collision geometry: no pinches for it" in hand.notes


WRONG = [
    (CHAIN, '<chain base_link="palm" tip_link="jaw"/>', "unknown link 'jaw'", 'tip_link="jaw"'),
    (
        CHAIN,
        '<chain base_link="left_jaw" tip_link="palm"/>',
        "tip 'palm' of the chain of group 'left_finger' is not below its base 'left_jaw'",
        'tip_link="palm"',
    ),
    (CHAIN, '<chain base_link="left_jaw" tip_link="left_jaw"/>', "is not below its base", None),
    (CHAIN, '<chain base_link="palm"/>', "<chain> needs the attribute 'tip_link'", None),
    (
        CHAIN,
        '<link name="left_jaw"/><link name="right_jaw"/>',
        "is in the group of fingers 'fingers' but is not one chain of links",
        '<group name="left_finger">',
    ),
    (CHAIN, '<joint name="lift"/>', "unknown joint 'lift'", '"lift"'),
    (CHAIN, '<link name="jam"/>', "unknown link 'jam'", '"jam"'),
    (
        '<chain base_link="palm" tip_link="right_jaw"/>',
        CHAIN,
        "fingers 'left_finger' and 'right_finger' have the same fingertip 'left_jaw'",
        None,
    ),
    ('name="left_finger">', 'name="right_finger">', "group 'right_finger' is defined twice", None),
    ('<group name="right_finger"/>', '<group name="thumb"/>', "unknown group 'thumb'", '"thumb"'),
    (
        '<group name="right_finger"/>',
        '<group name="fingers"/>',
        "group 'fingers' contains itself",
        '<group name="fingers">',
    ),
    ("</robot>", '<passive_joint name="no"/></robot>', "unknown joint 'no'", '"no"'),
    (
        "</robot>",
        '<passive_joint name="left"/><passive_joint name="left"/></robot>',
        "<passive_joint> 'left' occurs twice",
        None,
    ),
    (
        "</robot>",
        '<group_state name="s" group="g"><joint name="no" value="1"/></group_state></robot>',
        "unknown joint 'no'",
        '"no"',
    ),
    (
        "</robot>",
        '<group_state name="rest" group="g"><joint name="left" value="1"/></group_state></robot>',
        "actuator 'left': the SRDF's rest position 1 lies outside the limits 0 … 0.8",
        None,
    ),
    ('<robot name="gripper">', "<sdf>", "SRDF is not XML", None),
]


@pytest.mark.parametrize(("old", "new", "message", "place"), WRONG)
def test_wrong_srdf(load: Load, old: str, new: str, message: str, place: str | None) -> None:
    text = changed(old, new)
    with pytest.raises(ModelError, match=re.escape(message)) as caught:
        load(srdf=text)
    assert caught.value.path is not None
    assert caught.value.line is not None
    if place is not None:
        assert caught.value.path.name == "gripper.srdf"
        assert caught.value.line == line_of(text, place)


def test_a_finger_named_like_a_path(load: Load) -> None:
    srdf = SRDF.replace("left_finger", "../finger")
    with pytest.raises(ValueError, match=r"finger name '\.\./finger' starts with a dot"):
        load(srdf=srdf)


def test_both_kinds_of_notes_for_another_robot(load: Load) -> None:
    hand = load(srdf=changed('name="gripper"', 'name="other"'))
    assert "the SRDF is for robot 'other', the URDF is of 'gripper'" in hand.notes


def test_a_finger_in_several_groups_is_one_finger(load: Load) -> None:
    below = '<group name="left_finger"/><group name="right_finger"/>'
    groups = [f'<group name="a0">{below}</group><group name="b0">{below}</group>']
    for k in range(1, 25):  # each level would double the work
        both = f'<group name="a{k - 1}"/><group name="b{k - 1}"/>'
        groups.append(f'<group name="a{k}">{both}</group><group name="b{k}">{both}</group>')
    effector = '<end_effector name="e" parent_link="palm" group="a24"/>'
    srdf = changed("</robot>", "\n".join([*groups, effector, "</robot>"]))
    assert load(srdf=srdf).finger_names == ("left_finger", "right_finger")
