"""URDF 1.1 and 1.2, soft limits, and what a file says that is not read."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hand.robots import Robot, box, fingers, jaws, linkage
from rtee.errors import ConfigError, ModelError
from rtee.hand.frames import origin
from rtee.hand.geometry import HandGeometry
from rtee.hand.load import load_hand, load_model
from rtee.hand.srdf import read_srdf
from rtee.hand.urdfread import read_urdf
from rtee.hand.vocabulary import URDF, unread
from rtee.hand.xmlfile import Element, read_xml

ORIGIN = '<robot name="r" version="1.1"><link name="a"/><link name="b"/><joint name="j" type="fixed"><parent link="a"/><child link="b"/><origin xyz="0.1 0 0.2" {}/></joint></robot>'  # noqa: E501


def turned(tmp_path: Path, text: str) -> np.ndarray:
    path = tmp_path / "r.urdf"
    path.write_text(ORIGIN.format(text))
    joint = read_urdf(path).joints["j"]
    return origin(joint.xyz, joint.rpy)[:3, :3]


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternions_turn_as_pinocchio_says(
    tmp_path_factory: pytest.TempPathFactory, quaternion: list[float]
) -> None:
    tmp_path = tmp_path_factory.mktemp("quaternion", numbered=True)
    q = np.array(quaternion) / np.linalg.norm(quaternion)
    found = turned(tmp_path, f'quat_xyzw="{" ".join(map(str, quaternion))}"')
    assert found == pytest.approx(pin.Quaternion(q[3], q[0], q[1], q[2]).matrix(), abs=1e-7)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
@pytest.mark.parametrize("roll", [0.0, 1.0, -2.5])
def test_a_quaternion_of_a_quarter_turn_up(tmp_path: Path, pitch: float, roll: float) -> None:
    truth = pin.rpy.rpyToMatrix(roll, pitch, 0.3)
    values = pin.Quaternion(truth).coeffs()
    found = turned(tmp_path, f'quat_xyzw="{" ".join(map(repr, values.tolist()))}"')
    assert found == pytest.approx(truth, abs=1e-7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('quat_xyzw="0 0 0 0"', "gives no orientation"),
        ('quat_xyzw="0 0 1"', "should be 4 numbers"),
        ('rpy="0 0 0" quat_xyzw="0 0 0 1"', "both rpy and quat_xyzw"),
    ],
)
def test_a_wrong_orientation_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ModelError, match=message) as refused:
        turned(tmp_path, text)
    assert refused.value.line == 1


CAPSULE = (
    '<origin xyz="0.01 0 0.02" rpy="0.3 0.5 0.7"/><geometry><{} radius="0.006" length="0.04"/>'
    "</geometry>"
)


def test_a_capsule_is_that_of_pinocchio(tmp_path: Path) -> None:
    robot = Robot("own").link("base", box(0.1, 0.1, 0.02)).link("tip", CAPSULE.format("capsule"))
    path = robot.joint("j", "base", "tip").write(tmp_path)
    path.write_text(path.read_text().replace('"own"', '"own" version="1.1"'))
    model = pin.buildModelFromUrdf(str(path))
    judge = pin.buildGeomFromUrdf(model, str(path), pin.COLLISION)
    capsule = next(o for o in judge.geometryObjects if o.name.startswith("tip"))
    geometry = HandGeometry(load_model(path))
    shapes = [geometry.shapes[i] for i in geometry.of_links("tip")]
    assert [shape.source.kind for shape in shapes] == ["cylinder", "sphere", "sphere"]
    assert shapes[0].source.length == pytest.approx(2.0 * capsule.geometry.halfLength)
    for shape, end in zip(shapes, (0.0, -0.02, 0.02), strict=True):
        there = capsule.placement * pin.SE3(np.eye(3), np.array([0.0, 0.0, end]))
        assert shape.placement.translation == pytest.approx(there.translation, abs=1e-12)
        assert shape.source.radius == capsule.geometry.radius


def test_a_capsule_of_a_program_is_the_same_one(tmp_path: Path) -> None:
    shapes = []
    for tag in ("capsule", "drake:capsule"):
        robot = Robot("own").link("tip", CAPSULE.format(tag))
        path = robot.write(tmp_path)
        path.write_text(path.read_text().replace('"own"', '"own" xmlns:drake="http://drake"'))
        shapes.append(read_urdf(path).links["tip"].collisions)
    assert shapes[0] == shapes[1]


def limited(tmp_path: Path, attributes: str, yaml: str = "") -> Path:
    """Return the folder of a gripper whose limits have further attributes."""
    text = jaws().text.replace('effort="5"', f'effort="5" {attributes}')
    (tmp_path / "jaws.urdf").write_text(text)
    (tmp_path / "hand.yaml").write_text(f"name: jaws\nurdf: jaws.urdf\n{yaml}")
    return tmp_path


def test_acceleration_and_jerk_of_a_urdf_are_limits(tmp_path: Path) -> None:
    more = 'acceleration="8" deceleration="6" jerk="90"'
    actuator = load_hand(limited(tmp_path, more)).actuators[0]
    assert (actuator.acceleration, actuator.jerk) == (6.0, 90.0)
    lower = "limits: {defaults: {acceleration: 20.0, jerk: 50.0}}\n"
    actuator = load_hand(limited(tmp_path, more, lower)).actuators[0]
    assert (actuator.acceleration, actuator.jerk) == (6.0, 50.0)
    with pytest.raises(ConfigError, match="above the URDF's acceleration limit 6"):
        load_hand(limited(tmp_path, more, "limits: {left_joint: {acceleration: 7.0}}\n"))
    with pytest.raises(ModelError, match="negative jerk limit"):
        load_hand(limited(tmp_path, 'jerk="-1"'))


def soft(tmp_path: Path, values: str, yaml: str = "") -> Path:
    text = jaws().text.replace("</joint>", f"<safety_controller {values}/></joint>")
    (tmp_path / "jaws.urdf").write_text(text)
    (tmp_path / "hand.yaml").write_text(f"name: jaws\nurdf: jaws.urdf\n{yaml}")
    return tmp_path


SOFT = 'soft_lower_limit="0.1" soft_upper_limit="0.7" k_position="20" k_velocity="20"'


@pytest.mark.parametrize(
    ("values", "yaml", "range_"),
    [
        (SOFT, "", (0.1, 0.7)),
        (SOFT, "limits: {defaults: {range: hard}}\n", (0.0, 0.9)),
        (SOFT, "limits: {left_joint: {range: hard, upper: 0.8}}\n", (0.0, 0.8)),
        (SOFT, "limits: {left_joint: {upper: 0.5}}\n", (0.1, 0.5)),
        ('soft_lower_limit="-1" soft_upper_limit="0.7" k_velocity="20"', "", (0.0, 0.7)),
        ('k_velocity="20"', "", (0.0, 0.9)),
    ],
)
def test_soft_limits_hold_unless_hand_yaml_says_hard(
    tmp_path: Path, values: str, yaml: str, range_: tuple[float, float]
) -> None:
    hand = load_hand(soft(tmp_path, values, yaml))
    actuator = hand.actuator("left_joint")
    assert (actuator.lower, actuator.upper) == range_
    told = any("soft limits of <safety_controller> hold" in note for note in hand.notes)
    assert told == (hand.actuator("right_joint").upper == 0.7)


def test_values_beyond_the_soft_limits_are_refused_with_the_way_out(tmp_path: Path) -> None:
    folder = soft(tmp_path, SOFT, "limits: {left_joint: {upper: 0.8}}\n")
    with pytest.raises(ConfigError, match=r"soft limits 0\.1 … 0\.7; `range: hard` takes"):
        load_hand(folder)
    with pytest.raises(ModelError, match="the soft limits 2 … 3 leave nothing of 0 …"):
        load_hand(soft(tmp_path, 'soft_lower_limit="2" soft_upper_limit="3"'))


def test_a_posture_of_the_srdf_beyond_the_soft_limits_is_told(tmp_path: Path) -> None:
    soft(tmp_path, SOFT)
    srdf = tmp_path / "jaws.srdf"
    srdf.write_text(
        '<robot name="jaws"><group name="g"><joint name="left_joint"/></group>'
        '<group_state name="open" group="g"><joint name="left_joint" value="0.05"/></group_state>'
        "</robot>"
    )
    hand = load_model(tmp_path / "jaws.urdf", srdf)
    assert hand.rest[0] == 0.1
    assert any("rest position 0.05 lies beyond the soft limits" in note for note in hand.notes)


def models(shipped: Path) -> Iterator[tuple[str, str]]:
    """Return ten models of different kinds, as URDF."""
    yield "jaws", jaws().text
    yield "linkage", linkage().text
    yield "fingers", fingers(Robot(), ("thumb", "index", "middle")).text
    names = ("schunk_svh", "qb_softhand", "robotiq_2f_85", "heri_ii", "dagana", "wsg50", "allegro")
    for name in names:
        yield name, (shipped / name / f"{name}.urdf").read_text()


EXTENSIONS = """<transmission name="t"><type>x</type><joint name="left_joint"><hardwareInterface>p
</hardwareInterface></joint><actuator name="m"/></transmission><gazebo reference="left_distal"><mu1>
1</mu1><sensor name="s" type="contact"><plugin name="p" filename="f"/></sensor></gazebo>
<ros2_control name="c" type="system"><joint name="left_joint"><param name="min">0</param></joint>
</ros2_control><material name="red"><color rgba="1 0 0 1"/></material></robot>"""


def elements_of(root: Element, parent: str = "") -> Iterator[tuple[str, Element]]:
    """Yield all elements with the names of their parents and themselves."""
    yield f"{parent}/{root.tag}", root
    for child in root.children:
        yield from elements_of(child, root.tag)


def test_no_unknown_attribute_passes_without_a_note(repository: Path, tmp_path: Path) -> None:
    path, draw = tmp_path / "r.urdf", random.Random(3)
    for name, text in models(repository / "config"):
        path.write_text(text.replace("</robot>", EXTENSIONS))
        root, _ = read_xml(path, "URDF")
        assert read_urdf(path).unread == (), name
        kinds: dict[str, list[Element]] = {}
        for kind, element in elements_of(root):
            kinds.setdefault(kind, []).append(element)
        # One element of each kind in turn, so that a note of one does not hide another's.
        for kind, elements in kinds.items():
            element = draw.choice(elements)
            element.attributes["unheard_of"] = "1"
            (note,) = unread(root, URDF)
            assert f"'unheard_of' of <{element.tag}>" in note, (name, kind)
            assert f"line {element.line} of r.urdf" in note
            del element.attributes["unheard_of"]


def test_no_unknown_element_passes_without_a_note(repository: Path, tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    for _, text in models(repository / "config"):
        path.write_text(text)
        root, _ = read_xml(path, "URDF")
        for kind, element in dict(elements_of(root)).items():
            element.children.append(Element("unheard_of", {}, 7, path))
            (note,) = unread(root, URDF)
            assert "<unheard_of> in" in note, kind
            element.children.pop()


@pytest.mark.parametrize(
    ("where", "added", "note"),
    [
        ("</link>", "<inertial/><inertial/></link>", "a second <inertial> in <link>"),
        ("</joint>", '<axis xyz="1 0 0"/></joint>', "a second <axis> in <joint>"),
        ("</joint>", '<dynamics damping="1"/></joint>', "'damping' of <dynamics> is not read"),
        ("</robot>", '<loop_joint name="l"/></robot>', "<loop_joint> in <robot> is not read"),
        (
            "</robot>",
            '<gazebo><joint name="loop" type="revolute"/></gazebo></robot>',
            "<joint> in <gazebo>",
        ),
    ],
)  # fmt: skip
def test_what_is_physical_and_not_read_is_noted_with_its_line(
    tmp_path: Path, where: str, added: str, note: str
) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(jaws().text.replace(where, added))
    notes = [each for each in load_model(path).notes if note in each]
    assert len(notes) == 1
    assert "of r.urdf" in notes[0]
    assert ("more)" in notes[0]) == (where != "</robot>")


def test_the_same_in_an_mjcf(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    from rtee.exchange.mjcf_import import import_mjcf

    path = tmp_path / "m.xml"
    path.write_text(
        '<mujoco><worldbody><body name="a"><joint name="j" range="0 1"\n damping="0.1"/>'
        '<geom type="box" size="1 1 1" friction="2"/></body></worldbody></mujoco>'
    )
    notes = [note for note in import_mjcf(path, tmp_path).notes if "is not read" in note]
    assert len(notes) == 2
    assert any("'damping' of <joint> is not read (line 1 of m.xml)" in note for note in notes)


def test_the_same_in_an_srdf(tmp_path: Path) -> None:
    path = tmp_path / "r.srdf"
    path.write_text('<robot name="r">\n<enable_collisions link1="a" link2="b"/>\n</robot>')
    assert read_srdf(path).unread == (
        "<enable_collisions> in <robot> is not read (line 2 of r.srdf)",
    )
