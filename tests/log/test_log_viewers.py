"""What viewers need to show the hand in 3D: transforms, and a description with its meshes."""

from __future__ import annotations

import base64
import dataclasses
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from typer.testing import CliRunner

from log.samples import RATE, WALL, Time, recorded, settings, tick
from rtee.cli.log import app
from rtee.errors import ConfigError
from rtee.hand.embedded_meshes import embed_meshes, with_mesh_addresses
from rtee.hand.geometry import HandGeometry
from rtee.hand.kinematics import Kinematics
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand
from rtee.log import Recorder, read
from rtee.log.check import recorded_hand
from rtee.log.layout import Contents, Replayable
from rtee.log.playback import write_hand
from rtee.log.recover import recover
from rtee.log.settings import RecorderSettings
from rtee.log.writer import LinkTransforms, LogWriter
from rtee.loop.settings import LoopSettings
from rtee.running.prepare import RunOptions, prepare
from rtee.sample import FloatArray, TickRecord

ACCURACY = 1e-9


def known(hand: Hand, number: int, position: FloatArray) -> TickRecord:
    n = len(hand.actuators)
    sample = tick(number)
    zeros = np.zeros(n)
    return TickRecord(
        tick=number,
        stamp=sample.stamp,
        wall_ns=sample.wall_ns,
        position=position,
        velocity=zeros,
        effort=zeros,
        current=zeros,
        temperature=zeros,
        fresh=np.ones(n, dtype=bool),
        reference_position=position,
        reference_velocity=zeros,
        reference_effort=zeros,
        grasped=np.full(n, -1, dtype=np.int8),
        channels={},
    )


def record(
    hand: Hand, folder: Path, positions: FloatArray, *, meshes: bool = True, **changes: object
) -> Path:
    """Record a hand in one posture after the other, a tick each."""
    contents = Contents(hand, RATE, meshes=embed_meshes(hand) if meshes else embed_meshes(hand, 0))
    clock = Time()
    writer = LogWriter(
        contents, settings(folder, **changes), monotonic=clock.monotonic, wall=clock.wall
    )
    writer.start()
    for number, position in enumerate(positions):
        clock.now = tick(number).stamp
        writer.tick(known(hand, number, position))
        writer.poll()
    writer.close()
    return recorded(folder)[-1]


def postures(hand: Hand, count: int) -> FloatArray:
    return np.random.default_rng(3).uniform(hand.lower, hand.upper, (count, len(hand.actuators)))


def by_rosbags(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """All messages by topic as rosbags decodes them with the definitions in the file."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp, message))
    return found


def by_mcap(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """All messages by topic as mcap-ros2-support decodes them."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def matrix(transform: Any) -> FloatArray:
    """The transform as a matrix, by the definition of unit quaternions."""
    q, at = transform.rotation, transform.translation
    w, x, y, z = q.w, q.x, q.y, q.z
    assert np.linalg.norm([w, x, y, z]) == pytest.approx(1.0, abs=ACCURACY)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), at.x],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), at.y],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), at.z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def in_base(hand: Hand, *messages: Any) -> dict[str, FloatArray]:
    """Where all links are, put together from the transforms as a viewer does."""
    told = {each.child_frame_id: each for message in messages for each in message.transforms}
    poses: dict[str, FloatArray] = {hand.base: np.eye(4)}

    def pose(link: str) -> FloatArray:
        if link not in poses:
            each = told[link]
            poses[link] = pose(each.header.frame_id) @ matrix(each.transform)
        return poses[link]

    return {link: pose(link) for link in hand.urdf.links}


@pytest.mark.samples("*-by_mcap", "schunk-by_rosbags")
@pytest.mark.parametrize("reader", [by_rosbags, by_mcap])
@pytest.mark.parametrize("name", ["schunk", "heri_II", "qbhand", "dagana", "robotiq_3f"])
def test_transforms_put_every_link_where_pinocchio_does(
    name: str, reader: Any, shared: Path, tmp_path: Path
) -> None:
    folder = shared / "hands" / name
    hand = load_model(folder / f"{name}.urdf", folder / f"{name}.srdf")
    positions = postures(hand, 20)
    found = reader(record(hand, tmp_path, positions))
    kinematics = Kinematics(hand)
    static = [message for _, message in found.get("/tf_static", [])]
    assert len(found["/tf"]) == 10  # 50 of 100 ticks a second
    for number, (stamp, message) in enumerate(found["/tf"]):
        assert stamp == WALL + round(2 * number / RATE * 1e9)
        assert {
            t.header.stamp.sec * 10**9 + t.header.stamp.nanosec for t in message.transforms
        } == {stamp}
        expected = kinematics.placements(positions[2 * number])
        for link, pose in in_base(hand, message, *static).items():
            np.testing.assert_allclose(pose, expected[link], atol=ACCURACY)


def test_sliders_and_fixed_joints_are_told_too() -> None:
    kinds = {
        joint.kind
        for name in ("schunk_svh", "leap_hand", "cia402_gripper")
        for joint in load_hand(name).urdf.joints.values()
    }
    assert {"prismatic", "revolute", "fixed"} <= kinds


@pytest.mark.parametrize("name", ["schunk_svh", "leap_hand", "cia402_gripper"])
def test_hands_of_shapes_alone_as_well(name: str, tmp_path: Path) -> None:
    hand = load_hand(name)
    positions = postures(hand, 3)
    found = by_rosbags(record(hand, tmp_path, positions, tf_rate=RATE))
    static = [message for _, message in found.get("/tf_static", [])]
    for position, (_, message) in zip(positions, found["/tf"], strict=True):
        expected = Kinematics(hand).placements(position)
        for link, pose in in_base(hand, message, *static).items():
            np.testing.assert_allclose(pose, expected[link], atol=ACCURACY)


def test_what_is_not_measured_stays_where_it_was(claw: Hand, tmp_path: Path) -> None:
    positions = np.array([[0.3, np.nan], [np.nan, 0.5], [np.nan, np.nan]])
    found = by_rosbags(record(claw, tmp_path, positions, tf_rate=RATE))
    angles = [
        {t.child_frame_id: 2 * np.arctan2(t.transform.rotation.y, t.transform.rotation.w)
         for t in message.transforms}
        for _, message in found["/tf"]
    ]  # fmt: skip
    assert [each["a"] for each in angles] == pytest.approx([0.3, 0.3, 0.3])
    assert [each["b"] for each in angles] == pytest.approx([0.0, 0.5, 0.5])
    assert [each["a2"] for each in angles] == pytest.approx([1.5 * 0.3 + 0.25] * 3)


@pytest.mark.parametrize(
    ("rate", "decimation", "expected"), [(0.0, 1, 0), (10.0, 1, 10), (1e4, 1, 100), (10.0, 3, 12)]
)
def test_how_often_is_settable(
    claw: Hand, tmp_path: Path, rate: float, decimation: int, expected: int
) -> None:
    positions = np.zeros((100, 2))
    path = record(claw, tmp_path, positions, tf_rate=rate, decimation=decimation)
    assert len(by_rosbags(path).get("/tf", [])) == expected


def test_a_missed_tick_costs_no_transform(claw: Hand) -> None:
    transforms = LinkTransforms(claw, 1000.0, RecorderSettings())
    assert [n for n in [*range(19), *range(21, 45), *range(90, 101)] if transforms.due(n)] == [
        0,
        21,
        40,
        90,
        100,
    ]


# --- the description ----------------------------------------------------------------------------


def addresses(text: str) -> list[str]:
    return [element.attrib["filename"] for element in ET.fromstring(text).iter("mesh")]


MEDIA = {".dae": "model/vnd.collada+xml", ".stl": "model/stl", ".obj": "model/obj"}


@pytest.mark.samples("hands-robotiq_3f", "more_hands-leap_right")  # all formats
@pytest.mark.parametrize(
    ("room", "name"),
    [("hands", "schunk"), ("hands", "robotiq_3f"), ("more_hands", "leap_right")],
)
def test_the_description_carries_its_meshes(
    room: str, name: str, shared: Path, tmp_path: Path
) -> None:
    folder = shared / room / name
    hand = load_model(folder / f"{name}.urdf")
    found = by_rosbags(record(hand, tmp_path, postures(hand, 2)))
    written = addresses(hand.urdf.text)
    ((_, description),) = found["/robot_description"]
    inside = addresses(description.data)
    assert len(inside) == len(written) > 0
    for old, new in zip(written, inside, strict=True):
        head, _, content = new.partition(",")
        assert head == f"data:{MEDIA[Path(old).suffix.lower()]};base64"
        assert base64.b64decode(content, validate=True) == (folder / old).read_bytes()
    ((_, with_paths),) = found[f"/{hand.name}/urdf"]
    for old, new in zip(written, addresses(with_paths.data), strict=True):
        parts = urlparse(new)
        assert parts.scheme == "file"
        assert Path(unquote(parts.path)).samefile(folder / old)


def test_meshes_are_attached_and_named(shared: Path, tmp_path: Path) -> None:
    folder = shared / "hands" / "schunk"
    hand = load_model(folder / "schunk.urdf")
    path = record(hand, tmp_path, postures(hand, 2))
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        attached = {each.name: each for each in reader.iter_attachments()}
        named = {each.name: each.metadata for each in reader.iter_metadata()}["meshes"]
    assert set(named) == set(addresses(hand.urdf.text))
    for address, name in named.items():
        assert attached[name].data == (folder / address).read_bytes()
        assert attached[name].media_type == "model/vnd.collada+xml"
    assert attached["schunk.urdf"].data == hand.urdf.text.encode()


def test_the_hand_can_be_unpacked_where_its_files_are_not(shared: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(shared / "hands" / "robotiq_3f", source)
    hand = load_model(source / "robotiq_3f.urdf", name="three")
    expected = {link: HandGeometry(hand).triangles(link)[0] for link in hand.urdf.links}
    path = record(hand, tmp_path / "log", postures(hand, 2))
    assert read(path).urdf == hand.urdf.text
    shutil.rmtree(source)
    done = CliRunner().invoke(app, ["unpack", str(path), str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    unpacked = load_hand(tmp_path / "out" / "three")
    geometry = HandGeometry(unpacked)
    for link, vertices in expected.items():
        np.testing.assert_array_equal(geometry.triangles(link)[0], vertices)
    for address in addresses(unpacked.urdf.text):
        assert address.startswith("file:///")
    again = CliRunner().invoke(app, ["unpack", str(path), str(tmp_path / "out")])
    assert again.exit_code != 0
    assert "exists already" in str(again.exception)


def test_names_that_leave_the_folder_are_refused_and_nothing_is_written(
    claw: Hand, tmp_path: Path
) -> None:
    recording = read(record(claw, tmp_path / "log", np.zeros((1, 2))))
    names = {"a.stl": "meshes/a.stl", "evil": "meshes/../../evil.stl", "else": "elsewhere/b.stl"}
    attached = {**recording.attachments, **dict.fromkeys(names.values(), b"x")}
    changed = dataclasses.replace(recording, meshes=names, attachments=attached)
    with pytest.raises(ConfigError, match="mesh name"):
        write_hand(changed, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    del names["evil"]
    home = write_hand(changed, tmp_path / "out")
    assert [path.name for path in (home / "meshes").iterdir()] == ["a.stl"]


def test_the_recorder_carries_meshes_unless_told_not_to(
    shared: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = tmp_path / "source"
    shutil.copytree(shared / "hands" / "robotiq_2f_85", source)
    hand = load_model(source / "robotiq_2f_85.urdf")
    first, *_ = addresses(hand.urdf.text)
    (source / first).unlink()
    for meshes in (True, False):
        folder = tmp_path / str(meshes)
        with Recorder(hand, settings(folder, meshes=meshes), rate=RATE) as recorder:
            recorder.on_tick(known(hand, 0, hand.rest))
        recording = read(recorded(folder)[0])
        assert bool(recording.meshes) is meshes
        assert any(name.startswith("meshes/") for name in recording.attachments) is meshes
    (said,) = [each.getMessage() for each in caplog.records]
    assert f"the mesh '{first}' is not in the recording" in said


def test_hand_yaml_says_how(repository: Path, tmp_path: Path) -> None:
    shutil.copytree(repository / "config" / "robotiq_2f_85", tmp_path / "robotiq_2f_85")
    file = tmp_path / "robotiq_2f_85" / "hand.yaml"
    before = prepare(str(file.parent), RunOptions()).recorder_settings(RunOptions())
    assert (before.tf_rate, before.meshes) == (50.0, True)
    file.write_text(file.read_text() + "\nlog: {tf_rate: 20, meshes: false}\n")
    after = prepare(str(file.parent), RunOptions()).recorder_settings(RunOptions())
    assert (after.tf_rate, after.meshes) == (20.0, False)


def test_unpacking_again_and_recovering_keep_the_meshes(shared: Path, tmp_path: Path) -> None:
    folder = shared / "hands" / "robotiq_2f_85"
    hand = load_model(folder / "robotiq_2f_85.urdf")
    path = record(hand, tmp_path / "log", postures(hand, 40))
    whole = read(path)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-2000])
    recover(cut, in_place=True)
    found = read(cut)
    assert found.meshes == whole.meshes != {}
    assert found.attachments == whole.attachments
    assert len(by_rosbags(cut)["/tf"]) > 0


def test_a_missing_mesh_is_told_and_the_rest_is_carried(shared: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(shared / "hands" / "schunk", source)
    (source / "meshes" / "base10.dae").unlink()
    hand = load_model(source / "schunk.urdf")
    found = embed_meshes(hand)
    assert list(found.left_out) == ["meshes/base10.dae"]
    assert "does not exist" in found.left_out["meshes/base10.dae"]
    path = record(hand, tmp_path / "log", postures(hand, 1))
    ((_, description),) = by_rosbags(path)["/robot_description"]
    rest = {each.partition(":")[0] for each in addresses(description.data)}
    assert rest == {"data", "meshes/base10.dae"}


def test_too_much_is_left_out(shared: Path, tmp_path: Path) -> None:
    folder = shared / "hands" / "schunk"
    hand = load_model(folder / "schunk.urdf")
    some = embed_meshes(hand, 1_000_000)
    carried = sum(len(mesh.data) for mesh in some.files.values())
    assert 0 < carried < 750_000
    assert some.left_out
    assert all("more than 1 MB" in why for why in some.left_out.values())
    path = record(hand, tmp_path, postures(hand, 1), meshes=False)
    assert read(path).meshes == {}
    ((_, description),) = by_rosbags(path)["/robot_description"]
    assert description.data == hand.urdf.text


def test_two_meshes_of_one_name_stay_apart(tmp_path: Path) -> None:
    text = """<robot name="r"><link name="a">
      <visual><geometry><mesh filename="one/tip.stl"/></geometry></visual>
      <collision><geometry><mesh scale="1 1 1" filename='two/tip.stl'/></geometry></collision>
    </link><link name="b">
      <visual><geometry><mesh filename="one/a &amp; b.stl"/></geometry></visual>
    </link><joint name="j" type="revolute"><parent link="a"/><child link="b"/>
      <axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint></robot>"""
    for name, data in (("one/tip", b"first"), ("two/tip", b"second"), ("one/a & b", b"third")):
        file = tmp_path / f"{name}.stl"
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(data)
    (tmp_path / "r.urdf").write_text(text)
    meshes = embed_meshes(load_model(tmp_path / "r.urdf"))
    assert {address: mesh.data for address, mesh in meshes.meshes.items()} == {
        "one/tip.stl": b"first",
        "two/tip.stl": b"second",
        "one/a & b.stl": b"third",
    }
    assert len(meshes.files) == 3
    changed = with_mesh_addresses(text, {"one/a & b.stl": 'x"&y', "two/tip.stl": "z"})
    assert addresses(changed) == ["one/tip.stl", "z", 'x"&y']


def test_the_model_of_a_recording_is_the_one_that_was_read(shared: Path, tmp_path: Path) -> None:
    """References are recomputed with the URDF as it was, not with the one with data in it."""
    folder = shared / "hands" / "robotiq_2f_85"
    hand = load_model(folder / "robotiq_2f_85.urdf")
    recording = read(record(hand, tmp_path, postures(hand, 2)))
    again = recorded_hand(recording, Replayable(LoopSettings(), hand.actuators))
    assert again.urdf.text == hand.urdf.text
    assert again.joint_names == hand.joint_names
    np.testing.assert_array_equal(again.transmission.matrix, hand.transmission.matrix)


def test_readers_leave_transforms_alone_unless_asked(claw: Hand, tmp_path: Path) -> None:
    path = record(claw, tmp_path, np.zeros((10, 2)))
    recording = read(path)
    assert len(recording.joint_states) == 10
    assert not recording.notes
