"""Measure whether a load makes another hand's ticks later, in alternating stretches."""

from __future__ import annotations

import asyncio
import math
import statistics
from dataclasses import dataclass

from rtee.loop.clock import Clock

RATE = 1000.0
"""Rate of the other hand [Hz]."""
TOLERANCE = 50.0
"""A smaller change of the lateness, a twentieth of the tick, counts as none [µs]."""


class Lateness:
    """A clock of 1 kHz in the same event loop, as another hand would have."""

    def __init__(self) -> None:
        self.values: list[float] = []
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Lateness:
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *exc: object) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _run(self) -> None:
        await Clock(RATE).drive(lambda tick: self.values.append(tick.lateness_ns * 1e-3))

    def taken(self) -> tuple[float, float] | None:
        """Return p50 and p99 since the last call [µs]."""
        found, self.values = sorted(self.values), []
        # Too few for a 99th percentile that means anything.
        if len(found) < 20:
            return None
        return statistics.median(found), found[int(0.99 * (len(found) - 1))]


@dataclass(frozen=True, slots=True)
class Difference:
    """The change of the lateness with the load.

    Attributes:
        without: Median over the stretches [µs].
        beside: The same of the stretches with it [µs].
        low: Lower end of the 95 % interval of the median of the pairs' differences [µs].
        high: Upper end [µs].
    """

    without: float
    beside: float
    low: float
    high: float

    def cells(self) -> tuple[str, str, str]:
        """Return the cells of a table: without, with, and the interval of the change."""
        change = f"{self.low:+.0f} … {self.high:+.0f}"
        return f"{self.without:.0f}", f"{self.beside:.0f}", change


class Beside:
    """Lateness of another hand without and with the load, in alternating stretches."""

    def __init__(self, clock: Lateness) -> None:
        self._clock = clock
        self._stretches: dict[bool, list[tuple[float, float]]] = {False: [], True: []}

    def begin(self) -> None:
        """Begin a stretch: forget the ticks before it."""
        self._clock.taken()

    def end(self, *, fault: bool) -> None:
        """Note the stretch since `begin`; those without and with the fault must alternate."""
        self._stretches[fault].append(self._clock.taken() or (math.nan, math.nan))

    def differences(self) -> tuple[Difference, Difference]:
        """Return the changes of the median and of the 99th percentile of the lateness."""
        pairs = [
            (a, b)
            for a, b in zip(self._stretches[False], self._stretches[True], strict=True)
            if math.isfinite(a[0] + b[0])
        ]
        return _difference(pairs, 0), _difference(pairs, 1)


def verdict(differences: tuple[Difference, Difference]) -> str:
    """Return in a word whether the lateness is unchanged: its median and its 99th percentile."""
    if all(d.high <= TOLERANCE for d in differences):
        return "unchanged"
    if any(d.low > TOLERANCE for d in differences):
        return "LATER"
    return "not shown"


def _difference(
    pairs: list[tuple[tuple[float, float], tuple[float, float]]], which: int
) -> Difference:
    if not pairs:
        return Difference(math.nan, math.nan, math.nan, math.nan)
    changes = sorted(b[which] - a[which] for a, b in pairs)
    n, k, outside = len(changes), 0, 0.0
    # Order statistics: the median lies below the k-th change with a binomial probability.
    while k < (n - 1) // 2:
        outside += 2.0 * math.comb(n, k) / 2.0**n
        # For an interval of 95 %.
        if outside > 0.05:
            break
        k += 1
    low = max(k - 1, 0)
    return Difference(
        statistics.median(a[which] for a, _ in pairs),
        statistics.median(b[which] for _, b in pairs),
        changes[low],
        changes[n - 1 - low],
    )
