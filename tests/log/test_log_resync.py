"""Recordings with damaged heads of records and damaged places in their middle."""

from __future__ import annotations

import io
import random
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from typer.testing import CliRunner

from rtee.cli.log import app
from rtee.errors import LogError
from rtee.log import Recording, read
from rtee.log.file_index import index_file
from rtee.log.record_scanner import DAMAGE, Record, scan
from rtee.log.recover import recover
from rtee.messages.mcap_chunk import HEAD, MAGIC

HUGE = struct.pack("<Q", 2**63 + 5)
"""A length that no file has."""


def _records(path: Path) -> list[Record]:
    with path.open("rb") as stream:
        return list(scan(stream))


def _unclosed(data: bytes, path: Path) -> bytes:
    """Return a recording without its summary, as of a writer that was killed."""
    end = next(record for record in _records(path) if record.opcode == Opcode.DATA_END)
    return data[: end.offset - HEAD.size]


def _written(path: Path, data: bytes | bytearray) -> Path:
    path.write_bytes(data)
    return path


def _same_rows(some: Recording, whole: Recording) -> None:
    """Check that every state and reference that was read is one that was recorded."""
    for mine, others in (
        (some.actuator_states, whole.actuator_states),
        (some.reference, whole.reference),
    ):
        rows = np.searchsorted(others.wall, mine.wall)
        assert (others.wall[rows] == mine.wall).all()
        assert np.array_equal(others.position[rows], mine.position, equal_nan=True)
        assert np.array_equal(others.effort[rows], mine.effort, equal_nan=True)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize(
    "head",
    [
        b"\x86",  # another kind, and the right length
        b"\x08",
        b"\xf9" + HUGE,
        bytes(9),
        b"\x05" + struct.pack("<Q", 40),
    ],
)
@pytest.mark.parametrize("kind", [Opcode.CHUNK, Opcode.MESSAGE_INDEX])
def test_a_damaged_head_loses_its_chunk_at_most(
    story: Path, tmp_path: Path, kind: Opcode, head: bytes, closed: bool
) -> None:
    at = [each for each in _records(story) if each.opcode == kind][2]
    chunk = index_file(story).chunks[2]
    data = bytearray(story.read_bytes())
    data[at.offset - HEAD.size : at.offset - HEAD.size + len(head)] = head
    path = _written(tmp_path / "damaged.mcap", data if closed else _unclosed(bytes(data), story))
    recording, whole = read(path), read(story)
    assert recording.finished == closed
    (said,) = recording.damage
    assert f"bytes from byte {at.offset - HEAD.size} on are damaged" in said
    lost = set(whole.actuator_states.tick) - set(recording.actuator_states.tick)
    if kind == Opcode.CHUNK:
        assert 0 < len(lost) < 60
        wall = whole.actuator_states.wall[sorted(lost)]
        assert chunk.start <= wall.min() <= wall.max() <= chunk.end
    else:
        assert not lost
    _same_rows(recording, whole)
    done = recover(path, in_place=True)
    assert not done.untouched
    assert not done.damage
    again = read(path)
    assert again.notes == ()
    assert again.actuator_states.tick.tolist() == recording.actuator_states.tick.tolist()


@pytest.mark.parametrize("closed", [True, False])
def test_what_a_damaged_place_held_is_said_and_the_rest_read(
    story: Path, tmp_path: Path, closed: bool
) -> None:
    places = index_file(story).chunks
    begin = places[2].record.offset - HEAD.size
    data = bytearray(story.read_bytes())
    data[begin : begin + 100] = bytes(100)
    whole = read(story)
    path = _written(tmp_path / "damaged.mcap", data if closed else _unclosed(bytes(data), story))
    recording = read(path)
    next_chunk = places[3].record.offset - HEAD.size
    before, after = ((t - whole.start) / 1e9 for t in (places[1].end, places[3].start))
    assert recording.damage == (
        f"damaged.mcap: {next_chunk - begin} bytes from byte {begin} on are damaged; "
        f"anything recorded from {before:.2f} s to {after:.2f} s of the file is lost",
    )
    lost = set(whole.actuator_states.tick) - set(recording.actuator_states.tick)
    times = whole.actuator_states.t[sorted(lost)]
    assert before <= times.min() < times.max() <= after
    assert recording.actuator_states.tick[-1] == 199
    _same_rows(recording, whole)
    result = CliRunner().invoke(app, ["recover", str(path), "--in-place"])
    assert result.exit_code == 0
    assert recording.damage[0].partition(": ")[2] in result.stdout
    assert read(path).notes == ()
    assert set(read(path).actuator_states.tick) == set(recording.actuator_states.tick)


def test_a_damaged_place_from_the_last_chunk_on_leaves_the_summary(
    story: Path, tmp_path: Path
) -> None:
    last = index_file(story).chunks[-1].record
    data = bytearray(story.read_bytes())
    summary = next(each for each in _records(story) if each.opcode == Opcode.DATA_END).end
    data[last.offset - HEAD.size : summary] = bytes(summary - last.offset + HEAD.size)
    recording = read(_written(tmp_path / "damaged.mcap", data))
    assert recording.finished
    (said,) = recording.damage
    assert "anything recorded after " in said


@pytest.mark.parametrize("offset", [0, 40, -37, -20])
def test_a_damaged_summary_costs_nothing(story: Path, tmp_path: Path, offset: int) -> None:
    data = bytearray(story.read_bytes())
    end = next(each for each in _records(story) if each.opcode == Opcode.DATA_END).end
    position = end + offset if offset >= 0 else len(data) + offset
    data[position : position + 9] = b"\xff" * 9
    recording = read(_written(tmp_path / "damaged.mcap", data))
    assert len(recording.reference) == 200
    assert recording.damage
    assert "was not closed" not in " ".join(recording.notes)


@pytest.mark.samples("7")
@pytest.mark.parametrize("seed", [7, 8, 9])  # arbitrary, but the same every time
def test_random_damage_never_makes_measurements(story: Path, tmp_path: Path, seed: int) -> None:
    whole = read(story)
    data = story.read_bytes()
    chance = random.Random(seed)
    chunks = index_file(story).chunks
    # Between the head of the second chunk and the end: times of the start stay the same.
    first = chunks[1].record.offset - HEAD.size
    ticks = 0
    for case in range(20):
        damaged = bytearray(data if case % 2 else _unclosed(data, story))
        for _ in range(chance.choice((1, 1, 3))):
            size = chance.choice((1, 9, 100, 3000))
            begin = chance.randrange(first, len(damaged))
            damaged[begin : begin + size] = chance.randbytes(len(damaged[begin : begin + size]))
        path = _written(tmp_path / f"{case}.mcap", damaged)
        recording = read(path)
        _same_rows(recording, whole)
        found = recording.actuator_states.tick.tolist()
        again = read(recover(path, tmp_path / f"whole_{case}.mcap").path)
        assert again.notes == ()
        assert again.actuator_states.tick.tolist() == found
        ticks += len(found)
    assert ticks > 20 * 100  # most of the 200 ticks of each


class _Counting(io.FileIO):
    """A file that counts what is read from it [bytes]."""

    read_bytes = 0

    def readinto(self, buffer: bytearray) -> int:  # type: ignore[override]
        count = super().readinto(buffer) or 0
        self.read_bytes += count
        return count


@pytest.mark.parametrize("gap", [60, 5000])
def test_a_search_takes_no_square_of_the_damage(story: Path, tmp_path: Path, gap: int) -> None:
    """Chunks with nonsense between them, and nonsense that looks like the begin of a chunk."""
    chunk = index_file(story).chunks[0].record
    with story.open("rb") as stream:
        content = chunk.read(stream, 36)
    content += struct.pack("<Q", 0)  # no records
    sound = HEAD.pack(Opcode.CHUNK, len(content)) + content
    # Without a checksum, it may be anything.
    alike = HEAD.pack(Opcode.CHUNK, len(content)) + content[:24] + bytes(4) + content[28:]
    assert len(alike) == len(sound)
    alike = alike[:-8] + struct.pack("<Q", 1 << 40)
    nonsense = (alike * (1 + gap // len(alike)))[:gap]
    path = _written(tmp_path / "many.mcap", MAGIC + (nonsense + sound) * 400)
    with _Counting(path) as raw, io.BufferedReader(raw) as stream:
        gaps = sum(1 for record in scan(stream) if record.opcode == DAMAGE)
    assert gaps >= 399
    # Twice the gap, the first block of every search, and a few buffers.
    assert raw.read_bytes < 400 * (2 * gap + 2 * 4096 + 8 * io.DEFAULT_BUFFER_SIZE)


def test_a_recording_within_another_file_is_none_of_it(tmp_path: Path) -> None:
    path = _written(tmp_path / "nonsense.mcap", MAGIC + bytes(100_000))
    with pytest.raises(LogError, match="contains no recording"):
        read(path)
