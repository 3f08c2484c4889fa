"""Percentiles of a stream of durations in fixed memory."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from itertools import accumulate

from rtee.types import LoopStatistics

_FIRST = 5  # leading bits that a bucket keeps of a duration: 1/32, so that buckets are 3 % wide
_SUB = 1 << _FIRST


class Histogram:
    """Counts durations in buckets whose width grows with the value: 3 % wide, of fixed number.

    Up to 63 ns every value has its own bucket; above, every power of two is cut into 32 buckets
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

    def percentile(self, percent: float) -> float:
        """Return the duration [s] that ``percent`` of all do not exceed; 0 if there are none."""
        return self.percentiles((percent,))[0]

    def percentiles(self, percents: tuple[float, ...]) -> list[float]:
        """Return several percentiles [s] in one pass."""
        if not self.count:
            return [0.0] * len(percents)
        seen = list(accumulate(self._counts))
        buckets = (bisect_left(seen, percent / 100 * self.count) for percent in percents)
        # The upper end of the last bucket may lie above the longest duration.
        return [min(_upper(min(k, self._last)), self.maximum) * 1e-9 for k in buckets]

    def at_most(self, bounds: Sequence[float]) -> list[int]:
        """Return the number of durations up to each bound [s], to the width of a bucket."""
        seen = list(accumulate(self._counts))
        return [seen[min(_bucket(int(bound * 1e9)), self._last)] for bound in bounds]

    def total(self) -> float:
        """Return the sum of all durations [s], to the width of a bucket."""
        # A copy, since another thread may be counting.
        return sum(n * _upper(k) for k, n in enumerate(tuple(self._counts)) if n) * 1e-9

    def clear(self) -> None:
        """Forget all durations."""
        self._counts = [0] * len(self._counts)
        self.count = 0
        self.maximum = 0


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
        started: Whether the first tick has passed, which has no busy time yet.
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
        # Once a second [ns]: over less, the figure would jump with the lateness of two ticks.
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
