"""The thread for blocking libraries."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest

from rtee.buses.worker import Worker
from tests.buses.devices import in_real_time

pytestmark = pytest.mark.anyio


async def test_calls_come_one_after_the_other_and_hand_back_what_they_return_or_raise() -> None:
    worker, seen = Worker("test"), []

    def call(number: int) -> int:
        seen.append(threading.current_thread().name)
        if number == 2:
            raise ValueError("two")
        return number

    tasks = [asyncio.ensure_future(worker.run(lambda n=n: call(n), 5.0)) for n in range(4)]  # type: ignore[misc]
    found = await asyncio.gather(*tasks, return_exceptions=True)
    assert [found[0], found[1], found[3]] == [0, 1, 3]
    assert isinstance(found[2], ValueError)
    assert seen == ["test"] * 4
    await worker.close()
    await worker.close()


@in_real_time
async def test_a_late_call_is_given_up_and_the_next_waits_for_it() -> None:
    worker, go, order = Worker("test"), threading.Event(), list[str]()

    def late() -> None:
        go.wait()
        order.append("late")

    with pytest.raises(TimeoutError):
        await worker.run(late, 0.01)
    following = asyncio.ensure_future(worker.run(lambda: order.append("next"), 5.0))
    await asyncio.sleep(0)
    go.set()
    await following
    assert order == ["late", "next"]
    await worker.close()


@in_real_time
async def test_cancelling_leaves_it_usable_and_closing_waits_and_ends_what_has_not_begun() -> None:
    worker, begun = Worker("test"), threading.Event()

    def slow() -> None:
        begun.set()
        time.sleep(0.05)

    cancelled = asyncio.ensure_future(worker.run(slow, 5.0))
    await asyncio.to_thread(begun.wait)
    cancelled.cancel()
    waiting = asyncio.ensure_future(worker.run(lambda: None, 5.0))
    await asyncio.sleep(0)
    await worker.close()
    assert "test" not in [thread.name for thread in threading.enumerate()]
    found = await asyncio.gather(cancelled, waiting, return_exceptions=True)
    assert all(isinstance(one, asyncio.CancelledError) for one in found)
    assert await worker.run(lambda: 1, 5.0) == 1
    await worker.close()
