"""One clock for one hand or several."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence

from rtee.loop.clock import AnyClock, Tick
from rtee.loop.hand_ticks import HandTicks
from rtee.loop.histogram import TickStatistics


async def drive(
    loops: Sequence[HandTicks], clock: AnyClock, idle: Callable[[int], None] | None = None
) -> None:
    """Tick some hands until cancelled or the clock ends.

    The busy time of a tick is the processor time that this thread used from one wake-up to the
    next: the hands, their devices' tasks, recording and publishing.

    Args:
        loops: The hands.
        clock: Their clock.
        idle: Called after each tick with when the next one is due, CLOCK_MONOTONIC [ns].
    """
    statistics = TickStatistics(clock.rate)
    period_ns = round(clock.period * 1e9)
    for loop in loops:
        loop.clock_statistics = statistics
    used = time.thread_time_ns()
    untold: list[Tick] = []
    failures: list[Exception] = []
    soon = asyncio.get_running_loop().call_soon

    def notify_observers() -> None:
        if not untold:
            return
        tick = untold.pop()
        try:
            for loop in loops:
                loop.notify_observers()
        except Exception as error:
            failures.append(error)
        if idle is not None:
            idle(tick.due_ns + period_ns)

    def at_tick(tick: Tick) -> None:
        nonlocal used
        before, used = used, time.thread_time_ns()
        if statistics.started:
            statistics.add(tick.woken_ns, tick.lateness_ns, used - before, tick.missed)
        statistics.started = True
        if failures:
            raise failures.pop()
        for loop in loops:
            loop.move_on(tick)
        untold.append(tick)
        soon(notify_observers)  # after the devices' tasks, which `move_on` has woken

    try:
        await clock.drive(at_tick)
    finally:
        notify_observers()
    if failures:
        raise failures.pop()
