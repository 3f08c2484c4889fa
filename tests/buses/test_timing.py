"""Threads that others wait for are woken promptly."""

from __future__ import annotations

import asyncio
import ctypes
import os
import platform
import re
import struct
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from rtee.buses.pool import BusPool
from rtee.buses.simulated import SimulatedLine
from rtee.buses.timing import SLICE, Pause
from rtee.buses.worker import Worker
from tests.buses.devices import Echo, in_real_time

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")

_LONG_SLICE = 5_000_000  # [ns]; none that the project asks for


def slice_asked_for(thread: int = 0) -> int:
    """Return how much processor time a thread, by default this one, asks for at a time [ns]."""
    number = {"x86_64": 315, "aarch64": 275}[platform.machine()]
    attributes = ctypes.create_string_buffer(56)
    assert ctypes.CDLL(None).syscall(number, thread, attributes, 56, 0) == 0
    return int(struct.unpack_from("=24xQ", attributes.raw)[0])


def ask_for(runtime: int) -> None:
    """Ask for a time slice [ns] for this thread, which threads inherit that it starts."""
    number = {"x86_64": 314, "aarch64": 274}[platform.machine()]
    attributes = struct.pack("=IIQiIQQQ", 48, os.SCHED_OTHER, 0, os.nice(0), 0, runtime, 0, 0)
    assert ctypes.CDLL(None).syscall(number, 0, attributes, 0) == 0


def promptly() -> int:
    kernel = tuple(int(part) for part in re.findall(r"\d+", os.uname().release)[:2])
    return SLICE if kernel >= (6, 12) else 0


def test_the_thread_that_plays_a_device_asks_for_short_slices() -> None:
    with ThreadPoolExecutor(
        1
    ) as caller:  # a thread of its own: earlier tests may have set this one
        played, before, after = caller.submit(_play).result()
    assert played == promptly()
    assert before == after != SLICE, "the caller's own thread is left alone"


def _play() -> tuple[int, int, int]:
    """Return the slices [ns] of a thread that plays a device, and its caller's before and after."""
    ask_for(_LONG_SLICE)
    before = slice_asked_for()
    with SimulatedLine([Echo()]) as line:
        return line.call(slice_asked_for), before, slice_asked_for()


@pytest.mark.anyio
async def test_the_thread_of_a_blocking_library_asks_for_short_slices() -> None:
    worker = Worker("test")
    assert await worker.run(slice_asked_for, 5.0) == promptly()
    await worker.close()


@in_real_time
@pytest.mark.anyio
async def test_the_thread_that_reads_a_can_bus_asks_for_short_slices() -> None:
    async with BusPool() as pool:
        bus = await pool.can("can0", owner="a", emulator=Echo)
        (thread,) = bus._notifier._readers
        end = time.monotonic() + 5.0
        while slice_asked_for(thread.native_id) != promptly():
            assert time.monotonic() < end
            await asyncio.sleep(0.005)


@in_real_time
@pytest.mark.anyio
async def test_a_pause_ends_after_its_time_and_can_be_used_again() -> None:
    before = len(os.listdir("/proc/self/fd"))
    pause = Pause()
    for _ in range(2):
        for when in (time.monotonic() + 0.0004, time.monotonic() + 0.01, 0.0):
            await pause.until(when)
            assert time.monotonic() >= when
        called = asyncio.Event()
        pause.start(time.monotonic() + 60.0, called.set)
        pause.start(-1.0, called.set)  # anew, at a time that has passed
        await asyncio.wait_for(called.wait(), 30.0)
        pause.close()
        pause.close()
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.anyio
async def test_a_cancelled_pause_calls_nothing() -> None:
    pause, other = Pause(), Pause()
    pause.start(time.monotonic() + 0.001, lambda: pytest.fail("called"))
    pause.cancel()
    await other.until(time.monotonic() + 0.01)
    pause.close()
    other.close()
