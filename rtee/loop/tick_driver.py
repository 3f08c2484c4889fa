"""One clock for one hand or several."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from rtee.loop.clock import AnyClock, Tick
from rtee.loop.handloop import HandLoop
from rtee.loop.histogram import TickStatistics


async def drive(
    loops: Sequence[HandLoop], clock: AnyClock, idle: Callable[[int], None] | None = None
) -> None:
    """Tick some hands on one clock until cancelled, or until the clock ends.

    The busy time of a tick is the processor time that this thread uses from one wake-up to the
    next, for the hands, their devices' tasks, recording and publishing.

    Args:
        loops: The hands.
        clock: Their clock.
        idle: Called after each tick with the due time of the next one, CLOCK_MONOTONIC [ns].
    """
    statistics = TickStatistics(clock.rate)
    period_ns = round(clock.period * 1e9)
    for loop in loops:
        loop.clock_statistics = statistics
    used = time.thread_time_ns()

    def at_tick(tick: Tick) -> None:
        nonlocal used
        before, used = used, time.thread_time_ns()
        if statistics.started:
            statistics.add(tick.woken_ns, tick.lateness_ns, used - before, tick.missed)
        statistics.started = True
        # The devices of all hands before any observer, which may wake other threads.
        for loop in loops:
            loop.cycle(tick)
        for loop in loops:
            loop.notify_observers()
        if idle is not None:
            idle(tick.due_ns + period_ns)

    await clock.drive(at_tick)
