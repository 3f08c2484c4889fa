from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from rtee.extract.jobs import ForkedProcesses, parallel_map

HERE = os.getpid()


pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the thread that a plugin of pytest keeps, which a fork does not mind."""
    monkeypatch.setattr(threading, "active_count", lambda: 1)


def square(x: int) -> int:
    return x * x


def nothing(done: int, total: int) -> None:
    pass


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("jobs", [1, 2, 5, 40])
def test_results_come_in_the_order_of_the_tasks(jobs: int) -> None:
    assert parallel_map(square, range(23), jobs, nothing) == [x * x for x in range(23)]


def test_no_tasks_give_no_results() -> None:
    assert parallel_map(square, [], 2, nothing) == []


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are forked on Linux")
@pytest.mark.usefixtures("alone")
def test_several_processes_work_and_none_is_left() -> None:
    # Each process waits until another one has taken a task, so that none can do them all.
    reading, writing = os.pipe()

    def meet(task: int) -> int:
        if task == 0:
            os.read(reading, 1)
        else:
            os.write(writing, b"x")
        return os.getpid()

    first, second = parallel_map(meet, [0, 1], 2, nothing)
    assert len({first, second, HERE}) == 3
    for other in first, second:
        with pytest.raises(ProcessLookupError):
            os.kill(other, 0)


def collected(task: int, seen: list[int]) -> tuple[int, list[int]]:
    seen.append(task)
    return os.getpid(), list(seen)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are forked on Linux")
@pytest.mark.usefixtures("alone")
def test_processes_keep_what_they_know_for_further_tasks() -> None:
    seen: list[int] = []
    with ForkedProcesses(seen, 2) as workers:
        first = workers.map([partial(collected, task) for task in range(6)], nothing)
        second = workers.map([partial(collected, task) for task in range(6, 12)], nothing)
    known = dict(first)
    assert not seen
    for task, (process, found) in enumerate(second, 6):
        # On a busy computer, one process may do all of the first tasks.
        before = known.get(process, [])
        assert found[: len(before)] == before
        assert found[-1] == task


@pytest.mark.usefixtures("alone")
def test_what_a_dying_process_leaves_is_done() -> None:
    def die(task: int) -> int:
        if os.getpid() != HERE:
            os._exit(1)
        return -task

    assert parallel_map(die, range(50), 3, nothing) == [-task for task in range(50)]


@pytest.mark.usefixtures("alone")
def test_an_error_in_any_process_is_raised() -> None:
    def fail(task: int) -> int:
        if task == 7:
            raise ValueError("seven")
        return task

    for _ in range(4):
        with pytest.raises(ValueError, match="seven"):
            parallel_map(fail, range(9), 2, nothing)


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("jobs", [1, 2])
def test_progress_reaches_the_end(jobs: int) -> None:
    seen: list[tuple[int, int]] = []
    parallel_map(square, range(5), jobs, lambda done, total: seen.append((done, total)))
    assert seen == sorted(seen)
    assert seen[-1] == (5, 5)


def test_beside_another_thread_one_process_does_all() -> None:
    end = threading.Event()
    other = threading.Thread(target=end.wait)
    other.start()
    try:
        assert set(parallel_map(lambda _: os.getpid(), range(9), 3, nothing)) == {HERE}
    finally:
        end.set()
        other.join()


SEARCH = """
import os, sys, time
from rtee.extract.jobs import parallel_map

def search(task):
    os.write(1, f"{os.getpid()}\\n".encode())
    if sys.argv[1:] and task == 1:
        raise ValueError("the other one sleeps on")
    time.sleep(3600)

parallel_map(search, range(2), 2, lambda done, total: None)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are forked on Linux")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_other_processes_end_with_the_first(how: signal.Signals) -> None:
    program = [sys.executable, "-c", SEARCH]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None
        others = {int(first.stdout.readline()) for _ in range(2)} - {first.pid}
        first.send_signal(how)
    assert len(others) == 2
    while any(running(other) for other in others):
        time.sleep(0.02)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are forked on Linux")
def test_an_error_ends_what_the_other_processes_do() -> None:
    program = [sys.executable, "-c", SEARCH, "fail"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.stderr.rstrip().endswith("ValueError: the other one sleeps on")


def running(process: int) -> bool:
    """Return whether a process that is nobody's child here still runs."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
