from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.loop.clock import Histogram, TickStatistics

DURATIONS = st.lists(st.integers(0, 10**10), min_size=1, max_size=300)


@given(DURATIONS, st.sampled_from([50.0, 99.0, 99.9, 100.0]))
def test_percentiles_are_within_a_bucket_of_the_true_ones(
    durations: list[int], percent: float
) -> None:
    histogram = Histogram()
    for duration in durations:
        histogram.add(duration)
    rank = max(1, math.ceil(percent / 100 * len(durations) - 1e-9))
    true = sorted(durations)[rank - 1]
    found = histogram.percentiles((percent,))[0] * 1e9
    assert true - 1e-6 <= found <= true * (1 + 1 / 32) + 1


@given(DURATIONS)
def test_maximum_and_count_are_exact(durations: list[int]) -> None:
    histogram = Histogram()
    for duration in durations:
        histogram.add(duration)
    assert histogram.maximum == max(durations)
    assert histogram.count == len(durations)
    assert histogram.percentiles((100.0,))[0] == pytest.approx(max(durations) * 1e-9)


def test_memory_does_not_grow_and_extremes_fit() -> None:
    histogram = Histogram(limit_ns=10**9)
    size = len(histogram._counts)
    for duration in (-5, 0, 1, 31, 32, 63, 64, 10**9, 10**15):
        histogram.add(duration)
    assert len(histogram._counts) == size
    assert sum(histogram._counts) == 9
    assert histogram.maximum == 10**15

    assert Histogram().percentiles((50.0, 99.0)) == [0.0, 0.0]


def test_statistics_tell_rate_missed_and_percentiles() -> None:
    statistics = TickStatistics(1000)
    rng = np.random.default_rng(3)
    woken = 0
    for tick in range(3000):
        woken = tick * 1_000_000
        statistics.add(woken, int(rng.integers(10_000, 90_000)), 50_000, tick == 5)
    summary = statistics.summary(dropped=4)
    assert summary.ticks == 3000
    assert summary.missed == 1
    assert summary.dropped == 4
    assert summary.measured_rate == pytest.approx(1000, rel=1e-3)
    assert 40e-6 < summary.lateness_p50 < 60e-6
    assert summary.lateness_p50 <= summary.lateness_p99 <= summary.lateness_max < 90e-6
    assert summary.busy_p50 == pytest.approx(50e-6, rel=0.04)
