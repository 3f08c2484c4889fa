from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer

from log.samples import (
    BEGIN,
    COMMAND,
    GOAL,
    RATE,
    RESULT,
    STATISTICS,
    STATUS,
    TIMED,
    WALL,
    Log,
    recorded,
    settings,
    tick,
)
from rtee.errors import LogError
from rtee.hand.model import Hand
from rtee.log import column_reader, read, reader
from rtee.log.recorder import RecorderSettings
from rtee.messages import encode_string, message_type
from rtee.messages.layout import joint_state_fields
from rtee.messages.schema import recorded_type
from rtee.messages.state import actuator_state_fields


def test_pieces_hold_what_the_whole_does(
    claw: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Log(claw, settings(tmp_path, max_file_time=1.0)).story()
    whole = read(tmp_path)
    assert len(whole.paths) == 2
    monkeypatch.setattr(reader, "_WINDOW", 300_000_000)
    pieces = list(reader.windows(tmp_path))
    assert len(pieces) == 4, "a chunk is of half a second"
    for name in ("goals", "plans", "commands", "feedback", "results", "events", "device_status"):
        found = [entry for piece in pieces for entry in getattr(piece, name)]
        assert [repr(entry) for entry in found] == [repr(entry) for entry in getattr(whole, name)]
    for topic, quantity in (("joint_states", "effort"), ("actuator_states", "tick")):
        parts = [getattr(getattr(piece, topic), quantity) for piece in pieces]
        assert np.concatenate(parts).tobytes() == getattr(getattr(whole, topic), quantity).tobytes()
    assert {(piece.start, piece.end) for piece in pieces} == {(whole.start, whole.end)}
    (middle,) = reader.windows(tmp_path, only=["reference"], start=0.61, end=0.7)
    inside = (whole.reference.t >= 0.61) & (whole.reference.t <= 0.7)
    assert middle.reference.t.tolist() == whole.reference.t[inside].tolist()
    assert not len(middle.actuator_states)


def test_arrays_are_what_the_loop_told_bit_for_bit(story: Path) -> None:
    recording = read(story)
    states, reference = recording.actuator_states, recording.reference
    assert len(states) == len(reference) == len(recording.joint_states) == 200
    assert states.names == reference.names == ("first", "second")
    assert states.tick.tolist() == list(range(200))
    for number in range(200):
        told = tick(number)
        assert states.time[number] == told.stamp
        assert states.wall[number] == told.wall_ns
        for name in (
            "position",
            "velocity",
            "effort",
            "current",
            "temperature",
            "grasped",
            "fresh",
        ):
            assert getattr(states, name)[number].tobytes() == getattr(told, name).tobytes()
        for name in ("position", "velocity", "effort"):
            expected = getattr(told, f"reference_{name}")
            assert getattr(reference, name)[number].tobytes() == expected.tobytes()


def test_joint_states_hold_all_joints(story: Path) -> None:
    joints = read(story).joint_states
    assert joints.names == ("first", "second", "first_far", "second_far")
    first, second = joints.position[:, 0], joints.position[:, 1]
    assert joints.position[:, 2] == pytest.approx(1.5 * first + 0.25, rel=1e-7)
    assert joints.position[:, 3] == pytest.approx(second**2, rel=1e-7)
    assert joints.velocity[:, 2] == pytest.approx(1.5 * joints.velocity[:, 0], rel=1e-7)
    slope = 2 * second * joints.velocity[:, 1]
    assert joints.velocity[:, 3] == pytest.approx(slope, rel=1e-6, abs=1e-9)
    assert np.isnan(joints.effort[:, 2:]).all()
    assert joints.effort[:, 0] == pytest.approx(first + 10)


def test_everything_else_is_there(story: Path, claw: Hand) -> None:
    recording = read(story)
    assert recording.hand == "claw"
    assert recording.finished
    assert recording.notes == ()
    assert recording.rate == RATE
    assert recording.urdf == claw.urdf.text
    assert recording.attachments["hand.yaml"] == b"name: claw\n"
    assert [entry.value for entry in recording.goals] == [GOAL, TIMED]
    assert recording.goals[0].t == pytest.approx(0.2)
    assert recording.goals[0].stamp == BEGIN + 0.2
    assert recording.results[0].value == RESULT
    assert [entry.value for entry in recording.commands] == [COMMAND]
    assert [entry.value for entry in recording.device_status] == [STATUS]
    assert [entry.value for entry in recording.loop_statistics] == [STATISTICS]
    assert [entry.value.text for entry in recording.marks] == ["look here"]
    assert recording.start == WALL
    assert recording.duration == pytest.approx(1.99)
    channel = recording.channels["motor/pressure"]
    assert channel.values[120].tolist() == [2.0, 1.0]
    assert channel.t[120] == pytest.approx(1.2)


def test_spans_tell_what_ran_when(story: Path) -> None:
    first, second = read(story).spans
    assert (first.name, first.outcome, first.inner) == ("Trig one", "reached", ())
    assert (first.start, first.end) == (pytest.approx(0.2), pytest.approx(0.69))
    assert (second.name, second.outcome) == ("drill", "held")
    assert [(span.name, span.outcome) for span in second.inner] == [
        ("close", "reached"),
        ("pull", "held"),
    ]
    assert second.inner[0].end == second.inner[1].start == pytest.approx(1.2)


def test_a_goal_without_a_result_is_running(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path))
    log.run(0, 10)
    log.writer.item(GOAL, log.time.now)
    log.run(10, 30)
    log.writer.close()
    (span,) = read(recorded(tmp_path)[0]).spans
    assert span.outcome == "running"
    assert span.end == pytest.approx(0.29)


def test_a_goal_whose_result_was_lost_ended_when_the_next_began(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path))
    log.run(0, 10)
    log.writer.item(GOAL, log.time.now)
    log.run(10, 30)
    log.writer.item(replace(GOAL, goal_id="next"), log.time.now)
    log.run(30, 40)
    log.writer.close()
    first, second = read(recorded(tmp_path)[0]).spans
    assert (first.end, first.outcome) == (second.start, "unknown")
    assert second.outcome == "running"


def test_only_what_is_asked_for_is_read(story: Path) -> None:
    recording = read(story, only=["reference"])
    assert len(recording.reference) == 200
    assert len(recording.joint_states) == len(recording.goals) == 0
    with pytest.raises(LogError, match="unknown topics"):
        read(story, only=["referenz"])
    for only in ("reference", 3, [3]):
        with pytest.raises(LogError, match="the topics must be a list of names"):
            read(story, only=only)  # type: ignore[arg-type]


def test_a_name_that_no_file_can_have_is_said() -> None:
    with pytest.raises(LogError, match="cannot be read: file name too long"):
        read("a" * 300)


def test_a_file_that_is_given_twice_is_read_once(story: Path, tmp_path: Path) -> None:
    (tmp_path / "link.mcap").symlink_to(story)
    files = [story, str(story), tmp_path / "link.mcap"]
    assert len(read(files).actuator_states) == 200
    assert len(read(each for each in files).actuator_states) == 200


@pytest.mark.parametrize("path", [3, [3], {"a": 1}, b"x.mcap"])
def test_what_is_no_path_is_no_recording(path: Any) -> None:
    with pytest.raises(LogError, match="a recording is a path, or a list of paths, not"):
        read(path)


def test_index_by_name(story: Path) -> None:
    states = read(story).joint_states
    assert states.index("second") == 1
    with pytest.raises(LogError, match="did you mean 'second'"):
        states.index("secnod")


@pytest.mark.samples("2003")
@pytest.mark.parametrize("step", [2003, 997])
def test_a_file_cut_off_anywhere_reads_up_to_its_last_chunk(
    story: Path, tmp_path: Path, step: int
) -> None:
    whole = story.read_bytes()
    cut = tmp_path / "cut.mcap"
    seen = set()
    for length in [*range(8, len(whole), step), len(whole) - 1, len(whole)]:
        cut.write_bytes(whole[:length])
        recording = None
        try:
            recording = read(cut)
        except LogError as error:
            assert "no recording of a hand" in str(error)  # noqa: PT017
            continue
        assert recording.finished == (length == len(whole))
        count = len(recording.reference)
        seen.add(count)
        assert recording.actuator_states.tick.tolist() == list(range(count))
    assert {0, 51, 102, 153, 200} == seen


@hypothesis_settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seed=st.integers(0, 2**32))
def test_damaged_files_raise_nothing_but_log_error(story: Path, tmp_path: Path, seed: int) -> None:
    source = random.Random(seed)
    damaged = bytearray(story.read_bytes())
    for _ in range(source.randrange(1, 30)):
        damaged[source.randrange(len(damaged))] = source.randrange(256)
    path = tmp_path / "damaged.mcap"
    path.write_bytes(damaged)
    try:
        recording = read(path)
    except LogError:
        return
    assert len(recording.reference) <= 200


def test_a_damaged_chunk_is_left_out_and_said(story: Path, tmp_path: Path) -> None:
    data = bytearray(story.read_bytes())
    from rtee.log.file_index import index_file

    place = index_file(story).chunks[2]
    data[place.record.offset + 60] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    recording = read(path)
    assert 0 < len(recording.reference) < 200
    assert any("chunk" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "is not an MCAP file"),
        (b"hello, world", "is not an MCAP file"),
        (None, "cannot be read"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: bytes | None, text: str) -> None:
    path = tmp_path / "file.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LogError, match=text) as caught:
        read(path)
    assert str(path) in str(caught.value)


def test_a_folder_means_its_newest_recording(claw: Hand, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"no recording in this folder$"):
        read(tmp_path)
    (tmp_path / "renamed.mcap").touch()
    with pytest.raises(LogError, match=r"give the file, since none is named HAND_TIME_PART\.mcap"):
        read(tmp_path)
    (tmp_path / "renamed.mcap").unlink()
    log = Log(claw, settings(tmp_path))
    log.run(0, 10)
    log.writer.stop()
    log.time.now += 10
    log.writer.start()
    log.run(2000, 2030)
    log.writer.close()
    assert len(recorded(tmp_path)) == 2
    assert read(tmp_path).actuator_states.tick.tolist() == list(range(2000, 2030))


def test_recordings_of_different_hands_do_not_mix(story: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    foreign(other, topic="/arm/joint_states")
    with pytest.raises(LogError, match="of 'arm', not of 'claw'"):
        read([story, other])


def foreign(path: Path, topic: str, **options: object) -> None:
    """A recording by other software, with joint states of changing joints."""
    kind = message_type("sensor_msgs/JointState")
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, **options)  # type: ignore[arg-type]
        writer.start("ros2")
        schema = writer.register_schema(kind.name, "ros2msg", kind.schema.encode())
        channel = writer.register_channel(topic, "cdr", schema)
        text = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        chatter = writer.register_channel("/chatter", "cdr", text)
        for number in range(100):
            names = ["elbow", "wrist"] if number % 10 else ["other"]
            fields = joint_state_fields(names)
            fields["position"] = np.full(len(names), float(number))
            writer.add_message(channel, 1000 + number, kind.encode(fields), 1000 + number)
            writer.add_message(chatter, 1000 + number, encode_string("hello"), 1000 + number)
        writer.finish()


def test_states_of_another_version_are_read_by_their_own_definition(tmp_path: Path) -> None:
    path, names = tmp_path / "other_version.mcap", ["first", "second"]
    ours = message_type("rtee_msgs/ActuatorState")
    lines = [line for line in ours.schema.splitlines(True) if "temperature" not in line]
    place = next(i for i, line in enumerate(lines) if "float64[] effort" in line)
    lines.insert(place, "float64[] humidity\n")
    kind = recorded_type(ours.name, "".join(lines))
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema(kind.name, "ros2msg", "".join(lines).encode())
        channel = writer.register_channel("/claw/actuator_states", "cdr", schema)
        states = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        writer.register_channel("/claw/joint_states", "cdr", states)
        for number in range(10):
            fields = actuator_state_fields(names) | {"humidity": np.array([40.0, 50.0])}
            del fields["temperature"]
            fields["effort"] = np.array([1.5, float(number)])
            fields["tick"] = number
            writer.add_message(channel, 1000 + number, kind.encode(fields), 1000 + number)
        writer.finish()
    recording = read(path)
    assert recording.notes == ()
    measured = recording.actuator_states
    assert measured.tick.tolist() == list(range(10))
    assert measured.effort.tolist() == [[1.5, float(number)] for number in range(10)]
    assert measured.temperature.shape == (10, 2)
    assert np.isnan(measured.temperature).all()


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("index", [IndexType.ALL, IndexType.NONE])
def test_recordings_of_other_software_are_read(
    tmp_path: Path, compression: CompressionType, index: IndexType
) -> None:
    path = tmp_path / "foreign.mcap"
    foreign(path, "/arm/joint_states", compression=compression, index_types=index)
    recording = read(path)
    assert recording.hand == "arm"
    assert recording.finished
    joints = recording.joint_states
    assert joints.names in {("elbow", "wrist"), ("other",)}
    numbers = [n for n in range(100) if (n % 10 == 0) == (joints.names == ("other",))]
    assert joints.position[:, 0].tolist() == numbers
    assert joints.wall.tolist() == [1000 + n for n in numbers]
    assert any("with other joints are left out" in note for note in recording.notes)


def test_an_index_that_lies_is_not_believed(claw: Hand, tmp_path: Path, story: Path) -> None:
    from rtee.log.file_index import index_file

    data = bytearray(story.read_bytes())
    for chunk in index_file(story).chunks:
        for record in chunk.indexes.values():
            data[record.offset + 14] ^= 0x55
    path = tmp_path / "lying.mcap"
    path.write_bytes(data)
    assert read(path).reference.position.tobytes() == read(story).reference.position.tobytes()


def test_walking_stops_at_nonsense() -> None:
    assert column_reader.walk(b"") == {}
    assert column_reader.walk(b"\x05" + b"\xff" * 60) == {}
    assert column_reader.walk(bytes(200)) == {}


def test_settings_leave_room_to_remove_old_parts() -> None:
    assert RecorderSettings(max_file_size=1e9, max_total_size=1e6).part_size == 250_000
