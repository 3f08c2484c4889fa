"""Many tasks of trials on all processors, or on a cluster: the most urgent first."""

from __future__ import annotations

import heapq
import itertools
import json
import multiprocessing
import os
import signal
import threading
from collections import Counter
from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from typing import Final, Protocol

from rtee import child
from rtee.actions.library import ActionLibrary
from rtee.errors import UserError, WorkerLost
from rtee.hand.validation import validated
from rtee.trials.answers import Answers, TrialFile
from rtee.trials.result import CHOOSING, OBJECTS, mass_of
from rtee.trials.trial import Trial
from rtee.trials.work import Answer, MadeWith, Task, answer_of, perform, perform_apart, to_text

_TRIES: Final = 3
"""Attempts at a task: elsewhere, where there is another worker."""

_LOOK: Final = 2.0
"""Interval of checks on silent workers [s]."""


def all_trials(
    library: ActionLibrary,
    objects: Sequence[str] = OBJECTS,
    variations: int = 0,
    seed: int = 0,
    choosing: int = CHOOSING,
    wanted: float | None = None,
) -> list[Trial]:
    """Return the trials of all actions with all objects, in order."""
    return [
        Trial(
            action.name,
            action.elements,
            shape,
            mass=mass_of(shape),
            variations=variations,
            seed=seed,
            choosing=choosing,
            wanted=wanted,
        )
        for action in library
        for shape in objects
    ]


class Workers(Protocol):
    """Workers that carry out tasks."""

    @property
    def capacity(self) -> int:
        """How many tasks are given at once."""

    def submit(self, hand: str, task: Task) -> Future[str]:
        """Submit a task of a hand; the future's result is that of `perform`."""

    def check(self) -> None:
        """Raise `WorkerLost` if no worker is left."""

    def failed(self, error: BaseException) -> None:
        """Schedule a failed task for another attempt, or raise the reason why there is none."""

    def refuse(self, worker: str, why: str) -> None:
        """Give a worker no further tasks; raise if no worker remains."""

    def close(self) -> None:
        """End, and give up the tasks that are not done."""


class Local:
    """Processes of this computer, or this process for a single job.

    They end with this one, however it ends, and with `close`: at once, giving up their running
    tasks.
    """

    def __init__(self, jobs: int) -> None:
        """Start the given number of processes."""
        self._pool: ProcessPoolExecutor | None = None
        self.capacity = jobs + 1 if jobs > 1 else 1
        if jobs < 2:
            return
        context = multiprocessing.get_context("spawn")
        self._leash, self._held = context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(
            jobs, mp_context=context, initializer=end_with, initargs=(self._leash,)
        )

    def submit(self, hand: str, task: Task) -> Future[str]:
        """Give a task to a process; a single job does it now."""
        if self._pool is None:
            done: Future[str] = Future()
            done.set_result(perform(hand, to_text(task)))
            return done
        # A terminal sends Ctrl-C to all processes; only this one handles it. The pool's processes
        # inherit the blocked signal when they start.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            with child.spawning():
                return self._pool.submit(perform_apart, hand, to_text(task))
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def check(self) -> None:
        """Do nothing: its task reports a lost process."""

    def failed(self, error: BaseException) -> None:
        """Raise the reason."""
        if isinstance(error, BrokenProcessPool):
            raise WorkerLost(
                "a process with trials was killed, perhaps for lack of memory"
            ) from error
        raise error

    def refuse(self, worker: str, why: str) -> None:
        """Raise `WorkerLost`: all processes read the same files, so these have changed."""
        raise WorkerLost(f"{worker} read files that have changed since the sweep began: {why}")

    def close(self) -> None:
        """End the processes at once."""
        if self._pool is not None:
            # First, since leaving the pool waits for processes, and only this ends those at work.
            self._held.close()
            self._pool.shutdown(cancel_futures=True)
            self._leash.close()


class Sweep:
    """Runs tasks of hands, those of the lowest rank first, and skips known ones.

    Attributes:
        ended: How many tasks have an answer.
        left: How many have none yet.
    """

    def __init__(
        self, workers: Workers, known: Answers | TrialFile | None = None, *, again: bool = False
    ) -> None:
        """Start without tasks.

        Args:
            workers: The workers.
            known: Earlier answers; new ones are added.
            again: Repeat tasks that have an answer.
        """
        self.ended = 0
        self._workers, self._known, self._again = workers, known, again
        self._queue: list[tuple[int, int, str, Task]] = []
        self._running: dict[Future[str], tuple[int, int, str, Task]] = {}
        self._number = itertools.count()
        self._tries = Counter[int]()

    @property
    def left(self) -> int:
        """How many tasks have no answer yet."""
        return len(self._queue) + len(self._running)

    def add(self, hand: str, task: Task, rank: int = 0) -> None:
        """Add a task of a hand, by name or folder; possible while the sweep runs."""
        heapq.heappush(self._queue, (rank, next(self._number), hand, task))

    def run(self) -> Generator[tuple[str, Task, Answer]]:
        """Do the tasks; yield each, with its hand, and the answer as it comes.

        Raises:
            WorkerLost: if no worker is left, or a task ends each of its workers.
        """
        try:
            while self.left:
                while self._queue and len(self._running) < self._workers.capacity:
                    entry = heapq.heappop(self._queue)
                    *_, hand, task = entry
                    known = None
                    if self._known is not None and not self._again:
                        known = self._known.find(task, MadeWith.of(hand, task))
                    if known is not None:
                        self.ended += 1
                        yield hand, task, known
                        continue
                    self._running[self._workers.submit(hand, task)] = entry
                ended, _ = wait(self._running, _LOOK, FIRST_COMPLETED)
                self._workers.check()
                for future in ended:
                    entry = self._running.pop(future)
                    *_, hand, task = entry
                    answer = self._answer(future, entry)
                    if answer is None:
                        heapq.heappush(self._queue, entry)
                        continue
                    self.ended += 1
                    yield hand, task, answer
        finally:
            self._workers.close()

    def _answer(self, future: Future[str], entry: tuple[int, int, str, Task]) -> Answer | None:
        """Return a worker's answer; ``None`` if the task has to be tried again."""
        _, number, hand, task = entry
        self._tries[number] += 1
        error = None if future.cancelled() else future.exception()
        if future.cancelled() or error is not None:
            reason = error or WorkerLost("it was cancelled")
            if isinstance(error, UserError) or self._tries[number] >= _TRIES:
                raise reason
            self._workers.failed(reason)
            return None
        said = json.loads(future.result())
        expected, used = MadeWith.of(hand, task), validated(MadeWith, said["made_with"])
        difference = expected.difference(used)
        if difference:
            self._workers.refuse(said["worker"], difference)
            return None
        answer = answer_of(task, said["answer"])
        if self._known is not None:
            self._known.add(hand, task, used, said["worker"], answer)
        return answer


def end_with(leash: Connection) -> None:
    """End this process as soon as the other end of a pipe is closed, whatever it is doing.

    That end closes when the process that holds it is killed, too.
    """

    def watch() -> None:
        leash.poll(None)
        # From a thread, sys.exit would end the thread alone.
        os._exit(1)

    threading.Thread(target=watch, name="leash", daemon=True).start()
