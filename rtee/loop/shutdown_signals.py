"""The signals that end a run, and the programs that run beside it."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress

import anyio

from rtee import child

log = logging.getLogger(__name__)

_SIGNALS = [
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")
    if hasattr(signal, name)
]

_LOOK_EVERY = 0.5
"""Interval at which a companion checks whether its run still exists [s]: too short for a person to
notice, too long to load the computer."""

Signals = AsyncIterator[signal.Signals] | None
"""Iterator over received signals; ``None`` outside of the main thread, which alone receives
them."""


def receive_signals() -> AbstractContextManager[Signals]:
    """Receive the signals that end a run; signals are kept until they are awaited."""
    if threading.current_thread() is not threading.main_thread():
        return nullcontext()
    return anyio.open_signal_receiver(*_SIGNALS)


async def wait_for_end(duration: float | None, until: anyio.Event, signals: Signals) -> str:
    """Wait for a signal, the end of a duration or an event; return the reason in words.

    Args:
        duration: Longest time to wait [s]; ``None``: without limit.
        until: Ends the wait when it is set; it is always set afterwards.
        signals: The received signals.
    """
    reasons: list[str] = []

    async def after_signal(received: AsyncIterator[signal.Signals]) -> None:
        async for number in received:
            reasons.append(f"received {signal.Signals(number).name}")
            until.set()

    async def after_duration(seconds: float) -> None:
        await anyio.sleep(seconds)
        reasons.append(f"ran for {seconds:g} s")
        until.set()

    async with anyio.create_task_group() as group:
        if signals is not None:
            group.start_soon(after_signal, signals)
        if duration is not None:
            group.start_soon(after_duration, duration)
        await until.wait()
        group.cancel_scope.cancel()
    return reasons[0] if reasons else "the run ended"


_END_WITHIN = 2.0
"""Time that a companion has to end after SIGTERM [s]: the GUI takes some tenths of a second."""


async def companion(command: Sequence[str], cpus: Collection[int] = ()) -> None:
    """Run a program until it ends; when this is cancelled, the program is terminated.

    Args:
        command: The program and its arguments.
        cpus: The CPUs it may run on; none: those of the calling thread.
    """
    try:
        process = await anyio.open_process(
            command, stdin=None, stdout=None, stderr=None, env=child.environment()
        )
    except OSError as error:
        log.error("%s cannot be started: %s", command[0], error)
        return
    try:
        if cpus:
            with suppress(ProcessLookupError):  # it may have ended already
                os.sched_setaffinity(process.pid, cpus)
        if status := await process.wait():
            log.warning(
                "'%s' has ended with status %d; the hand goes on", " ".join(command), status
            )
    finally:
        if process.returncode is None:
            process.terminate()
            with anyio.move_on_after(_END_WITHIN, shield=True):
                await process.wait()
        if process.returncode is None:  # it ignored SIGTERM; the hand must not wait for it
            with suppress(ProcessLookupError):
                process.kill()
        with anyio.CancelScope(shield=True):
            await process.aclose()


def beside_this_run(*words: str) -> tuple[str, ...]:
    """Return the command line of an `rtee` command that runs beside this process, ending with it.

    Args:
        words: The command and its arguments; it must have the option ``--beside``; see
            `work_beside`.
    """
    return (*child.python("-m", "rtee", *words), "--beside", str(os.getpid()))


async def work_beside(run: int | None, work: Callable[[], Awaitable[object]]) -> None:
    """Await ``work`` until the run that started this process has ended, even if it was killed.

    Args:
        run: Process id of the run; ``None``: work until cancelled.
        work: The work to do, which is cancelled at the end.
    """

    async def end(scope: anyio.CancelScope) -> None:
        while os.getppid() == run:  # noqa: ASYNC110 - there is no event for this
            await anyio.sleep(_LOOK_EVERY)
        scope.cancel()

    failure: Exception | None = None
    async with anyio.create_task_group() as group:
        if run is not None:
            group.start_soon(end, group.cancel_scope)
        try:
            await work()
        except Exception as error:  # a task group would wrap it, and hide a user's mistake
            failure = error
        group.cancel_scope.cancel()
    if failure is not None:
        raise failure
