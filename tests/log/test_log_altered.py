"""Recordings that somebody has altered: impossible times, checksums that fail, attachments."""

from __future__ import annotations

import contextlib
import os
import stat
import struct
import subprocess
import tracemalloc
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk
from rtee_process import RTEE

from rtee.cli import main
from rtee.drivers.replay.states import RecordedStates
from rtee.errors import LogError
from rtee.log import read
from rtee.log.brief import brief
from rtee.log.check import check
from rtee.log.chunks import MESSAGE, record_bytes
from rtee.log.column_reader import walk
from rtee.log.export import Format, export
from rtee.log.file_index import index_file
from rtee.log.info import info
from rtee.log.record_scanner import DamagedRecordError, Record, messages_of, scan
from rtee.log.recover import recover
from rtee.log.rotation import being_written, recordings

HEAD = struct.Struct("<BQ")
LATEST = 2**64 - 1


def rewritten(path: Path, target: Path, at: Record, content: bytes) -> Path:
    """Copy a recording with another content of one record."""
    data = path.read_bytes()
    record = HEAD.pack(at.opcode, len(content)) + content
    target.write_bytes(data[: at.offset - HEAD.size] + record + data[at.end :])
    return target


def late_message(path: Path, target: Path, *, chunk_too: bool) -> Path:
    """Give a message the latest time there is, with all checksums right."""
    place = index_file(path).chunks[1]
    with path.open("rb") as stream:
        data, chunk = messages_of(place.record.read(stream))
    changed = bytearray(data)
    start = next(iter(walk(data).values()))[-1]
    struct.pack_into("<Q", changed, start + MESSAGE.size - 16, LATEST)
    end = LATEST if chunk_too else chunk.message_end_time
    name = b""  # not compressed
    content = struct.pack(
        "<QQQII", chunk.message_start_time, end, len(changed), zlib.crc32(changed), len(name)
    )
    content += name + struct.pack("<Q", len(changed)) + bytes(changed)
    return rewritten(path, target, place.record, content)


@pytest.mark.parametrize("chunk_too", [False, True])
def test_the_latest_time_there_is_stops_nobody(
    story: Path, tmp_path: Path, chunk_too: bool
) -> None:
    path = late_message(story, tmp_path / "late.mcap", chunk_too=chunk_too)
    recording = read(path)
    assert 0.0 < recording.duration < 10.0
    assert recording.damage
    assert info([path]).as_dict()["duration"] < 10.0
    assert export(recording, tmp_path / "late", Format.CSV)
    done = recover(path, tmp_path / "whole.mcap")
    assert done.damage == (("a chunk declares impossible times",) if chunk_too else ())
    assert read(tmp_path / "whole.mcap").duration < 10.0


def _attachment(path: Path, name: str) -> Record:
    with path.open("rb") as stream:
        for record in scan(stream):
            if record.opcode == Opcode.ATTACHMENT and name.encode() in record.read(stream, 80):
                return record
    raise AssertionError(name)


def _checked(
    path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> str:
    """Return what `rtee log replay --check` says about a recording that it finds altered."""
    monkeypatch.setattr("sys.argv", ["rtee", "log", "replay", "--check", str(path)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    return capsys.readouterr().out


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> Path:
    """A recording of a real run, with several chunks."""
    folder = tmp_path_factory.mktemp("run")
    hand = str(repository / "config" / "robotiq_2f_85")
    command = (*RTEE, "run", hand, "--rate", "100", "--duration", "4")
    environment = os.environ | {"RTEE_RUNTIME_DIR": str(folder / "runtime")}
    subprocess.run([*command, "--log", "logs"], cwd=folder, env=environment, check=True)
    return next((folder / "logs").glob("*.mcap"))


def test_what_nobody_has_altered_is_the_same(whole: Path) -> None:
    assert check(read(whole)).same


def test_an_altered_attachment_is_not_the_same(
    whole: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    at = _attachment(whole, "hand.yaml")
    content = bytearray(whole.read_bytes()[at.offset : at.end])
    content[-20] ^= 1
    altered = rewritten(whole, tmp_path / "altered.mcap", at, bytes(content))
    assert "fails its checksum" in _checked(altered, capsys, monkeypatch)
    content[-4:] = b"\0\0\0\0"  # which means: without a checksum
    altered = rewritten(whole, tmp_path / "altered.mcap", at, bytes(content))
    assert "lost its checksum" in _checked(altered, capsys, monkeypatch)


def test_an_altered_definition_is_not_the_same(whole: Path, tmp_path: Path) -> None:
    """Of fifteen bits flipped in embedded schemas, ten were not noticed: they have no checksum."""
    data = whole.read_bytes()
    with whole.open("rb") as stream:
        places = [r for r in scan(stream) if r.opcode in (Opcode.SCHEMA, Opcode.CHANNEL)]
    random = np.random.default_rng(0)
    altered = tmp_path / "altered.mcap"
    for place in places:
        for bit in random.integers(8 * HEAD.size, 8 * (place.end - place.offset), 2).tolist():
            changed = bytearray(data)
            changed[place.offset + bit // 8] ^= 1 << bit % 8
            altered.write_bytes(changed)
            with contextlib.suppress(LogError):  # an identifier that nothing else has
                assert index_file(altered).damage, (place, bit)


@pytest.mark.parametrize(("cut", "verb"), [(0, "holds"), (20, "recovered")])
def test_what_cannot_be_repaired_is_told(
    cut: int,
    verb: str,
    whole: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    at = _attachment(whole, "hand.yaml")
    content = bytearray(whole.read_bytes()[at.offset : at.end])
    content[-20] ^= 1
    altered = rewritten(whole, tmp_path / "altered.mcap", at, bytes(content))
    data = altered.read_bytes()
    altered.write_bytes(data[: len(data) - cut])
    monkeypatch.setattr("sys.argv", ["rtee", "log", "recover", str(altered)])
    with pytest.raises(SystemExit):
        main()
    said = capsys.readouterr().out
    assert f".mcap: {verb} " in said
    assert said.endswith("not to be repaired: attachment 'hand.yaml' fails its checksum\n")
    assert "whole" not in said


def test_a_chunk_that_fails_its_checksum_is_not_the_same(
    whole: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    place = index_file(whole).chunks[-2]
    with whole.open("rb") as stream:
        content = bytearray(place.record.read(stream))
    content[-1] ^= 1
    altered = rewritten(whole, tmp_path / "altered.mcap", place.record, bytes(content))
    said = _checked(altered, capsys, monkeypatch)
    assert "the recording is not as it was written" in said
    assert "bit for bit" not in said


def test_recordings_are_not_for_everybody(story: Path) -> None:
    os.umask(umask := os.umask(0o022))
    assert stat.S_IMODE(story.stat().st_mode) == 0o640 & ~umask


def test_a_named_pipe_keeps_nobody_waiting(story: Path) -> None:
    pipe = story.with_name(story.name.replace("claw_2", "claw_3"))
    os.mkfifo(pipe)
    try:
        assert pipe not in [file.path for file in recordings(story.parent)]
        assert not being_written(pipe)
        for work in (read, recover):
            with pytest.raises(LogError, match="is not a file"):
                work(pipe)
        assert brief(pipe) is None
        with pytest.raises(LogError, match="is not a file"):
            RecordedStates(pipe, "claw", ("thumb",))
    finally:
        pipe.unlink()


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_expands_beyond_what_it_says_takes_no_memory(compression: str) -> None:
    large = bytes(100_000_000)
    compress = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}[compression]
    chunk = Chunk(
        compression=compression,
        data=compress(large),
        message_start_time=0,
        message_end_time=1,
        uncompressed_crc=0,
        uncompressed_size=1000,
    )
    content = record_bytes(chunk)[HEAD.size :]
    del large
    tracemalloc.start()
    try:
        with pytest.raises(DamagedRecordError, match="does not have the size it declares"):
            messages_of(content)
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()
