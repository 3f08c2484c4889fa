"""One task whose work begins at once: it is that task's, whether it has to wait or not."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
import pytest

from rtee.loop.runner import Runner

pytestmark = pytest.mark.anyio


@pytest.fixture(params=[False, True], ids=["asyncio", "uvloop"])
def anyio_backend(request: pytest.FixtureRequest) -> tuple[str, dict[str, bool]]:
    """Run the tests with both event loops that `rtee run` chooses from."""
    if request.param:
        pytest.importorskip("uvloop")
    return "asyncio", {"use_uvloop": request.param}


class Time:
    """A clock that is moved by hand."""

    def __init__(self) -> None:
        self.time = 100.0

    def now(self) -> float:
        return self.time


async def until_idle(runner: Runner) -> None:
    with anyio.fail_after(5.0):
        while not runner.idle:  # noqa: ASYNC110 - what is waited for has no event
            await asyncio.sleep(0)


@asynccontextmanager
async def working(runner: Runner, given_up: list[bool] | None = None) -> AsyncIterator[None]:
    """Run a task for a runner, which notes what was given up at a deadline."""

    async def run() -> None:
        while True:
            try:
                async with runner.guard():
                    while True:
                        await runner.carry_on()
            except TimeoutError:
                (given_up if given_up is not None else []).append(True)

    async with anyio.create_task_group() as group:
        group.start_soon(run, name="the task")
        await until_idle(runner)
        yield
        group.cancel_scope.cancel()


def name() -> str:
    task = asyncio.current_task()
    assert task is not None
    return task.get_name()


async def test_work_that_does_not_wait_is_done_when_start_returns() -> None:
    runner, names = Runner(Time().now), list[str]()

    async def work() -> None:
        names.append(name())

    async with working(runner):
        outer = name()
        assert runner.start(work())
        assert runner.start(work())
        assert names == ["the task", "the task"]
        assert name() == outer
        asyncio.get_running_loop().call_soon(lambda: runner.start(work()))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert names == ["the task"] * 3, "from a callback, too, where no task is current"


async def test_work_that_waits_is_carried_on_by_the_task() -> None:
    runner, steps = Runner(Time().now), list[str]()

    async def work() -> None:
        steps.append(name())
        await asyncio.sleep(0)
        with anyio.fail_after(5.0):
            await anyio.sleep(0.001)
        steps.append(name())

    async with working(runner):
        assert not runner.start(work())
        assert steps == ["the task"]
        assert not runner.idle
        with pytest.raises(RuntimeError, match="is running"):
            runner.start(work())
        await until_idle(runner)
        assert steps == ["the task", "the task"]


async def test_a_timeout_that_began_at_once_ends_what_the_task_carries_on() -> None:
    runner, found = Runner(Time().now), list[str]()

    async def work() -> None:
        try:
            async with asyncio.timeout(0.0):
                await asyncio.sleep(60.0)
        except TimeoutError:
            found.append("asyncio")
        with anyio.move_on_after(0.001) as scope:
            await anyio.sleep_forever()
        found.append(f"anyio {scope.cancelled_caught}")

    async with working(runner):
        runner.start(work())
        await until_idle(runner)
    assert found == ["asyncio", "anyio True"]


async def test_an_error_at_once_is_the_callers_and_leaves_the_task_idle() -> None:
    runner = Runner(Time().now)

    async def work(fail: bool) -> None:
        if fail:
            raise ZeroDivisionError

    async with working(runner):
        with pytest.raises(ZeroDivisionError):
            runner.start(work(True))
        assert runner.start(work(False))


async def test_work_is_given_up_at_its_deadline_in_the_loops_time() -> None:
    clock, given_up, cleaned = Time(), list[bool](), list[str]()
    runner = Runner(clock.now)

    async def work() -> None:
        try:
            await asyncio.sleep(60.0)
        finally:
            await asyncio.sleep(0)
            cleaned.append(name())

    async with working(runner, given_up):
        runner.start(work())
        runner.begin(2.0)
        clock.time += 1.9
        runner.check()
        await asyncio.sleep(0.005)
        assert not given_up
        clock.time += 0.1
        runner.check()
        await until_idle(runner)
        assert given_up == [True]
        assert cleaned == ["the task"]
        runner.check()
        runner.interrupt()
        await asyncio.sleep(0.005)
        assert given_up == [True], "an idle task has nothing to give up"
        assert runner.idle


async def test_cancelling_the_task_ends_it_idle_or_not() -> None:
    runner, ended = Runner(Time().now), list[str]()

    async def work() -> None:
        try:
            await asyncio.sleep(60.0)
        except asyncio.CancelledError:
            ended.append("cancelled")
            raise

    async with working(runner):
        pass
    assert not runner.idle
    async with working(runner):
        runner.start(work())
    assert ended == ["cancelled"]
    assert not runner.idle


@pytest.mark.parametrize("fast", [False, True], ids=["asyncio", "uvloop"])
def test_an_idle_task_that_is_left_over_ends_with_its_event_loop(fast: bool) -> None:
    loop_factory = pytest.importorskip("uvloop").new_event_loop if fast else None
    ended: list[bool] = []

    async def idle(runner: Runner) -> None:
        try:
            await runner.carry_on()
        finally:
            ended.append(True)

    async def leave() -> asyncio.Task[None]:
        runner = Runner(Time().now)
        left = asyncio.create_task(idle(runner))
        await until_idle(runner)
        return left

    with asyncio.Runner(loop_factory=loop_factory) as asyncio_runner:
        # Closing the runner cancels what is left, while the event loop does not run.
        left = asyncio_runner.run(leave())
    assert ended == [True]
    assert left.cancelled()
