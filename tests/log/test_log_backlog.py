from __future__ import annotations

import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from log.samples import RATE, recorded, settings, tick
from log.test_log_recorder import feed, wait_for
from rtee.hand.model import Hand
from rtee.log import Recorder, read
from rtee.log.chunks import ChunkBuilder
from rtee.log.recorder import PackedTicks
from rtee.sample import COLUMNS

LATE = 500
"""Ticks that wait while the disk hangs: more than one piece of a backlog with wide arrays."""


def hung(recorder: Recorder) -> threading.Event:
    """Let the writer wait as for a disk that hangs, until the event that is returned is set."""
    gate = threading.Event()
    recorder._queue.put(lambda: gate.wait() and None)
    wait_for(lambda: recorder._queue.empty())
    return gate


def test_what_was_packed_is_the_same_bit_for_bit() -> None:
    ticks = [replace(tick(n), channels={"pad/force": np.array([float(n)])}) for n in range(50)]
    packed = PackedTicks(ticks[0])
    assert all(packed.add(one) for one in ticks)
    for one in ticks:
        found = packed.take()
        assert (found.tick, found.stamp, found.wall_ns) == (one.tick, one.stamp, one.wall_ns)
        assert found.channels is one.channels
        assert found.touch is one.touch
        for name in COLUMNS:
            was, now = getattr(one, name), getattr(found, name)
            assert (now.dtype, now.tobytes()) == (was.dtype, was.tobytes()), name


def test_a_full_piece_takes_no_more_and_gives_what_it_has() -> None:
    wide = replace(tick(0), **{name: np.tile(getattr(tick(0), name), 2000) for name in COLUMNS})
    packed = PackedTicks(wide)
    added = 0
    while packed.add(replace(wide, tick=added)):
        added += 1
    assert 0 < added < 100
    assert [packed.take().tick for _ in range(added)] == list(range(added))


def test_a_tick_of_another_shape_is_not_packed() -> None:
    packed = PackedTicks(tick(0))
    assert not packed.add(replace(tick(1), position=np.zeros(3)))
    assert packed.add(tick(2))
    assert packed.take().tick == 2


def test_a_disk_that_hangs_changes_nothing_of_what_is_recorded(claw: Hand, tmp_path: Path) -> None:
    found = []
    for hangs in (False, True):
        folder = tmp_path / str(hangs)
        with Recorder(claw, settings(folder), rate=RATE) as recorder:
            if hangs:
                gate = hung(recorder)
                feed(recorder, 0, LATE)
                assert recorder._backlog is not None
                gate.set()
                wait_for(lambda: recorder._queue.empty())
            for first in range(LATE if hangs else 0, LATE + 10, 5):
                feed(recorder, first, first + 5)
                assert recorder._backlog is None
                wait_for(lambda: recorder._queue.empty())
        found.append(read(recorded(folder)[0]))
    straight, late = found
    assert late.actuator_states.tick.tolist() == list(range(LATE + 10))
    for name in COLUMNS:
        one, other = (getattr(each.actuator_states, name, None) for each in (straight, late))
        assert one is None or one.tobytes() == other.tobytes(), name
    assert straight.reference.position.tobytes() == late.reference.position.tobytes()


def test_a_tick_that_cannot_be_packed_is_counted_as_one_that_cannot_be_encoded(
    claw: Hand, tmp_path: Path
) -> None:
    with Recorder(claw, settings(tmp_path), rate=RATE) as recorder:
        gate = hung(recorder)
        feed(recorder, 0, 100)
        recorder.on_tick(replace(tick(100), position=np.zeros(3)))
        feed(recorder, 101, 200)
        gate.set()
        wait_for(lambda: recorder.status().dropped == 1)
        assert "have the wrong length" in recorder.status().problem
    ticks = read(recorded(tmp_path)[0]).actuator_states.tick.tolist()
    assert ticks == [*range(100), *range(101, 200)]


def test_the_buffer_of_a_long_chunk_is_given_back() -> None:
    builder = ChunkBuilder([(1, 0)])
    usual = []
    for blocks in (200, 20_000, 200, 200):
        for number in range(blocks):
            builder.add_block(number, bytes(500))
        assert builder.pack() is not None
        usual.append(len(builder._room._memory))
    first, long, _, last = usual
    assert long > 10_000_000
    assert last <= 2 * first


_CODE = """
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from dataclasses import replace
from log.samples import tick
from rtee.log.recorder import PackedTicks

def own():
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Anonymous:"))

def backlog(settled):
    pieces = [PackedTicks(tick(0))]
    for number in range(20000):
        one = replace(tick(number), channels=CHANNELS)  # which were not measured anew
        if not pieces[-1].add(one):
            pieces.append(PackedTicks(one))
            pieces[-1].add(one)
        if number % 20 == 0:
            settled.append(object())  # what others keep of the same time
    return pieces

CHANNELS = tick(0).channels
settled = []
backlog(settled)  # what is made once, and the places where the first objects settle
before = own()
pieces = backlog(settled)
during = own()
del pieces
print(before, during, own())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")
def test_the_memory_of_a_backlog_comes_back_whatever_settles_meanwhile(repository: Path) -> None:
    code = _CODE.format(tests=str(repository / "tests"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, during, after = map(int, done.stdout.split())
    assert during > before + 2000
    assert after < before + 500, "kB"
