"""Recordings open with the software of others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from log.samples import RATE, WALL, Log, recorded, settings, tick
from rtee.drivers.replay.states import RecordedStates
from rtee.errors import MessageError
from rtee.hand.config_schema import RecordingLayout
from rtee.hand.model import Hand
from rtee.log import read
from rtee.log.column_reader import messages_in
from rtee.log.layout import CHANNELS
from rtee.log.reader import windows
from rtee.messages.schema import message_type
from rtee.messages.tick_columns import decode_ticks, encode_ticks
from rtee.messages.typestore import typestore

TOPICS = {
    "/claw/joint_states": 200,
    "/claw/actuator_states": 200,
    "/claw/reference": 200,
    "/claw/channels": 200,
    "/claw/goals": 2,
    "/claw/feedback": 3,
    "/claw/results": 2,
    "/claw/events": 1,
    "/claw/commands": 1,
    "/claw/device_status": 1,
    "/claw/loop_statistics": 1,
    "/robot_description": 1,
    "/claw/urdf": 1,
    "/tf": 100,
}


def test_rosbags_reads_every_message(story: Path, claw: Hand) -> None:
    counts: dict[str, int] = {}
    positions: list[Any] = []
    with AnyReader([story], default_typestore=typestore()) as reader:
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
            if connection.topic == "/claw/joint_states":
                number = len(positions)
                positions.append(message.position)
                assert stamp == WALL + round(number / RATE * 1e9)
                assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
                assert message.name == ["first", "second", "first_far", "second_far"]
            if connection.topic == "/robot_description":
                assert message.data == claw.urdf.text
    assert counts == TOPICS
    for number, position in enumerate(positions):
        first, second = tick(number).position
        assert position[:2].tolist() == [first, second]
        assert position[2:] == pytest.approx([1.5 * first + 0.25, second**2], rel=1e-7)


def test_rosbags_knows_the_types_from_the_file_alone(story: Path) -> None:
    with AnyReader([story]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)


def test_mcap_ros2_support_reads_every_message(story: Path) -> None:
    counts: dict[str, int] = {}
    with story.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for _, channel, _, decoded in reader.iter_decoded_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            if channel.topic == "/claw/goals" and decoded.goal_id == "g1":
                assert (decoded.action, list(decoded.elements)) == ("Trig", ["one"])
                assert list(decoded.effort) == [1.5]
    assert counts == TOPICS


def test_mcap_finds_attachments_metadata_and_statistics(story: Path, claw: Hand) -> None:
    with story.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        attached = {each.name: each.data for each in reader.iter_attachments()}
        assert attached.pop("digest")
        assert attached == {"claw.urdf": claw.urdf.text.encode(), "hand.yaml": b"name: claw\n"}
        (metadata,) = reader.iter_metadata()
        assert metadata.name == "rtee"
        assert metadata.metadata["hand"] == "claw"
        assert metadata.metadata["driver"] == "kinematic"
        summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(TOPICS.values())
    assert summary.statistics.attachment_count == 3
    named = {
        summary.channels[k].topic: v for k, v in summary.statistics.channel_message_counts.items()
    }
    assert named == TOPICS


def test_the_file_also_reads_as_a_stream(story: Path) -> None:
    with story.open("rb") as stream:
        kinds = [
            type(record).__name__ for record in StreamReader(stream, validate_crcs=True).records
        ]
    assert kinds[0] == "Header"
    assert kinds[-1] == "Footer"
    assert kinds.count("Message") == sum(TOPICS.values())


def test_seeking_by_time_finds_the_right_messages(story: Path) -> None:
    with story.open("rb") as stream:
        reader = make_reader(stream)
        times = [
            message.log_time
            for _, _, message in reader.iter_messages(
                ["/claw/reference"],
                starting_at=WALL + 500_000_000,
                ending_before=WALL + 700_000_000,
            )
        ]
    assert times == sorted(times)
    assert np.array(times) == pytest.approx(WALL + np.arange(50, 70) * 10_000_000, abs=1000)


def test_no_chunk_is_longer_than_a_second(story: Path) -> None:
    with story.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) >= 4
    for chunk in summary.chunk_indexes:
        assert chunk.compression == "zstd"
        assert chunk.message_end_time - chunk.message_start_time <= 1_000_000_000


def test_ticks_in_columns_are_the_same_ones(story: Path, claw: Hand, tmp_path: Path) -> None:
    Log(claw, settings(tmp_path, layout=RecordingLayout.COLUMNS)).story()
    (path,) = recorded(tmp_path)
    there, found = read(story), read(path)
    assert found.actuator_states == there.actuator_states
    assert found.reference == there.reference
    assert found.joint_states == there.joint_states
    pieces = [*windows(path, start=0.6, end=1.4)]
    assert sum(len(piece.reference) for piece in pieces) == 81
    # Played back, too, with each tick once.
    states = RecordedStates(path, "claw", there.actuator_states.names)
    stamps = np.concatenate([block.stamp for block in states.blocks()])
    assert stamps.tolist() == there.actuator_states.time.tolist()
    states.close()
    with path.open("rb") as stream:
        topics = [each.topic for _, each, _ in make_reader(stream).iter_messages()]
    # Every second one, 50 a second, and at the begin of a chunk.
    assert 100 <= topics.count("/claw/actuator_states") <= 105
    assert 4 <= topics.count("/claw/ticks") <= 6
    (tmp_path / "all").mkdir()
    Log(claw, settings(tmp_path / "all", layout=RecordingLayout.COLUMNS, tf_rate=300.0)).story()
    with recorded(tmp_path / "all")[0].open("rb") as stream:
        counts = make_reader(stream).get_summary().statistics.channel_message_counts  # type: ignore[union-attr]
    assert counts[CHANNELS["actuator_states"]] == 200


def test_columns_that_do_not_fit_are_said() -> None:
    rows = np.arange(4 * 80, dtype=np.uint8).reshape(4, 80)
    message = encode_ticks(rows, [0], 0)
    assert (decode_ticks(message)[0] == rows).all()
    assert (decode_ticks(encode_ticks(rows[:1], [0], 0))[0] == rows[:1]).all()
    kind = message_type("rtee_msgs/msg/Ticks")
    fields = kind.decode(message)
    others = (
        {"ticks": 5},
        {"first": b""},
        {"number": fields["number"] + 80},
        {"other": fields["other"] + 80},
        {"order": b""},
    )
    for other in others:
        with pytest.raises(MessageError, match="do not match"):
            decode_ticks(kind.encode(fields | other))
    with pytest.raises(MessageError, match="without messages"):
        messages_in(rows, [0])
