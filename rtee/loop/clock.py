"""The loop's clock: a fixed rate on absolute deadlines; a missed tick is counted, not caught up."""

from __future__ import annotations

import asyncio
import math
import time
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Protocol

from rtee import monotonic
from rtee.buses import timerfd
from rtee.buses.simulated_time import on_simulated_time
from rtee.errors import ConfigError
from rtee.hand.config_schema import MAX_RATE, MIN_RATE
from rtee.types import LoopStatistics

_FIRST = 5  # leading bits of a duration that select its bucket: 1/32, so buckets are 3 % wide
_SUB = 1 << _FIRST


class Histogram:
    """Counts durations in a fixed number of buckets, each 3 % wide.

    Up to 63 ns, every value has its own bucket; above, every power of two is split into 32 buckets
    (the scheme of HdrHistogram). `maximum` is exact.

    Args:
        limit_ns: Longer durations are counted in the last bucket.
    """

    __slots__ = ("_counts", "_last", "count", "maximum")

    def __init__(self, limit_ns: int = 100_000_000_000) -> None:
        self._last = _bucket(limit_ns)
        self._counts = [0] * (self._last + 1)
        self.count = 0
        self.maximum = 0

    def add(self, nanoseconds: int) -> None:
        """Count a duration [ns]; a negative one counts as 0."""
        # Repeats `_bucket` instead of calling it: this runs twice at every tick.
        bucket = nanoseconds
        if nanoseconds >= _SUB:
            shift = nanoseconds.bit_length() - _FIRST - 1
            bucket = (shift << _FIRST) + (nanoseconds >> shift)
        elif nanoseconds < 0:
            bucket = 0
        self._counts[bucket if bucket < self._last else self._last] += 1
        self.count += 1
        if nanoseconds > self.maximum:
            self.maximum = nanoseconds

    def percentiles(self, percents: tuple[float, ...]) -> list[float]:
        """Return several percentiles [s] in one pass."""
        if not self.count:
            return [0.0] * len(percents)
        seen = list(accumulate(self._counts))
        buckets = (bisect_left(seen, percent / 100 * self.count) for percent in percents)
        # The upper end of the last bucket may lie above the longest duration.
        return [min(_upper(min(k, self._last)), self.maximum) * 1e-9 for k in buckets]

    def at_most(self, bounds: Sequence[float]) -> list[int]:
        """Return how many durations are at most each bound [s], to the resolution of a bucket."""
        seen = list(accumulate(self._counts))
        return [seen[min(_bucket(int(bound * 1e9)), self._last)] for bound in bounds]

    def total(self) -> float:
        """Return the sum of all durations [s], to the resolution of a bucket."""
        # A copy, since another thread may be counting.
        return sum(n * _upper(k) for k, n in enumerate(tuple(self._counts)) if n) * 1e-9


def _bucket(nanoseconds: int) -> int:
    if nanoseconds < _SUB:
        return max(nanoseconds, 0)
    shift = nanoseconds.bit_length() - _FIRST - 1
    return (shift << _FIRST) + (nanoseconds >> shift)


def _upper(bucket: int) -> int:
    """Return the largest duration that falls into a bucket [ns]."""
    if bucket < _SUB:
        return bucket
    shift = (bucket >> _FIRST) - 1
    return ((bucket - (shift << _FIRST) + 1) << shift) - 1


class TickStatistics:
    """Lateness, busy time and missed ticks of a clock since it started.

    Args:
        rate: Configured rate [Hz].

    Attributes:
        started: Whether the first tick has passed; it has no busy time.
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.started = False
        self.lateness = Histogram()
        self.busy = Histogram()
        self.ticks = 0
        self.missed = 0
        self.measured_rate = 0.0
        self._window_ticks = 0
        self._window_ns = 0

    def add(self, woken_ns: int, lateness_ns: int, busy_ns: int, missed: int) -> None:
        """Count one tick."""
        self.lateness.add(lateness_ns)
        self.busy.add(busy_ns)
        self.missed += missed
        if not self.ticks:
            self._window_ns = woken_ns
        self.ticks += 1
        passed = woken_ns - self._window_ns
        # Once a second [ns]: over a shorter time, one late tick would make the figure jump.
        if passed >= 1_000_000_000:
            self.measured_rate = (self.ticks - 1 - self._window_ticks) * 1e9 / passed
            self._window_ticks = self.ticks - 1
            self._window_ns = woken_ns

    def summary(self, dropped: int = 0) -> LoopStatistics:
        """Return the statistics as `LoopStatistics`."""
        lateness = self.lateness.percentiles((50.0, 99.0, 99.9))
        busy = self.busy.percentiles((50.0, 99.0, 99.9))
        return LoopStatistics(
            rate=self.rate,
            measured_rate=self.measured_rate,
            ticks=self.ticks,
            missed=self.missed,
            lateness_p50=lateness[0],
            lateness_p99=lateness[1],
            lateness_p999=lateness[2],
            lateness_max=self.lateness.maximum * 1e-9,
            busy_p50=busy[0],
            busy_p99=busy[1],
            busy_p999=busy[2],
            busy_max=self.busy.maximum * 1e-9,
            dropped=dropped,
        )


_NANOSECONDS = 1_000_000_000  # per second


@dataclass(slots=True)
class Tick:
    """One period of the loop.

    Attributes:
        number: Number of the tick: 0 for the first; a missed tick leaves a gap.
        due_ns: When it was due, CLOCK_MONOTONIC [ns].
        woken_ns: When the loop woke up for it, CLOCK_MONOTONIC [ns].
        missed: Ticks missed since the one before.
        wall_ns: Wall-clock time of its due time [ns since 1970].
    """

    number: int
    due_ns: int
    woken_ns: int
    missed: int
    wall_ns: int

    @property
    def stamp(self) -> float:
        """The due time, CLOCK_MONOTONIC [s]."""
        return self.due_ns * 1e-9

    @property
    def lateness_ns(self) -> int:
        """Time from the due time to the wake-up [ns]."""
        return self.woken_ns - self.due_ns


class AnyClock(Protocol):
    """The clock interface that the loop needs."""

    rate: float
    period_ns: int

    async def drive(self, function: Callable[[Tick], None]) -> None:
        """Call a function at every tick until cancelled, or until it raises or the clock ends."""


def _period_ns(rate: float) -> int:
    if not (math.isfinite(rate) and MIN_RATE <= rate <= MAX_RATE):
        raise ConfigError(f"the rate must be {MIN_RATE:g} to {MAX_RATE:g} Hz, not {rate:g}")
    return round(_NANOSECONDS / rate)


class _TickTimer(timerfd.Timer):
    """A timerfd that counts its expiries as ticks, from tick 0."""

    def __init__(self, period_ns: int) -> None:
        self._start = monotonic.now_ns() + period_ns
        self._period_ns = period_ns
        self._number = -1
        super().__init__(self._start, period_ns)

    def tick(self, passed: int) -> Tick:
        """Return the tick after the given number of expiries, all but one of which were missed."""
        woken, wall = monotonic.now_ns(), time.time_ns()
        if self._number < 0:
            # Late for the first tick: counting starts here, so that nothing counts as missed.
            self._start += (passed - 1) * self._period_ns
            passed = 1
        self._number += passed
        # From the start, not from the last tick: rounding and delays must not add up to drift.
        due = self._start + self._number * self._period_ns
        # Somebody may set the wall clock at any time: it is read once and shifted by the lateness.
        return Tick(self._number, due, woken, passed - 1, wall - (woken - due))


class Clock:
    """Ticks at a fixed rate; `drive` calls a function at each tick.

    On Linux, a timerfd wakes the event loop within about ten microseconds of the due time.
    Elsewhere the clock sleeps as precisely as the event loop can: asyncio rounds to a millisecond.

    Args:
        rate: Ticks per second [Hz], 1 to 2000.

    Raises:
        ConfigError: if the rate is out of range.
    """

    def __init__(self, rate: float, *, use_timerfd: bool = True) -> None:
        self.rate = float(rate)
        self.period_ns = _period_ns(rate)
        self.uses_timerfd = use_timerfd and timerfd.available() and not on_simulated_time()

    async def drive(self, function: Callable[[Tick], None]) -> None:
        """Call a function at every tick until it raises or the task is cancelled."""
        await (self._by_timer if self.uses_timerfd else self._by_sleep)(function)

    async def _by_timer(self, function: Callable[[Tick], None]) -> None:
        loop = asyncio.get_running_loop()
        timer = _TickTimer(self.period_ns)
        ended: asyncio.Future[None] = loop.create_future()

        def on_expiry() -> None:
            passed = timer.expiries()
            if not passed:
                return
            try:
                function(timer.tick(passed))
            except Exception as error:
                # asyncio only logs what a reader callback raises; here it has to end `drive`.
                loop.remove_reader(timer.fd)
                if not ended.done():
                    ended.set_exception(error)

        loop.add_reader(timer.fd, on_expiry)
        try:
            await ended
        finally:
            loop.remove_reader(timer.fd)
            timer.close()

    async def _by_sleep(self, function: Callable[[Tick], None]) -> None:
        start = monotonic.now_ns() + self.period_ns
        number = 0
        last = -1
        while True:
            due = start + number * self.period_ns
            # asyncio may wake up to a millisecond early; the next turn then sleeps for the rest.
            await asyncio.sleep(max(0.0, (due - monotonic.now_ns()) * 1e-9))
            woken, wall = monotonic.now_ns(), time.time_ns()
            # Woken a period or more too late: continue with the tick that is due now.
            number = max(number, (woken - start) // self.period_ns)
            if last < 0:  # the first tick is tick 0, however late
                start += number * self.period_ns
                number = 0
            due = start + number * self.period_ns
            if woken >= due:
                tick = Tick(number, due, woken, number - last - 1, wall - (woken - due))
                last = number
                number += 1
                function(tick)


class ManualClock:
    """A clock whose time the program sets: for tests and replay, at any speed.

    It ticks as fast as the loop takes the ticks; in between, every other task runs until it waits.

    Args:
        rate: Ticks per second of the clock's own time [Hz].
        ticks: Number of ticks after which `drive` returns; ``None``: never.
        start: The clock's time at the beginning [s].
        turns: Largest number of event-loop turns that the other tasks get between two ticks; in
            simulated time, fewer if all of them wait.
    """

    def __init__(
        self, rate: float, *, ticks: int | None = None, start: float = 1000.0, turns: int = 12
    ) -> None:
        self.rate = float(rate)
        self.period_ns = _period_ns(rate)
        self.ticks = ticks
        self.turns = turns
        self._start_ns = round(start * _NANOSECONDS)
        self._number = -1

    def now(self) -> float:
        """Return the clock's time [s]; replaces `rtee.monotonic.now`."""
        return (self._start_ns + max(self._number, 0) * self.period_ns) * 1e-9

    def next(self, missed: int = 0) -> Tick:
        """Advance by one tick, plus ``missed`` ticks, and return it."""
        self._number += 1 + missed
        due = self._start_ns + self._number * self.period_ns
        return Tick(self._number, due, due, missed, due)

    async def settle(self) -> None:
        """Let the other tasks run."""
        loop = on_simulated_time()
        rested = loop is not None and loop.idle()
        for _ in range(self.turns):
            # Several turns: a task that was woken may itself wake another one.
            await asyncio.sleep(0)
            before, rested = rested, loop is not None and loop.idle()
            if before and rested:  # a whole turn in which nothing else ran
                return

    async def drive(self, function: Callable[[Tick], None]) -> None:
        """Call a function at every tick; see `Clock.drive`."""
        done = 0
        while self.ticks is None or done < self.ticks:
            await self.settle()
            function(self.next())
            done += 1
