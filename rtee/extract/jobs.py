"""Doing independent searches in several processes."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from typing import Any, Final, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

Progress = Callable[[int, int], None]

_PR_SET_PDEATHSIG: Final = 1
"""Linux: the signal that a process gets when its parent ends (prctl(2))."""

_TICKET: Final = 4
"""Bytes of a task's number."""


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def spread(
    function: Callable[[Task], Result], tasks: Sequence[Task], jobs: int, progress: Progress
) -> list[Result]:
    """Return what a function makes of all tasks, in their order.

    The tasks are done by ``jobs`` processes, of which this one is the first. The others are forked,
    so that they share what the function refers to, meshes and all, without copies. Where that
    cannot be done safely, on other systems than Linux or beside other threads, all is done in this
    process; the results are the same. So are they when another process dies: what it doesn't hand
    over is done here.

    Args:
        function: A function without side effects that matter.
        tasks: Its arguments.
        jobs: Number of processes.
        progress: Called with the number of tasks that are begun or done and that of all.
    """
    total, jobs = len(tasks), min(jobs, len(tasks))
    done: dict[int, Result] = {}
    if jobs > 1 and sys.platform.startswith("linux") and threading.active_count() == 1:
        queue = _Queue(total)
        others = [_Fork(function, tasks, queue) for _ in range(jobs - 1)]
        try:
            while (number := queue.next()) is not None:
                done[number] = function(tasks[number])
                progress(queue.begun(), total)
            for other in others:
                done.update(other.results())
            progress(total, total)
        finally:
            for other in others:
                other.end()
            queue.close()
    for number in range(total):
        if number not in done:
            done[number] = function(tasks[number])
            progress(number + 1, total)
    return [done[number] for number in range(total)]


class _Queue:
    """The numbers of the tasks, from which several processes take one after the other.

    The processes share a file in memory and with it the place where they read next.
    """

    def __init__(self, total: int) -> None:
        self._file = os.memfd_create("rtee-tasks")
        with open(self._file, "wb", closefd=False) as file:
            file.writelines(number.to_bytes(_TICKET, "little") for number in range(total))
        os.lseek(self._file, 0, os.SEEK_SET)

    def next(self) -> int | None:
        """Return the next task's number, ``None`` when all are taken."""
        ticket = os.read(self._file, _TICKET)
        return int.from_bytes(ticket, "little") if ticket else None

    def begun(self) -> int:
        """Return how many tasks are taken."""
        return os.lseek(self._file, 0, os.SEEK_CUR) // _TICKET

    def close(self) -> None:
        """Forget the tasks."""
        os.close(self._file)


class _Fork:
    """A process that does tasks beside this one."""

    def __init__(
        self, function: Callable[[Task], Result], tasks: Sequence[Task], queue: _Queue
    ) -> None:
        self._results, writing = Pipe(duplex=False)
        parent = os.getpid()
        self._process = os.fork()
        if self._process:
            writing.close()
            return
        with suppress(BaseException):
            _end_with(parent)
            results = {}
            while (number := queue.next()) is not None:
                results[number] = function(tasks[number])
            writing.send(results)
        os._exit(0)

    def results(self) -> dict[int, Any]:
        """Wait for the process and return its results by the tasks' numbers."""
        try:
            return dict(self._results.recv())
        except EOFError:
            return {}

    def end(self) -> None:
        """End the process, whatever it does."""
        self._results.close()
        with suppress(ProcessLookupError):
            os.kill(self._process, signal.SIGKILL)
        os.waitpid(self._process, 0)


def _end_with(parent: int) -> None:
    """Have the kernel end this process when its parent ends, even if that is killed."""
    import ctypes

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before
        os._exit(1)
