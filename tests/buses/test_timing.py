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

import pytest

from rtee.buses.pool import BusPool
from rtee.buses.simulated import SimulatedLine
from rtee.buses.timing import SLICE
from rtee.buses.worker import Worker
from tests.buses.devices import Echo

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")


def slice_asked_for(thread: int = 0) -> int:
    """Return how much processor time a thread, by default this one, asks for at a time [ns]."""
    number = {"x86_64": 315, "aarch64": 275}[platform.machine()]
    attributes = ctypes.create_string_buffer(56)
    assert ctypes.CDLL(None).syscall(number, thread, attributes, 56, 0) == 0
    return int(struct.unpack_from("=24xQ", attributes.raw)[0])


def promptly() -> int:
    kernel = tuple(int(part) for part in re.findall(r"\d+", os.uname().release)[:2])
    return SLICE if kernel >= (6, 12) else 0


def test_the_thread_that_plays_a_device_asks_for_short_slices() -> None:
    with SimulatedLine([Echo()]) as line:
        assert line.call(slice_asked_for) == promptly()
    assert slice_asked_for() != SLICE, "the caller's own thread is left alone"


@pytest.mark.anyio
async def test_the_thread_of_a_blocking_library_asks_for_short_slices() -> None:
    worker = Worker("test")
    assert await worker.run(slice_asked_for, 5.0) == promptly()
    await worker.close()


@pytest.mark.anyio
async def test_the_thread_that_reads_a_can_bus_asks_for_short_slices() -> None:
    async with BusPool() as pool:
        bus = await pool.can("can0", owner="a", emulator=Echo)
        (thread,) = bus._notifier._readers
        end = time.monotonic() + 5.0
        while slice_asked_for(thread.native_id) != promptly():
            assert time.monotonic() < end
            await asyncio.sleep(0.005)
