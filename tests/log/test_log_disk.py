"""Full disks, rotation, the bound on space, the flight recorder."""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from log.samples import GOAL, STATISTICS, Log, recorded, settings, tick
from rtee.errors import LogError
from rtee.hand.config_schema import Recorded
from rtee.hand.model import Hand
from rtee.log import read, rotation, sink
from rtee.log.chunks import PackedChunk
from rtee.log.mcapfile import McapFile
from rtee.log.rotation import being_written, parse_name, parts_of, recordings
from rtee.types import Event


def check_gap(log: Log, path: Path, lost_text: str) -> None:
    """The recording has a gap, is whole all the same, and the loss is counted and said."""
    recording = read(path)
    assert recording.finished
    ticks = recording.actuator_states.tick.tolist()
    lost = log.writer.sink.lost_ticks
    assert 0 < lost < 600
    assert len(ticks) == 600 - lost == log.writer.sink.written_ticks
    assert ticks[0] == 0
    assert ticks[-1] == 599
    told = [event.kind for event in log.told]
    assert told == ["log_failed", "log_resumed"]
    assert lost_text in log.told[0].text
    assert f"after {lost} ticks were lost" in log.told[1].text
    kinds = [entry.value.kind for entry in recording.events]
    assert kinds == ["log_resumed"] or kinds == ["log_failed", "log_resumed"]


def test_a_file_that_may_not_grow_loses_ticks_until_it_may(
    claw: Hand, tmp_path: Path, largest_file
) -> None:
    log = Log(claw, settings(tmp_path))
    log.run(0, 200)
    largest_file(log.writer.sink.size + 100)
    log.run(200, 400)
    assert log.writer.sink.problem == "file too large"
    assert read(recorded(tmp_path)[0]).actuator_states.tick[-1] < 250
    largest_file(None)
    log.run(400, 600)
    log.writer.close()
    check_gap(log, recorded(tmp_path)[0], "file too large")


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small file system needs root")
def test_a_full_disk_loses_ticks_until_there_is_room(claw: Hand, tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(small)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("no file system can be mounted here")
    try:
        log = Log(claw, settings(small))
        ballast = small / "ballast"
        log.run(0, 200)
        with ballast.open("wb", buffering=0) as stream:
            try:
                while True:
                    stream.write(bytes(1024))
            except OSError:
                pass
        log.run(200, 400)
        assert log.writer.sink.problem == "no space left on device"
        ballast.unlink()
        log.run(400, 600)
        log.writer.close()
        check_gap(log, recorded(small)[0], "no space left on device")
    finally:
        subprocess.run(["umount", str(small)], check=True)


def test_closing_on_a_full_disk_leaves_a_file_that_reads(
    claw: Hand, tmp_path: Path, largest_file
) -> None:
    log = Log(claw, settings(tmp_path))
    log.run(0, 200)
    log.writer.flush()
    largest_file(log.writer.sink.size + 100)
    log.writer.close()
    largest_file(None)
    recording = read(recorded(tmp_path)[0])
    assert not recording.finished
    assert len(recording.reference) == 200


def test_a_recording_that_could_not_begin_begins_when_there_is_room(
    claw: Hand, tmp_path: Path, largest_file
) -> None:
    log = Log(claw, settings(tmp_path), start=False)
    largest_file(100)
    log.writer.start()
    log.run(0, 100)
    assert recorded(tmp_path) == []
    assert log.writer.sink.problem == "file too large"
    largest_file(None)
    log.run(100, 200)
    log.writer.close()
    (path,) = recorded(tmp_path)
    assert read(path).actuator_states.tick[-1] == 199


def test_a_file_that_somebody_removed_is_followed_by_another(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path))
    log.run(0, 100)
    recorded(tmp_path)[0].unlink()
    log.run(100, 300)
    log.writer.close()
    (path,) = recorded(tmp_path)
    assert read(path).actuator_states.tick[-1] == 299


def test_files_are_rotated_by_size(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path, max_file_size=30_000))
    log.run(0, 600)
    log.writer.close()
    paths = recorded(tmp_path)
    assert len(paths) > 2
    assert [parse_name(path).part for path in paths] == list(range(len(paths)))
    assert parts_of(paths[1]) == paths
    for path in paths:
        assert read(path).finished
        assert read(path).urdf == claw.urdf.text
        assert (file := parse_name(path))
        assert file.owner == file.hand == "claw"
    whole = read(paths[1], series=True)
    assert whole.paths == tuple(paths)
    assert whole.actuator_states.tick.tolist() == list(range(600))
    assert read(tmp_path).actuator_states.tick.tolist() == list(range(600))


def test_files_are_rotated_by_time(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path, max_file_time=2.0))
    log.run(0, 500)
    log.writer.close()
    counts = [len(read(path).reference) for path in recorded(tmp_path)]
    assert sum(counts) == 500
    assert len(counts) == 3
    assert counts[:2] == [pytest.approx(200, abs=60)] * 2


def test_two_recordings_that_begin_together_get_names_of_their_own(
    claw: Hand, tmp_path: Path
) -> None:
    logs = [Log(claw, settings(tmp_path)) for _ in range(3)]
    assert len(recorded(tmp_path)) == 3
    for log in logs:
        log.run(0, 10)
        log.writer.close()
    assert [len(parts_of(path)) for path in recorded(tmp_path)] == [1, 1, 1]


def test_the_oldest_recordings_make_room_and_nothing_else(claw: Hand, tmp_path: Path) -> None:
    name = "claw_20200101T000000000Z_000.mcap"
    (tmp_path / name).write_bytes(bytes(50_000))  # looks like ours, but is not
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "claw_backup.mcap").write_bytes(bytes(50_000))
    log = Log(claw, settings(tmp_path, max_total_size=250_000, max_file_size=30_000))
    for number in log.ticks(0, 3000):
        if number % 500 == 0:
            total = sum(file.size for file in recordings(tmp_path, "claw"))
            assert total < 250_000 + 30_000
    log.writer.close()
    left = {path.name for path in tmp_path.iterdir()}
    assert {name, "notes.txt", "claw_backup.mcap"} <= left
    kept = read(tmp_path)
    assert kept.actuator_states.tick[-1] == 2999
    assert kept.actuator_states.tick[0] > 500
    assert kept.actuator_states.tick.tolist() == list(
        range(int(kept.actuator_states.tick[0]), 3000)
    )


def test_a_clock_set_back_makes_no_recording_older(claw: Hand, tmp_path: Path) -> None:
    Log(claw, settings(tmp_path)).story()
    late = tmp_path / "claw_20300101T000000000Z_000.mcap"
    recorded(tmp_path)[0].rename(late)
    log = Log(claw, settings(tmp_path, max_total_size=450_000, max_file_size=30_000))
    log.run(0, 200)
    log.writer.flush()
    assert late.exists()
    assert read(tmp_path).actuator_states.tick[-1] == 199, "the newest is not that of 2030"
    for _ in log.ticks(200, 3000):
        if not late.exists():
            break
    log.writer.close()
    assert not late.exists()
    assert read(tmp_path).actuator_states.tick[0] == 0, "the running one has all its parts"
    assert {each.run for each in recordings(tmp_path)} == {2}


def test_all_hands_keep_a_reserve_of_the_disk(
    claw: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paw = replace(claw, name="paw")
    Log(paw, settings(tmp_path)).story()
    (old,) = recorded(tmp_path)
    disk = [old.stat().st_size + 150_000]
    monkeypatch.setattr(
        rotation, "free_space", lambda folder: disk[0] - sum(f.size for f in recordings(folder))
    )
    log = Log(claw, settings(tmp_path, reserve=50_000.0))
    log.run(0, 100)
    assert old.exists()
    log.run(100, 4000)
    assert not old.exists(), "the oldest makes room, of whichever hand it is"
    assert [event.kind for event in log.told] == ["log_failed"]
    assert "log.reserve keeps that much" in log.told[0].text
    disk[0] += 200_000
    log.run(4000, 4100)
    log.writer.close()
    assert [event.kind for event in log.told] == ["log_failed", "log_resumed"]
    shared = Log(claw, settings(tmp_path, max_folder_size=1.0))
    shared.run(0, 100)
    shared.writer.close()
    assert [file.run for file in recordings(tmp_path)] == [3]
    # In folders of their own, below one that is common.
    apart = settings(tmp_path / "claw", max_folder_size=1.0, common_directory=tmp_path)
    last = Log(claw, apart)
    last.run(0, 100)
    last.writer.close()
    assert not recordings(tmp_path)
    assert [file.run for file in recordings(tmp_path / "claw")] == [4]


def test_goals_alone_are_recorded_with_what_was_before_and_after(
    claw: Hand, tmp_path: Path
) -> None:
    log = Log(claw, settings(tmp_path, record=Recorded.GOALS))
    for number in log.ticks(0, 3000):
        if number == 1500:
            log.writer.item(GOAL, log.time.now)
        if number % 100 == 0:
            log.writer.item(STATISTICS, log.time.now)
    log.writer.close()
    found = read(tmp_path)
    ticks = found.actuator_states.tick.tolist()
    assert ticks == list(range(ticks[0], ticks[-1] + 1))
    assert ticks[0] == pytest.approx(1000, abs=101)
    assert ticks[-1] == pytest.approx(2000, abs=101)
    assert [entry.value.goal_id for entry in found.goals] == ["g1"]


def test_recordings_of_other_hands_do_not_make_room(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path, max_total_size=100_000))
    log.run(0, 100)
    log.writer.close()
    other = tmp_path / recorded(tmp_path)[0].name.replace("claw", "paw")
    recorded(tmp_path)[0].rename(other)
    log = Log(claw, settings(tmp_path, max_total_size=60_000))
    log.run(0, 2000)
    log.writer.close()
    assert other.exists()
    assert not ((file := parse_name(other)) and file.owner == file.hand == "paw")


def test_a_recording_that_another_process_writes_is_not_removed(claw: Hand, tmp_path: Path) -> None:
    running = Log(claw, settings(tmp_path))
    running.run(0, 100)
    (path,) = recorded(tmp_path)
    assert being_written(path)
    log = Log(claw, settings(tmp_path, max_total_size=80_000))
    log.run(0, 2000)
    log.writer.close()
    assert path.exists()
    running.writer.close()
    assert not being_written(path)


# --- the flight recorder -------------------------------------------------------------------------


def flights(folder: Path) -> list[Path]:
    return sorted(folder.glob("*_flight.mcap"))


def fault(now: float) -> Event:
    return Event("device_fault", "motor", "overcurrent", now, "error")


def test_a_fault_writes_out_the_last_seconds_without_a_recording(
    claw: Hand, tmp_path: Path
) -> None:
    log = Log(claw, settings(tmp_path, enabled=False, flight_recorder=3.0), start=False)
    log.run(0, 1000)
    log.writer.item(fault(log.time.now), log.time.now)
    log.writer.poll()
    (path,) = recorded(tmp_path)
    assert flights(tmp_path) == [path]
    recording = read(path)
    assert recording.finished
    assert recording.metadata["cause"] == "device_fault: overcurrent"
    assert recording.urdf == claw.urdf.text
    ticks = recording.actuator_states.tick.tolist()
    assert ticks == list(range(ticks[0], 1000))
    assert 300 <= len(ticks) <= 360
    assert recording.events[-1].value.kind == "device_fault"
    assert log.told[-1].kind == "flight_recorded"
    assert list(log.writer.flight_files) == [path]


def test_faults_in_quick_succession_are_written_once_and_again_later(
    claw: Hand, tmp_path: Path
) -> None:
    log = Log(claw, settings(tmp_path, enabled=False, flight_recorder=5.0), start=False)
    for number in log.ticks(0, 1500):
        if number in (100, 110, 400):
            log.writer.item(fault(log.time.now), log.time.now)
    first, second = (read(path) for path in flights(tmp_path))
    assert first.actuator_states.tick[-1] == 101
    assert second.actuator_states.tick[0] <= 110
    assert second.actuator_states.tick[-1] == pytest.approx(600, abs=2)
    assert [entry.value.kind for entry in second.events].count("device_fault") >= 2


def test_a_fault_just_before_the_end_is_written_at_the_end(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path, enabled=False), start=False)
    log.run(0, 100)
    log.writer.item(fault(log.time.now), log.time.now)
    log.writer.close()
    assert len(flights(tmp_path)) == 1


def test_the_flight_recorder_keeps_within_its_memory(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path, enabled=False, flight_size=40_000), start=False)
    log.run(0, 2000)
    assert log.writer.flight is not None
    assert 0 < log.writer.flight.size <= 40_000
    assert 0 < log.writer.flight.seconds < 20


def test_a_flight_that_cannot_be_written_is_said(claw: Hand, tmp_path: Path, largest_file) -> None:
    log = Log(claw, settings(tmp_path, enabled=False), start=False)
    log.run(0, 200)
    largest_file(5000)
    log.writer.item(fault(log.time.now), log.time.now)
    log.writer.poll()
    largest_file(None)  # the report of the tests may be going to a file, too
    assert list(tmp_path.iterdir()) == []
    assert [event.kind for event in log.told] == ["log_failed"]
    assert log.writer.sink.problem == ""  # which is about the recording


def test_a_flight_that_cannot_be_written_interrupts_no_recording(
    claw: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = Log(claw, settings(tmp_path))
    log.run(0, 100)
    with monkeypatch.context() as patch:
        patch.setattr(sink, "flight_path", lambda *_: Path("/dev/null/flight.mcap"))
        log.writer.item(fault(log.time.now), log.time.now)
        log.writer.poll()
    log.run(100, 200)
    log.writer.close()
    assert [event.kind for event in log.told] == ["log_failed"]
    assert read(recorded(tmp_path)[0]).actuator_states.tick[-1] == 199


def test_a_folder_that_vanishes_after_a_chunk_is_made_again(
    claw: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "logs"
    log = Log(claw, settings(folder))
    log.run(0, 100)
    write = McapFile.write

    def written_and_removed(file: McapFile, chunk: PackedChunk) -> None:
        write(file, chunk)
        shutil.rmtree(folder)

    with monkeypatch.context() as patch:
        patch.setattr(McapFile, "write", written_and_removed)
        log.writer.flush()
    log.run(100, 200)
    log.writer.close()
    assert read(recorded(folder)[0]).actuator_states.tick[-1] == 199


def test_without_recording_and_flight_recorder_nothing_is_encoded(
    claw: Hand, tmp_path: Path
) -> None:
    log = Log(claw, settings(tmp_path, enabled=False, flight_recorder=0.0), start=False)
    log.writer.tick(tick(0))
    log.writer.item(fault(log.time.now), log.time.now)
    assert log.writer.waiting() is None


def test_a_fault_is_recorded_on_disk_too(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path))
    log.run(0, 100)
    log.writer.item(fault(log.time.now), log.time.now)
    log.run(100, 200)
    log.writer.close()
    paths = [path for path in recorded(tmp_path) if path not in flights(tmp_path)]
    recording = read(paths)
    kinds = [entry.value.kind for entry in recording.events]
    assert kinds == ["device_fault", "flight_recorded"]
    assert len(recording.reference) == 200


def test_names() -> None:
    assert parse_name(Path("claw_20231114T221320000Z_000.mcap")) is None  # it does not exist
    with pytest.raises(LogError):
        read("claw_20231114T221320000Z_000.mcap")


def test_what_a_killed_flight_recorder_left_is_removed(claw: Hand, tmp_path: Path) -> None:
    left = tmp_path / ".claw_20200101T000000000Z_flight.mcap.partial"
    left.write_bytes(b"half")
    other = tmp_path / ".paw_20200101T000000000Z_flight.mcap.partial"
    other.write_bytes(b"half")
    Log(claw, settings(tmp_path)).writer.close()
    assert not left.exists()
    assert other.exists()


def test_an_ended_loop_that_cannot_be_told_ends_nothing(claw: Hand, tmp_path: Path) -> None:
    def ended(event: Event) -> None:
        raise RuntimeError("Event loop is closed")

    log = Log(claw, settings(tmp_path))
    log.writer._notify = ended
    log.run(0, 100)
    log.writer.item(fault(log.time.now), log.time.now)
    log.writer.close()
    assert len(flights(tmp_path)) == 1
    assert all(read(path).finished for path in recorded(tmp_path))
