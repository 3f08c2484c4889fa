"""Run independent searches in several processes."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Generic, Self, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing.process import BaseProcess

Shared = TypeVar("Shared")
Task = TypeVar("Task")
Result = TypeVar("Result")

Progress = Callable[[int, int], None]

_PR_SET_PDEATHSIG: Final = 1
"""Option of prctl(2) on Linux: the signal that a process receives when its parent ends."""

_shared: Any
"""What a process of the pool has inherited by the fork."""


class ForkedProcesses(Generic[Shared]):
    """Forked processes that share large data, such as meshes, without copies.

    What a process computes and keeps with the data, such as a cache, serves its later tasks, too.
    If forking is not safe (on systems other than Linux, or with other threads), or if a process
    dies, the calling process runs the tasks, with the same results.
    """

    def __init__(self, shared: Shared, jobs: int) -> None:
        """Prepare; the processes start with the first tasks.

        Args:
            shared: The data.
            jobs: Number of processes.
        """
        self._shared = shared
        self._jobs = jobs
        self._others: set[BaseProcess] = set()
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def map(self, tasks: Sequence[Callable[[Shared], Result]], progress: Progress) -> list[Result]:
        """Return the results of all tasks, in their order.

        Args:
            tasks: Functions of the data without relevant side effects, which can be pickled.
            progress: Called with the number of finished tasks and the total.
        """
        total = len(tasks)
        done: dict[int, Result] = {}
        if min(self._jobs, total) > 1 and (self._pool or _may_fork()):
            done = self._forked(tasks, progress)
        for number, task in enumerate(tasks):
            if number not in done:
                done[number] = task(self._shared)
                progress(len(done), total)
        return [done[number] for number in range(total)]

    def _forked(
        self, tasks: Sequence[Callable[[Shared], Result]], progress: Progress
    ) -> dict[int, Result]:
        """Return results by the numbers of their tasks; not all of them if a process dies."""
        # Imported here, since hands of two fingers have a single search and need no processes.
        from concurrent.futures import ProcessPoolExecutor, as_completed
        from concurrent.futures.process import BrokenProcessPool
        from multiprocessing import active_children, get_context

        if self._pool is None:
            # Remember the caller's processes, which must not be killed below.
            self._others = set(active_children())
            start = (os.getpid(), self._shared)
            self._pool = ProcessPoolExecutor(self._jobs, get_context("fork"), _begin, start)
        done: dict[int, Result] = {}
        try:
            with suppress(BrokenProcessPool):
                numbers = {self._pool.submit(_do, task): n for n, task in enumerate(tasks)}
                for future in as_completed(numbers):
                    done[numbers[future]] = future.result()
                    progress(len(done), len(tasks))
        except BaseException:
            for process in set(active_children()) - self._others:
                # After an interruption, do not wait up to a minute for the searches.
                process.kill()
            raise
        return done


def parallel_map(
    function: Callable[[Task], Result], tasks: Sequence[Task], jobs: int, progress: Progress
) -> list[Result]:
    """Return the results of a function for all tasks, in their order; see `ForkedProcesses`.

    Args:
        function: A function without relevant side effects.
        tasks: Its arguments.
        jobs: Number of processes.
        progress: Called with the number of finished tasks and the total.
    """
    # By number, since the processes inherit the function and its arguments, too.
    numbers = [partial(_nth, number) for number in range(len(tasks))]
    with ForkedProcesses((function, tasks), min(jobs, len(tasks))) as workers:
        return workers.map(numbers, progress)


def _nth(number: int, work: tuple[Callable[[Task], Result], Sequence[Task]]) -> Result:
    function, tasks = work
    return function(tasks[number])


def _may_fork() -> bool:
    # A fork copies locks that other threads hold, but not the threads that would release them.
    return sys.platform.startswith("linux") and threading.active_count() == 1


def _begin(parent: int, shared: Any) -> None:
    """Initialise a worker, which ends with its parent even if the parent is killed."""
    global _shared
    _shared = shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent kills the worker
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # the parent has ended already
        os._exit(1)


def _do(task: Callable[[Any], Any]) -> Any:
    return task(_shared)
