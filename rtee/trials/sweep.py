"""Many trials on all processors: the actions of a hand with a standard set of objects."""

from __future__ import annotations

import gc
import importlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Generator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from rtee import child
from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError, RteeError, WorkerLost, needing_extra
from rtee.hand.load import hand_folder, load_configured
from rtee.hand.model import Hand
from rtee.loop.configure import loop_settings
from rtee.loop.settings import LoopSettings
from rtee.trials.result import CHOOSING, OBJECTS, mass_of
from rtee.trials.trial import Trial, TrialResult, run_trial

RATE = 250.0
"""Ticks per second of a trial [Hz]."""


@dataclass(frozen=True)
class Bench:
    """A hand ready for trials."""

    hand: Hand
    library: ActionLibrary
    settings: LoopSettings
    folder: Path


@lru_cache(maxsize=4)
def bench(name: str, rate: float = RATE) -> Bench:
    """Load a hand, by name or folder, for trials at a rate [Hz].

    Raises:
        UserError: for every mistake in its files.
    """
    hand, config = load_configured(name)
    folder = hand_folder(name)[0]
    library = ActionLibrary.load(hand, folder / "actions")
    return Bench(hand, library, loop_settings(config, rate=rate), folder)


def all_trials(
    library: ActionLibrary,
    objects: Sequence[str] = OBJECTS,
    variations: int = 0,
    seed: int = 0,
    choosing: int = CHOOSING,
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
        )
        for action in library
        for shape in objects
    ]


def attempt(name: str, trial: Trial) -> TrialResult:
    """Run one trial of a hand; the result of a trial that cannot be run says why."""
    ready = bench(name)
    try:
        return run_trial(ready.hand, ready.library, ready.settings, trial)
    except RteeError as error:
        return TrialResult(trial, False, str(error))


@lru_cache(maxsize=1)
def _freeze_loaded(name: str) -> None:
    """Have the garbage collector leave alone, from now on, what is loaded once a hand is.

    It stays anyway, and looking through all modules again and again takes 6 % of a trial's time.
    """
    bench(name)
    gc.freeze()


def _attempt_apart(name: str, trial: Trial) -> TrialResult:
    """Do one trial in a process that does nothing else."""
    _freeze_loaded(name)
    return attempt(name, trial)


def sweep(name: str, trials: Sequence[Trial], jobs: int) -> Generator[TrialResult]:
    """Do trials in several processes; results come as they are done.

    The processes end with this one, however it ends, and with the iteration: at once, what they are
    at is given up.

    Args:
        name: The hand, by name or folder.
        trials: What is tried.
        jobs: Number of processes.

    Raises:
        WorkerLost: if one of the processes was ended from outside.
    """
    if jobs < 2 or len(trials) < 2:
        for trial in trials:
            yield attempt(name, trial)
        return
    context = multiprocessing.get_context("spawn")
    leash, held = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(
        min(jobs, len(trials)), mp_context=context, initializer=end_with, initargs=(leash,)
    )
    with pool:
        try:
            # Ctrl-C, which a terminal sends to all processes, is left to this one: the others are
            # born with it blocked.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            with child.spawning():
                futures = [pool.submit(_attempt_apart, name, trial) for trial in trials]
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            # All processes are started by now; each has its own copy of this end.
            leash.close()
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool as error:
            raise WorkerLost(
                "a process that did trials was ended from outside, perhaps for want of memory"
            ) from error
        finally:
            # First, since leaving the pool waits for processes, and only this ends those at work.
            held.close()
            pool.shutdown(wait=False, cancel_futures=True)


def end_with(leash: Connection) -> None:
    """End this process as soon as the other end of a pipe is closed, whatever it is doing.

    That end closes when the process that holds it is killed, too.
    """

    def watch() -> None:
        leash.poll(None)
        # From a thread, sys.exit would end the thread alone.
        os._exit(1)

    threading.Thread(target=watch, name="leash", daemon=True).start()


def sweep_on_cluster(name: str, trials: Sequence[Trial], address: str) -> Generator[TrialResult]:
    """Do trials on a Dask cluster; results come as they are done, equal to those of `sweep`.

    Args:
        name: The hand, by name or by a folder that all workers see.
        trials: What is tried.
        address: Address of the cluster's scheduler.

    Raises:
        MissingExtra: if Dask is missing.
        ConfigError: if the scheduler does not answer.
    """
    with needing_extra("a sweep on a cluster", "sweep"):
        distributed: Any = importlib.import_module("distributed")
    try:
        client = distributed.Client(address, timeout=10)
    except (OSError, ValueError) as error:
        raise ConfigError(f"no Dask scheduler answers at '{address}': {error}") from error
    with client:
        # Not pure: equal calls must not be answered from memory, since the hand's files may change.
        futures = [client.submit(attempt, name, trial, pure=False) for trial in trials]
        for future in distributed.as_completed(futures):
            yield future.result()
