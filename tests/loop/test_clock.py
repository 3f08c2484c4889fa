"""The clock. Real-time tests assert what must hold on any machine, never how long it took."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import time
from collections.abc import Callable

import pytest

from rtee import monotonic
from rtee.buses import timerfd
from rtee.errors import ConfigError
from rtee.loop.clock import Clock, ManualClock, Tick
from rtee.testing import simulated_time

pytestmark = pytest.mark.anyio


@pytest.fixture(params=[False, True], ids=["asyncio", "uvloop"])
def anyio_backend(request: pytest.FixtureRequest) -> tuple[str, dict[str, bool]]:
    """Run the tests with both event loops that `rtee run` chooses from."""
    if request.param:
        pytest.importorskip("uvloop")
    return "asyncio", {"use_uvloop": request.param}


class EnoughError(Exception):
    pass


async def take(
    clock: Clock | ManualClock, count: int, at: Callable[[Tick], object] = lambda tick: None
) -> list[Tick]:
    found: list[Tick] = []

    def take_tick(tick: Tick) -> None:
        found.append(tick)
        at(tick)
        if len(found) == count:
            raise EnoughError

    with contextlib.suppress(EnoughError):
        await clock.drive(take_tick)
    return found


@pytest.mark.parametrize("use_timerfd", [True, False])
async def test_ticks_are_on_absolute_deadlines(use_timerfd: bool) -> None:
    clock = Clock(200, use_timerfd=use_timerfd)
    ticks = await take(clock, 20)
    start = ticks[0].due_ns - ticks[0].number * clock.period_ns
    for before, tick in itertools.pairwise(ticks):
        assert tick.due_ns == start + tick.number * clock.period_ns
        assert tick.number == before.number + 1 + tick.missed
    assert all(tick.lateness_ns >= 0 for tick in ticks)


@pytest.mark.parametrize("use_timerfd", [True, False])
async def test_missed_ticks_are_counted_and_not_caught_up(use_timerfd: bool) -> None:
    clock = Clock(1000, use_timerfd=use_timerfd)
    seen = itertools.count(1)
    ticks = await take(clock, 6, lambda _: time.sleep(0.05 if next(seen) == 3 else 0.0))
    numbers, missed = [tick.number for tick in ticks], sum(tick.missed for tick in ticks)
    assert missed >= 49
    assert numbers[-1] - numbers[0] == len(numbers) - 1 + missed - (numbers[0] - 0)


@pytest.mark.parametrize("use_timerfd", [True, False])
async def test_the_first_tick_that_happens_is_number_0(use_timerfd: bool) -> None:
    clock = Clock(1000, use_timerfd=use_timerfd)
    asyncio.get_running_loop().call_soon(time.sleep, 0.05)  # it is held up before the first
    first, second = await take(clock, 2)
    assert (first.number, first.missed) == (0, 0)
    assert second.due_ns == first.due_ns + second.number * clock.period_ns


async def test_a_driven_function_gets_number_0_first() -> None:
    found: list[Tick] = []

    def at_tick(tick: Tick) -> None:
        found.append(tick)
        raise LookupError

    asyncio.get_running_loop().call_soon(time.sleep, 0.05)
    with pytest.raises(LookupError):
        await Clock(1000).drive(at_tick)
    assert (found[0].number, found[0].missed) == (0, 0)


async def test_other_tasks_run_though_ticks_take_too_long() -> None:
    turns = 0

    async def other() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    task = asyncio.create_task(other())
    await take(Clock(2000), 10, lambda _: time.sleep(0.002))  # longer than the period
    task.cancel()
    assert turns >= 10


@pytest.mark.parametrize("rate", [0.0, 0.5, 2001.0, float("nan"), float("inf"), -1.0])
def test_rates_out_of_range_are_refused(rate: float) -> None:
    with pytest.raises(ConfigError, match="1 to 2000 Hz"):
        Clock(rate)


async def test_the_descriptor_is_given_back() -> None:
    if not timerfd.available():
        pytest.skip("no timerfd here")
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        await take(Clock(2000), 3)
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_closed_timer_stays_closed() -> None:
    if not timerfd.available():
        pytest.skip("no timerfd here")
    timer = timerfd.Timer(time.monotonic_ns() + 10**9, 10**6)
    assert timer.expiries() == 0
    timer.close()
    timer.close()
    assert timer.fd == -1


async def test_manual_clock_moves_only_by_hand() -> None:
    clock = ManualClock(500, ticks=4, start=7.0)
    assert clock.now() == 7.0
    ticks = await take(clock, 4)
    assert [tick.number for tick in ticks] == [0, 1, 2, 3]
    assert clock.now() == pytest.approx(7.006)
    assert clock.next(missed=2).number == 6
    assert ticks[3].stamp == pytest.approx(7.006)
    assert ticks[3].lateness_ns == 0


@pytest.mark.parametrize("use_timerfd", [True, False])
async def test_driving_counts_what_a_function_misses_and_ends_with_its_error(
    use_timerfd: bool,
) -> None:
    ticks: list[Tick] = []

    def take_tick(tick: Tick) -> None:
        ticks.append(tick)
        if len(ticks) == 3:
            time.sleep(0.02)
        if len(ticks) == 8:
            raise EnoughError

    clock = Clock(500, use_timerfd=use_timerfd)
    with pytest.raises(EnoughError):
        await clock.drive(take_tick)
    await asyncio.sleep(0.01)
    assert len(ticks) == 8, "it is over when the function raises"
    start = ticks[0].due_ns - ticks[0].number * clock.period_ns
    for before, tick in itertools.pairwise(ticks):
        assert tick.due_ns == start + tick.number * clock.period_ns
        assert tick.number == before.number + 1 + tick.missed
    assert sum(tick.missed for tick in ticks) >= 9


async def test_driving_ends_when_cancelled() -> None:
    ticks: list[Tick] = []
    enough = asyncio.Event()

    def take_tick(tick: Tick) -> None:
        ticks.append(tick)
        if len(ticks) == 3:
            enough.set()

    task = asyncio.create_task(Clock(1000).drive(take_tick))
    await enough.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    done = len(ticks)
    await asyncio.sleep(0.01)
    assert len(ticks) == done


async def test_a_manual_clock_drives_as_far_as_it_goes() -> None:
    ticks: list[Tick] = []
    await ManualClock(100, ticks=5).drive(ticks.append)
    assert [tick.number for tick in ticks] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("anyio_backend", [simulated_time()], ids=["simulated"])
async def test_a_manual_clock_waits_no_longer_than_others_run() -> None:
    """Every turn of the event loop costs time, at every tick."""
    clock, ran = ManualClock(1000), 0

    async def work() -> None:
        nonlocal ran
        for _ in range(5):
            await asyncio.sleep(0)
            ran += 1

    async def settled() -> float:
        before = monotonic.now()  # each turn is a moment of simulated time
        await clock.settle()
        return monotonic.now() - before

    await settled()
    turn = await settled()
    assert turn > 0.0
    before = monotonic.now()
    await asyncio.sleep(0)
    assert turn == pytest.approx(monotonic.now() - before), "one turn in which nobody runs"
    task = asyncio.create_task(work())
    assert await settled() > 5.0 * turn
    assert ran == 5
    await task
