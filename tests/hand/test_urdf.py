from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from hand.models import GRIPPER, line_of
from rtee.errors import ModelError, UnknownLink
from rtee.hand.model import Hand
from rtee.hand.urdfread import read_urdf

Load = Callable[..., Hand]

LIMIT = '<limit lower="0" upper="0.8" velocity="2" effort="5"/>'


def changed(old: str, new: str) -> str:
    """Return the gripper with the first occurrence of a part changed."""
    assert old in GRIPPER
    return GRIPPER.replace(old, new, 1)


def test_what_is_read(tmp_path: Path) -> None:
    file = tmp_path / "gripper.urdf"
    file.write_text(GRIPPER)
    urdf = read_urdf(file)
    assert urdf.name == "gripper"
    assert urdf.root == "palm"
    assert urdf.text == GRIPPER
    assert list(urdf.links) == ["palm", "left_jaw", "right_jaw"]
    shape = urdf.links["left_jaw"].collisions[0]
    assert (shape.kind, shape.size, shape.xyz) == ("box", (0.01, 0.02, 0.06), (0, 0, 0.03))
    joint = urdf.joints["right"]
    assert (joint.kind, joint.parent, joint.child) == ("revolute", "palm", "right_jaw")
    assert (joint.lower, joint.upper, joint.velocity, joint.effort) == (0.0, 0.8, 2.0, 5.0)
    assert joint.axis == (0.0, -1.0, 0.0)
    assert joint.line == line_of(GRIPPER, '<joint name="right"')
    assert urdf.chain("palm", "left_jaw") == ("palm", "left_jaw")
    assert urdf.chain("left_jaw", "right_jaw") is None


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "latin-1"])
def test_the_text_is_that_of_a_file_in_utf_8(tmp_path: Path, encoding: str) -> None:
    file = tmp_path / "gripper.urdf"
    named = GRIPPER.replace("palm", "Handfläche")
    word = encoding.removesuffix("-le").removesuffix("-be")
    declared = named.replace("?>", f' encoding="{word}"?>', 1)
    file.write_bytes(declared.encode(encoding))
    urdf = read_urdf(file)
    assert urdf.root == "Handfläche"
    assert urdf.text == named


def test_axis_is_made_unit_and_defaults_to_x(load: Load) -> None:
    hand = load(changed('xyz="0 1 0"', 'xyz="3 0 4"').replace('<axis xyz="0 -1 0"/>', ""))
    assert hand.urdf.joints["left"].axis == pytest.approx((0.6, 0.0, 0.8))
    assert hand.urdf.joints["right"].axis == (1.0, 0.0, 0.0)


def test_limits_in_degrees_are_noticed(load: Load) -> None:
    text = changed(LIMIT, LIMIT.replace('upper="0.8"', 'upper="90"'))
    (note,) = [note for note in load(text).notes if "turns" in note]
    assert "rad, 14.3 turns; are its limits in degrees? URDFs have radians" in note
    assert not [note for note in load().notes if "turns" in note]


def test_positions_in_millimetres_are_noticed(load: Load) -> None:
    (note,) = load(changed('xyz="-0.04 0 0.01"', 'xyz="-40 0 10"')).notes
    assert note.startswith(
        "joint 'left' is 41.2 m from the frame of its parent link; are positions"
    )


def test_limits_in_millimetres_are_noticed(load: Load) -> None:
    def sliding(upper: str) -> list[str]:
        limits = LIMIT.replace('upper="0.8"', f'upper="{upper}"')
        hand = load(changed(LIMIT, limits).replace('"revolute"', '"prismatic"', 1))
        return [note for note in hand.notes if "millimetres" in note]

    (note,) = sliding("40")
    assert "goes from 0 to 40 m; are its limits in millimetres? URDFs have metres" in note
    assert sliding("0.04") == []


def test_masses_in_grams_are_noticed(load: Load) -> None:
    def weighing(mass: float) -> list[str]:
        inertial = f'<inertial><mass value="{mass}"/></inertial></link>'
        hand = load(GRIPPER.replace("</link>", inertial))
        return [note for note in hand.notes if "weighs" in note]

    (note,) = weighing(40.0)
    assert "weighs 40 kg (2 links of fingers weigh more than 5 kg); is its mass in grams?" in note
    assert weighing(0.04) == []


def test_continuous_and_prismatic(load: Load) -> None:
    text = changed(LIMIT, "").replace('"left" type="revolute"', '"left" type="continuous"')
    hand = load(text.replace('"right" type="revolute"', '"right" type="prismatic"'))
    left, right = hand.actuators
    assert (left.kind, left.lower, left.upper, left.rest) == ("continuous", -math.inf, math.inf, 0)
    assert left.velocity == 1.0
    assert left.effort == math.inf
    assert (right.kind, right.upper) == ("prismatic", 0.8)
    assert hand.notes[0].startswith("no velocity limit for actuator 'left'; 1 rad/s is assumed")


def test_assumed_velocities_are_one_note(load: Load) -> None:
    prismatic = GRIPPER.replace('"right" type="revolute"', '"right" type="prismatic"')
    (note,) = [n for n in load(prismatic.replace(' velocity="2"', "")).notes if "velocity" in n]
    both = "no velocity limit for actuator 'left' and 1 more; 1 rad/s and 0.1 m/s is assumed"
    assert note.startswith(both)


def test_transmission_elements_are_no_joints(load: Load) -> None:
    text = changed("</robot>", '<transmission name="t"><joint name="left"/></transmission></robot>')
    assert len(load(text).joints) == 2


def test_text_in_other_encodings(tmp_path: Path) -> None:
    file = tmp_path / "gripper.urdf"
    text = GRIPPER.replace("?>", ' encoding="latin-1"?>', 1).replace("palm", "Handfläche")
    file.write_bytes(text.encode("latin-1"))
    assert read_urdf(file).root == "Handfläche"
    file.write_bytes(b"\xef\xbb\xbf" + GRIPPER.encode())
    assert read_urdf(file).root == "palm"


# --- wrong files: the change, the message, and where the error should point ----------------------

WRONG = [
    (LIMIT, "", "joint 'left' is revolute, so it needs a <limit>", '<joint name="left"'),
    (LIMIT, "<limit/>", "actuator 'left' has empty limits", '<joint name="left"'),
    ('upper="0.8"', 'upper="-1"', "lower limit 0 above its upper limit -1", 'upper="-1"'),
    ('upper="0.8"', 'upper="nan"', 'upper="nan" is not a finite number', 'upper="nan"'),
    ('upper="0.8"', 'upper="1e400"', "is not a finite number", 'upper="1e400"'),
    ('upper="0.8"', 'upper="1e7"', 'upper="1e7" is beyond 1e+06, the largest', 'upper="1e7"'),
    ('xyz="-0.04 0 0.01"', 'xyz="-4e3 0 0"', 'xyz="-4e3" is beyond 1000', 'xyz="-4e3'),
    ('"0.1 0.1 0.02"', '"1e20 1 1"', 'size="1e20" is beyond 1000, the largest', '"1e20'),
    ('upper="0.8"', 'upper="wide"', 'upper="wide" is not a finite number', 'upper="wide"'),
    ('velocity="2"', 'velocity="-2"', "negative velocity limit", 'velocity="-2"'),
    ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', "axis of joint 'left' is zero", '"0 0 0"'),
    ('xyz="-0.04 0 0.01"', 'xyz="-0.04 0"', "should be 3 numbers", 'xyz="-0.04 0"'),
    ('<child link="left_jaw"/>', "", "joint 'left' has no <child>", '<joint name="left"'),
    ('<child link="left_jaw"/>', '<child link="jaw"/>', "unknown link 'jaw'", 'link="jaw"'),
    ('type="revolute"', 'type="ball"', "has the type 'ball'", 'type="ball"'),
    ('type="revolute"', "", "<joint> needs the attribute 'type'", '<joint name="left"'),
    ('name="left"', 'name="right"', "joint 'right' is defined twice, first in line", None),
    ('name="left_jaw"', 'name="palm"', "link 'palm' is defined twice, first in line 3", None),
    ('<child link="left_jaw"/>', '<child link="right_jaw"/>', "hangs on two joints", None),
    ("</robot>", '<link name="loose"/></robot>', "both have no parent", '"loose"'),
    ("</robot>", "", "URDF is not XML: no element found", None),
    ('<box size="0.1 0.1 0.02"/>', "", "of link 'palm' has no geometry", None),
    (
        '<box size="0.1 0.1 0.02"/>',
        '<box size="0 1 1"/>',
        "dimension that is not positive",
        "0 1 1",
    ),
    ('<box size="0.1 0.1 0.02"/>', "<cone/>", "unknown geometry <cone> of link 'palm'", "<cone/>"),
    ('<box size="0.1 0.1 0.02"/>', "<mesh/>", "<mesh> needs the attribute 'filename'", "<mesh/>"),
    (
        '<box size="0.1 0.1 0.02"/>',
        '<mesh filename="a.stl" scale="0 1 1"/>',
        "the mesh's scale is zero",
        "<mesh",
    ),
    (
        "</robot>",
        '<link name="a"><inertial><mass value="-7"/></inertial></link></robot>',
        "a mass of -7 kg is negative",
        "-7",
    ),
    ('<robot name="gripper">', "<robot><xacro:x/>", "end with .xacro", None),
]


@pytest.mark.parametrize(("old", "new", "message", "place"), WRONG)
def test_wrong_urdf(load: Load, old: str, new: str, message: str, place: str | None) -> None:
    text = changed(old, new)
    with pytest.raises(ModelError, match=re.escape(message)) as caught:
        load(text)
    assert caught.value.exit_status == 2
    assert caught.value.path is not None
    assert "\n" not in str(caught.value)
    assert caught.value.line is not None
    if place is not None:
        assert caught.value.line == line_of(text, place)


def test_loop_of_joints(load: Load) -> None:
    text = changed(
        '<parent link="palm"/><child link="left', '<parent link="left_jaw"/><child link="left'
    )
    with pytest.raises(ModelError, match="joint 'left' is part of a loop"):
        load(text, None)


def test_messages_are_one_line_whatever_stands_in_the_file(load: Load) -> None:
    text = changed('xyz="-0.04 0 0.01"', 'xyz="&#x1b;[31m \u2028"'.replace("&#x1b;", "\u009b"))
    with pytest.raises(ModelError, match="is not printable") as caught:
        load(text)
    assert r"\x9b[31m \u2028" in str(caught.value)
    assert str(caught.value).isprintable()


def test_no_joint_is_an_actuator(load: Load) -> None:
    with pytest.raises(ModelError, match="no joint is an actuator"):
        load('<robot name="brick"><link name="brick"/></robot>', None)


LINKS = "".join(f"<link name='{number}'/>" for number in range(301))
BOX = "<collision><geometry><box size='1 1 1'/></geometry></collision>"


@pytest.mark.parametrize(
    ("root", "message"),
    [
        ("<sdf/>", "is an SDF, not a URDF"),
        ("<mujoco/>", "is a MuJoCo model, not a URDF"),
        ("<html/>", "is <html>, not a URDF"),
        ("<robot/>", "has 0 links instead of 1 to 300"),
        (f"<robot>{LINKS}</robot>", "has 301 links instead of 1 to 300"),
        (f"<robot><link name='a'>{BOX * 1001}</link></robot>", "has 1001 collision shapes"),
        ("", "URDF is not XML: no element found"),
        ("not xml", "URDF is not XML: syntax error"),
        ("<robot>\x00</robot>", "URDF is not XML"),
        ('<?xml version="1.0" encoding="klingon"?><robot/>', "URDF is not XML"),
        ("<a>" * 200 + "</a>" * 200, "nested deeper than 100"),
    ],
)
def test_not_a_urdf(load: Load, root: str, message: str) -> None:
    with pytest.raises(ModelError, match=re.escape(message)):
        load(root, None)


@pytest.mark.parametrize(
    "declaration",
    [
        '<!DOCTYPE r [<!ENTITY a "b">]>',
        '<!DOCTYPE r [<!ENTITY a "aa"><!ENTITY b "&a;&a;&a;">]>',
        '<!DOCTYPE r SYSTEM "file:///etc/passwd">',
        '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE r [<!ENTITY % x SYSTEM "file:///etc/passwd"> %x;]>',
    ],
)
def test_entities_are_refused(load: Load, declaration: str) -> None:
    text = changed('<?xml version="1.0"?>', f'<?xml version="1.0"?>{declaration}')
    with pytest.raises(ModelError, match="declares a document type or entities") as caught:
        load(text)
    assert caught.value.line == 1


def test_missing_file_and_folder_in_its_place(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="URDF does not exist") as caught:
        read_urdf(tmp_path / "none.urdf")
    assert caught.value.path == tmp_path / "none.urdf"
    with pytest.raises(ModelError, match="URDF cannot be read: is a directory"):
        read_urdf(tmp_path)
    with pytest.raises(ModelError, match="URDF cannot be read"):
        read_urdf("a\0b")


def test_path_to_an_unknown_link(load: Load) -> None:
    hand = load()
    with pytest.raises(UnknownLink, match="did you mean 'left_jaw'"):
        hand.urdf.path_to("left_jam")
    with pytest.raises(UnknownLink):
        hand.urdf.chain("nothing", "palm")
