from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from log.samples import (
    BEGIN,
    COMMAND,
    GOAL,
    RATE,
    RESULT,
    STATISTICS,
    STATUS,
    recorded,
    settings,
    tick,
)
from rtee.errors import LogError
from rtee.hand.model import Hand
from rtee.log import Recorder, read
from rtee.loop.observer import Observer
from rtee.types import Event, Feedback


def wait_for(condition: Callable[[], bool]) -> None:
    while not condition():
        time.sleep(0.005)


def feed(recorder: Recorder, first: int, last: int) -> None:
    for number in range(first, last):
        recorder.on_tick(tick(number))


def test_what_the_loop_tells_is_recorded(claw: Hand, tmp_path: Path) -> None:
    recorder = Recorder(claw, settings(tmp_path), rate=RATE, metadata={"driver": "kinematic"})
    observer: Observer = recorder
    with recorder:
        for number in range(50):
            observer.on_tick(tick(number))
        observer.on_goal(GOAL, BEGIN + 0.5)
        observer.on_command(COMMAND)
        observer.on_feedback(Feedback("g1", 0.5, stamp=BEGIN + 0.6))
        observer.on_result(RESULT)
        observer.on_event(Event("limited", "first", "a limit was met", BEGIN + 0.7))
        observer.on_status([STATUS], STATISTICS)
        recorder.mark("here")
        for number in range(50, 60):
            observer.on_tick(tick(number))
    recording = read(recorded(tmp_path)[0])
    assert recording.finished
    assert recording.actuator_states.tick.tolist() == list(range(60))
    assert recording.goals[0].value == GOAL
    assert recording.commands[0].value == COMMAND
    assert recording.results[0].value == RESULT
    assert recording.device_status[0].value == STATUS
    assert recording.loop_statistics[0].value == STATISTICS
    assert {entry.value.kind for entry in recording.events} == {"limited", "mark"}
    assert recording.metadata["driver"] == "kinematic"
    assert recorder.status().ticks == 60
    assert recorder.status().dropped == recorder.status().lost == 0
    assert not recorder.status().recording


@pytest.mark.anyio
async def test_it_can_be_used_within_an_event_loop(claw: Hand, tmp_path: Path) -> None:
    async with Recorder(claw, settings(tmp_path), rate=RATE) as recorder:
        feed(recorder, 0, 20)
    assert len(read(recorded(tmp_path)[0]).reference) == 20


def test_closing_twice_and_opening_twice_do_no_harm(claw: Hand, tmp_path: Path) -> None:
    recorder = Recorder(claw, settings(tmp_path), rate=RATE)
    recorder.open()
    recorder.open()
    recorder.close()
    recorder.close()
    assert len(recorded(tmp_path)) == 1


def test_a_recording_that_cannot_begin_leaves_no_folder(
    claw: Hand, tmp_path: Path, largest_file: Callable[[int | None], None]
) -> None:
    recorder = Recorder(claw, settings(tmp_path / "new" / "logs"), rate=RATE)
    largest_file(100)
    with pytest.raises(LogError, match="no recording can be written here: file too large"):
        recorder.open()
    largest_file(None)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_said_at_once(claw: Hand, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    recorder = Recorder(claw, settings(tmp_path / "file" / "logs"), rate=RATE)
    with pytest.raises(
        LogError, match=r"no recording can be written here: .*; --log gives .* --no-log"
    ):
        recorder.open()


def test_recording_starts_and_stops_while_it_runs(claw: Hand, tmp_path: Path) -> None:
    options = settings(tmp_path, enabled=False, flight_recorder=0.0)
    with Recorder(claw, options, rate=RATE) as recorder:
        feed(recorder, 0, 50)
        assert recorded(tmp_path) == []
        recorder.start()
        feed(recorder, 50, 100)
        wait_for(lambda: recorder.status().path is not None)
        assert recorder.status().recording
        recorder.stop()
        wait_for(lambda: not recorder.status().recording)
        feed(recorder, 100, 150)
        (first,) = recorded(tmp_path)
        time.sleep(0.002)
        recorder.start()
        feed(recorder, 150, 200)
    second = next(path for path in recorded(tmp_path) if path != first)
    assert read(first).actuator_states.tick.tolist() == list(range(50, 100))
    assert read(second).actuator_states.tick.tolist() == list(range(150, 200))


def test_a_chunk_is_written_in_time_without_anything_new(claw: Hand, tmp_path: Path) -> None:
    with Recorder(claw, settings(tmp_path, chunk_time=0.05), rate=RATE) as recorder:
        feed(recorder, 0, 10)
        wait_for(lambda: recorder.status().ticks == 10)
        recording = read(recorded(tmp_path)[0])
        assert not recording.finished
        assert len(recording.reference) == 10


def test_a_blocked_disk_holds_up_nobody_and_drops_are_counted(claw: Hand, tmp_path: Path) -> None:
    gate = threading.Event()
    recorder = Recorder(claw, settings(tmp_path, queue_time=2.0), rate=RATE)
    recorder.open()
    recorder._queue.put(lambda: gate.wait() and None)  # as a write to a disk that hangs
    wait_for(lambda: recorder._queue.empty())
    feed(recorder, 0, 1000)
    recorder.mark("a mark outlives ticks")
    assert recorder.dropped == 800
    assert recorder.status().dropped == 800
    gate.set()
    recorder.close()
    recording = read(recorded(tmp_path)[0])
    assert len(recording.reference) == 200
    assert len(recording.marks) == 1
    (dropped,) = [entry.value for entry in recording.events if entry.value.kind == "log_dropped"]
    assert dropped.text == "800 records dropped: the writer fell behind"
    assert dropped.severity == "warning"


def test_a_tick_that_cannot_be_encoded_ends_nothing(claw: Hand, tmp_path: Path) -> None:
    with Recorder(claw, settings(tmp_path), rate=RATE) as recorder:
        feed(recorder, 0, 10)
        wrong = replace(tick(10), position=np.zeros(3))
        recorder.on_tick(wrong)
        feed(recorder, 11, 20)
        wait_for(lambda: recorder.status().dropped == 1)
        assert "have the wrong length" in recorder.status().problem
    ticks = read(recorded(tmp_path)[0]).actuator_states.tick.tolist()
    assert ticks == [*range(10), *range(11, 20)]


def test_only_every_nth_tick_where_asked_for(claw: Hand, tmp_path: Path) -> None:
    with Recorder(claw, settings(tmp_path, decimation=10), rate=RATE) as recorder:
        feed(recorder, 0, 100)
    assert read(recorded(tmp_path)[0]).actuator_states.tick.tolist() == list(range(0, 100, 10))


def test_the_writer_has_no_real_time_priority(claw: Hand, tmp_path: Path) -> None:
    import os

    found: list[int] = []
    with Recorder(claw, settings(tmp_path), rate=RATE) as recorder:
        recorder._queue.put(lambda: found.append(os.sched_getscheduler(0)))
    assert found == [os.SCHED_OTHER]
