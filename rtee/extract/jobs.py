"""Run independent searches in several processes."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import active_children, get_context
from typing import Any, Final, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

Progress = Callable[[int, int], None]

_PR_SET_PDEATHSIG: Final = 1
"""Option of prctl(2) on Linux: the signal that a process receives when its parent ends."""

_work: tuple[Callable[[Any], Any], Sequence[Any]]
"""The function and its arguments in a process of the pool, inherited by the fork."""


def processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def parallel_map(
    function: Callable[[Task], Result], tasks: Sequence[Task], jobs: int, progress: Progress
) -> list[Result]:
    """Return the results of a function for all tasks, in the order of the tasks.

    Runs the tasks in forked processes, which share all data of the function, such as meshes,
    without copies. If forking is not safe (on systems other than Linux, or with other threads), or
    if a worker dies, the calling process runs the tasks, with the same results.

    Args:
        function: A function without relevant side effects.
        tasks: Its arguments.
        jobs: Number of processes.
        progress: Called with the number of finished tasks and the total.
    """
    total, jobs = len(tasks), min(jobs, len(tasks))
    done: dict[int, Result] = {}
    # A fork copies locks that other threads hold, but not the threads that would release them.
    if jobs > 1 and sys.platform.startswith("linux") and threading.active_count() == 1:
        # Remember the caller's processes, which must not be killed below.
        others = set(active_children())
        work = (os.getpid(), function, tasks)
        with ProcessPoolExecutor(jobs, get_context("fork"), _begin, work) as pool:
            try:
                numbers = {pool.submit(_do, number): number for number in range(total)}
                with suppress(BrokenProcessPool):
                    for future in as_completed(numbers):
                        done[numbers[future]] = future.result()
                        progress(len(done), total)
            except BaseException:
                for process in set(active_children()) - others:
                    # After an interruption, do not wait up to a minute for the searches.
                    process.kill()
                raise
    for number in range(total):
        if number not in done:
            done[number] = function(tasks[number])
            progress(len(done), total)
    return [done[number] for number in range(total)]


def _begin(parent: int, function: Callable[[Any], Any], tasks: Sequence[Any]) -> None:
    """Initialise a worker, which ends with its parent even if the parent is killed."""
    global _work
    _work = function, tasks
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent kills the worker
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # the parent has ended already
        os._exit(1)


def _do(number: int) -> Any:
    function, tasks = _work
    return function(tasks[number])
