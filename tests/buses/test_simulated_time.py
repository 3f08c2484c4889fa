"""Time that passes only where nothing is left to do."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
import time

import pytest

from rtee import monotonic
from rtee.buses.link import Line, open_link
from rtee.buses.pool import BusPool
from rtee.buses.simulated_time import SimulatedQueue, SimulatedTimeLoop, on_simulated_time
from rtee.buses.timing import Pause
from rtee.buses.worker import Worker
from rtee.errors import BusBroken, BusBusy, BusTimeout
from rtee.loop.clock import Clock, Tick
from rtee.testing import simulated_time
from tests.buses.devices import Echo, StarParser, frame_of

pytestmark = pytest.mark.anyio

A_DAY = 86400.0


@pytest.fixture
def anyio_backend() -> object:
    return simulated_time()


def the_loop() -> SimulatedTimeLoop:
    loop = on_simulated_time()
    assert loop is not None
    return loop


async def test_every_wait_ends_at_its_time_and_no_real_time_passes() -> None:
    real, begun = time.monotonic(), monotonic.now()
    await asyncio.sleep(A_DAY)
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(A_DAY):
            await asyncio.Event().wait()
    pause = Pause()
    await pause.until(monotonic.now() + A_DAY)
    pause.close()
    assert monotonic.now() - begun == pytest.approx(3 * A_DAY, abs=0.001)
    assert monotonic.now_ns() == pytest.approx(monotonic.now() * 1e9)
    assert time.monotonic() - real < A_DAY


async def test_the_clock_of_the_loop_ticks_in_it_without_missing_a_tick() -> None:
    ticks: list[Tick] = []

    def take_tick(tick: Tick) -> None:
        ticks.append(tick)
        if len(ticks) == 1000:
            raise StopAsyncIteration

    with contextlib.suppress(StopAsyncIteration):
        await Clock(1000).drive(take_tick)
    assert not any(tick.missed for tick in ticks)
    assert ticks[-1].due_ns - ticks[0].due_ns == 999_000_000
    assert max(tick.lateness_ns for tick in ticks) < 100_000


async def test_it_stands_still_while_a_thread_computes_and_passes_while_that_waits() -> None:
    seen = []

    def compute() -> None:
        before = monotonic.now()
        time.sleep(0.05)
        seen.append(monotonic.now() - before)
        monotonic.sleep(100.0)
        seen.append(monotonic.now() - before)

    ticking = asyncio.create_task(asyncio.sleep(1000.0))
    await asyncio.to_thread(compute)
    worker = Worker("test")
    await worker.run(compute, 200.0)
    await worker.close()
    ticking.cancel()
    assert seen == pytest.approx([0.0, 100.0, 0.0, 100.0], abs=0.001)


async def test_a_thread_that_waits_too_long_is_given_up_at_its_deadline() -> None:
    worker, begun = Worker("test"), monotonic.now()
    with pytest.raises(TimeoutError):
        await worker.run(lambda: monotonic.sleep(30.0), 10.0)
    assert monotonic.now() - begun == pytest.approx(10.0, abs=0.001)
    # The next call waits for the first, and closing for the last.
    assert await worker.run(monotonic.now, 60.0) - begun == pytest.approx(30.0, abs=0.001)
    with pytest.raises(TimeoutError):
        await worker.run(lambda: monotonic.sleep(30.0), 10.0)
    await worker.close()
    assert monotonic.now() - begun == pytest.approx(60.0, abs=0.001)


async def test_a_queue_gives_what_comes_in_time() -> None:
    loop = the_loop()
    answers = SimulatedQueue(loop)
    loop.call_later(5.0, answers.put, "late")
    with pytest.raises(queue.Empty):
        await asyncio.to_thread(answers.get, True, 4.0)
    assert await asyncio.to_thread(answers.get, True, 4.0) == "late"
    loop.call_later(A_DAY, answers.put, "much later")
    begun = monotonic.now()
    assert await asyncio.to_thread(answers.get) == "much later"
    assert monotonic.now() - begun == pytest.approx(A_DAY, abs=0.001)


def test_outside_of_it_time_is_real_and_threads_that_wait_in_it_end() -> None:
    ended = threading.Event()

    def wait() -> None:
        monotonic.sleep(A_DAY)
        ended.set()

    async def begin() -> None:
        assert monotonic.now() < A_DAY
        threading.Thread(target=wait).start()
        await asyncio.to_thread(time.sleep, 0.05)

    with asyncio.Runner(loop_factory=SimulatedTimeLoop) as runner:
        runner.run(begin())
    assert ended.wait(30.0)
    assert on_simulated_time() is None
    assert abs(monotonic.now() - time.monotonic()) < 1.0


async def test_an_exchange_takes_the_time_of_its_bytes_and_silence_that_of_its_deadline() -> None:
    async with BusPool() as pool:
        bus = await pool.serial("/dev/x", owner="a", baudrate=9600, emulator=Echo)
        begun, sent = monotonic.now(), frame_of(b"hello")
        assert await bus.transact(sent, StarParser(), 1.0) == b"HELLO"
        taken = monotonic.now() - begun
        assert taken == pytest.approx(2 * len(sent) * 10 / 9600, abs=0.001)
        with pytest.raises(BusTimeout):
            await bus.transact(frame_of(b"?"), StarParser(), 0.031)
        assert monotonic.now() - begun - taken == pytest.approx(0.031, abs=0.001)


async def test_a_port_is_like_a_real_one_for_those_who_open_it() -> None:
    async with BusPool() as pool:
        bus = await pool.serial("/dev/x", owner="a", emulator=Echo)
        address = pool.simulations["/dev/x"].address
        with pytest.raises(BusBusy):
            await open_link(address, Line(), asyncio.Protocol)
        pool.simulations["/dev/x"].unplug()
        await asyncio.sleep(0.0)
        with pytest.raises(BusBroken, match="vanished"):
            bus.check()
        with pytest.raises(BusBroken, match="no such port"):
            await bus.connect()
    with pytest.raises(BusBroken, match="no such port"):
        await open_link(address, Line(), asyncio.Protocol)


def test_its_computer_is_suspended_only_by_a_test() -> None:
    before = monotonic.suspended

    async def look() -> list[float]:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, SimulatedTimeLoop)
        begun, slept = loop.time(), [monotonic.suspended()]
        loop.suspended += 5.0
        await asyncio.sleep(1.0)
        return [*slept, monotonic.suspended(), round(loop.time() - begun)]

    with asyncio.Runner(loop_factory=SimulatedTimeLoop) as runner:
        assert runner.run(look()) == [0.0, 5.0, 1.0]
    assert monotonic.suspended is before
