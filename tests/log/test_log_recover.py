from __future__ import annotations

import errno
import os
import signal
import subprocess
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rtee_process import PYTHON

from log.samples import Log, recorded, settings
from rtee.errors import LogError
from rtee.hand.model import Hand
from rtee.log import read
from rtee.log.file_index import index_file
from rtee.log.record_scanner import Record
from rtee.log.recover import recover
from rtee.messages.mcap_chunk import MAGIC
from rtee.messages.typestore import typestore


def opens_elsewhere(path: Path) -> int:
    """Count the messages that other software finds in a file."""
    with path.open("rb") as stream:
        found = sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())
    with AnyReader([path], default_typestore=typestore()) as reader:
        assert sum(1 for _ in reader.messages()) == found
    return found


@pytest.mark.samples("0.3", "0.85", "0.999")
@pytest.mark.parametrize("share", [0.3, 0.5, 0.7, 0.85, 0.97, 0.999])
def test_a_cut_off_file_becomes_whole(story: Path, tmp_path: Path, share: float) -> None:
    whole = story.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: int(share * len(whole))])
    before = read(path)
    done = recover(path, in_place=True)
    after = read(path)
    assert not done.untouched
    assert not before.finished
    assert after.finished
    assert after.notes == ()
    assert after.actuator_states.tick.tolist() == before.actuator_states.tick.tolist()
    assert [entry.value for entry in after.goals] == [entry.value for entry in before.goals]
    assert after.attachments == before.attachments
    assert after.metadata == before.metadata
    assert opens_elsewhere(path) == done.messages
    assert [each.name for each in tmp_path.iterdir()] == ["cut.mcap"]


def test_a_whole_file_is_left_as_it_is(story: Path, tmp_path: Path) -> None:
    path = tmp_path / "whole.mcap"
    path.write_bytes(story.read_bytes())
    done = recover(path, in_place=True)
    assert done.untouched
    assert path.read_bytes() == story.read_bytes()
    copy = tmp_path / "copy.mcap"
    assert recover(path, copy).path == copy
    assert copy.read_bytes() == story.read_bytes()
    with pytest.raises(LogError, match=r"copy.mcap: exists already"):
        recover(path, copy)


def test_a_damaged_chunk_is_left_out_and_the_rest_kept(story: Path, tmp_path: Path) -> None:
    data = bytearray(story.read_bytes())
    data[index_file(story).chunks[2].record.offset + 60] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    output = tmp_path / "sound.mcap"
    done = recover(path, output)
    assert done.damaged == 1
    assert done.lost_bytes == 0  # it was closed
    assert path.read_bytes() == data
    ticks = read(output).actuator_states.tick.tolist()
    assert 0 < len(ticks) < 200
    assert ticks[0] == 0
    assert ticks[-1] == 199
    assert opens_elsewhere(output) == done.messages


def test_a_file_that_is_being_written_is_left_alone(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path))
    log.run(0, 100)
    (path,) = recorded(tmp_path)
    with pytest.raises(LogError, match="is still being written"):
        recover(path, in_place=True)
    log.run(100, 200)
    log.writer.close()
    assert len(read(path).reference) == 200


@pytest.mark.parametrize("content", [b"", b"nonsense", MAGIC, MAGIC + MAGIC, None])
def test_what_is_no_recording_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "file.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LogError):
        recover(path, in_place=True)
    assert [p.name for p in tmp_path.iterdir()] == ([] if content is None else ["file.mcap"])


def test_a_place_that_cannot_be_written_is_said(story: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(story.read_bytes()[:-100])
    with pytest.raises(LogError, match=r"missing/out\.mcap: cannot be written: no such file"):
        recover(path, tmp_path / "missing" / "out.mcap")
    path.write_bytes(story.read_bytes())
    with pytest.raises(LogError, match=r"missing/out\.mcap: cannot be written: no such file"):
        recover(path, tmp_path / "missing" / "out.mcap")


def test_a_source_that_cannot_be_read_is_named(
    story: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(story.read_bytes()[:-100])
    read_of, reads = Record.read, []

    def fail(record: Record, stream: BinaryIO, most: int | None = None) -> bytes:
        if isinstance(record, Record) and record.opcode == Opcode.CHUNK and most is None:
            reads.append(record)
            if len(reads) > 2 * len(index.chunks):  # as soon as they are copied
                raise OSError(errno.EIO, "input/output error")
        return read_of(record, stream, most)

    index = index_file(path)
    monkeypatch.setattr(Record, "read", fail)
    with pytest.raises(LogError, match=r"cut\.mcap: cannot be read: input/output error"):
        recover(path)
    assert [each.name for each in tmp_path.iterdir()] == ["cut.mcap"]


CHILD = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from log.samples import make_hand, settings, tick
from rtee.log import Recorder
folder = Path(sys.argv[2])
hand = make_hand(folder)
begin, number = time.monotonic(), 0
with Recorder(hand, settings(folder), rate=100.0) as recorder:
    while True:
        recorder.on_tick(tick(number, begin=begin, wall=time.time_ns()))
        while number % 10 == 0 and recorder._queue.qsize():  # its thread may be late
            time.sleep(0.001)
        print(number, flush=True)
        number += 1
        time.sleep(max(0.0, begin + number / 100.0 - time.monotonic()))
"""


@pytest.mark.samples("90")
@pytest.mark.parametrize("after", [20, 90, 140])
def test_a_killed_process_loses_at_most_a_second(tmp_path: Path, after: int) -> None:
    tests = str(Path(__file__).resolve().parents[1])
    child = subprocess.Popen(
        [*PYTHON, "-c", CHILD, tests, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    with child, child.stdout:
        while int(child.stdout.readline()) < after:
            pass
        os.kill(child.pid, signal.SIGKILL)
        last = int(([str(after), *child.stdout.read().split()])[-1])
    (path,) = recorded(tmp_path)
    recover(path, in_place=True)
    recording = read(path)
    assert recording.finished
    ticks = recording.actuator_states.tick
    assert ticks.tolist() == list(range(len(ticks)))
    assert last + 1 - len(ticks) <= 100
    if len(ticks):
        assert np.isfinite(recording.reference.position).all()
        opens_elsewhere(path)


def test_messages_outside_of_chunks_are_not_thrown_away(tmp_path: Path) -> None:
    """A foreign file that was never closed."""
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start("ros1")
        schema = writer.register_schema("x", "ros2msg", b"")
        channel = writer.register_channel("/x", "cdr", schema)
        for number in range(100):
            writer.add_message(channel, number + 1, b"abcdefgh", number + 1)
    before = path.read_bytes()
    with pytest.raises(LogError, match="outside of chunks"):
        recover(path, in_place=True)
    assert path.read_bytes() == before
