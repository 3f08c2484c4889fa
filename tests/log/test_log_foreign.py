"""Recordings of other programs: read, summarised, plotted and exported alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from rtee.errors import LogError
from rtee.log.export import Format, export
from rtee.log.figure import figure
from rtee.log.info import info
from rtee.log.reader import read
from rtee.messages.schema import message_type

KIND = "sensor_msgs/msg/JointState"
START, STEP = 1_700_000_000_000_000_000, 10_000_000  # [ns]


def foreign(path: Path, topic: str, *, velocity: tuple[float, ...] = ()) -> Path:
    """Write a file as the MCAP library does, with fifty joint states; effort is not measured."""
    kind = message_type(KIND)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="libmcap 1.4")
        schema = writer.register_schema(KIND, "ros2msg", kind.schema.encode())
        channel = writer.register_channel(topic, "cdr", schema)
        for i in range(50):
            fields = {
                "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
                "name": ["left", "right"],
                "position": [0.01 * i, 0.02 * i],
                "velocity": list(velocity),
                "effort": [],
            }
            time = START + i * STEP
            writer.add_message(channel, time, bytes(kind.encode(fields)), time, sequence=i)
        writer.finish()
    return path


@pytest.mark.parametrize(("topic", "hand"), [("/joint_states", ""), ("/arm/joint_states", "arm")])
@pytest.mark.parametrize("velocity", [(), (1.0, 2.0)])
def test_every_command_reads_it(
    tmp_path: Path, topic: str, hand: str, velocity: tuple[float, ...]
) -> None:
    path = foreign(tmp_path / "other.mcap", topic, velocity=velocity)
    recording = read(path)
    assert (recording.hand, recording.joint_states.names) == (hand, ("left", "right"))
    assert recording.joint_states.position[-1] == pytest.approx([0.49, 0.98])
    assert recording.joint_states.velocity.shape == (50, 2)
    assert np.isnan(recording.joint_states.velocity).all() == (not velocity)
    assert np.isnan(recording.joint_states.effort).all()
    (told,) = info([path]).topics
    assert (told.topic, told.messages) == (topic, 50)
    drawn = figure(recording)
    assert [row.title for row in drawn.rows] == ["left", "right"]
    assert drawn.rows[1].positions[0].values[-1] == pytest.approx(0.98)
    (table,) = export(recording, tmp_path / "out", Format.CSV)
    lines = table.read_text().splitlines()
    assert len(lines) == 51
    assert lines[0].startswith("t,wall_ns,position.left,position.right,velocity.left")


def test_a_file_without_joint_states_is_refused_by_all(tmp_path: Path) -> None:
    path = foreign(tmp_path / "other.mcap", "/arm/other_states")
    for use in (lambda: read(path), lambda: info([path])):
        with pytest.raises(LogError, match="contains no recording of a hand"):
            use()
