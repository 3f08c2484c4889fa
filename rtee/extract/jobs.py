"""Doing independent searches in several processes."""

from __future__ import annotations

import gc
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

Mapper = Callable[[Callable[[Any, Any], Any], Sequence[Any]], Iterator[Any]]
"""Applies a function of the common state and a task to all tasks; the results come in order."""

_state: list[object] = []
"""What forked processes inherit."""


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def workers(state: object, jobs: int) -> Iterator[Mapper]:
    """Give a mapper that works in ``jobs`` processes, or in this one.

    Processes are forked, so that they share the state, meshes and all, without copies. Where that
    cannot be done safely, on other systems than Linux or beside other threads, all is done in this
    process; the results are the same.

    Args:
        state: First argument of the functions to map.
        jobs: Number of processes.
    """
    if jobs < 2 or not sys.platform.startswith("linux") or threading.active_count() > 1:
        yield lambda function, tasks: (function(state, task) for task in tasks)
        return
    _state.append(state)
    try:
        with multiprocessing.get_context("fork").Pool(jobs, gc.disable) as pool:
            yield lambda function, tasks: pool.imap(_Call(function), tasks)
    finally:
        _state.pop()


class _Call:
    """A function of the state and a task as one of the task."""

    def __init__(self, function: Callable[[Any, Any], Any]) -> None:
        self._function = function

    def __call__(self, task: object) -> object:
        return self._function(_state[-1], task)
