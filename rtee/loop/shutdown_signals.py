"""The signals that end a run, and the programs that run beside it."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import AsyncIterator, Collection, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress

import anyio

log = logging.getLogger(__name__)

_SIGNALS = [
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")
    if hasattr(signal, name)
]


Signals = AsyncIterator[signal.Signals] | None
"""Signals as they arrive; ``None`` outside of the main thread, which alone receives them."""


def receive_signals() -> AbstractContextManager[Signals]:
    """Receive the signals that end a run; one that arrives before it is awaited is kept."""
    if threading.current_thread() is not threading.main_thread():
        return nullcontext()
    return anyio.open_signal_receiver(*_SIGNALS)


async def wait_for_end(duration: float | None, until: anyio.Event, signals: Signals) -> str:
    """Wait for a signal, the end of a duration or an event; return in words what it was.

    Args:
        duration: How long to wait at most [s]; ``None``: without end.
        until: Ends the wait when it is set; it is always set afterwards.
        signals: The signals received.
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


async def companion(command: Sequence[str], cpus: Collection[int] = ()) -> None:
    """Run a program until it ends; when this is cancelled, the program is terminated.

    Args:
        command: The program and its arguments.
        cpus: The CPUs it may run on; none: those of the calling thread.
    """
    try:
        process = await anyio.open_process(command, stdin=None, stdout=None, stderr=None)
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
        with anyio.CancelScope(shield=True):
            await process.aclose()
