"""Drivers of strangers: whatever one returns, raises or ignores costs its own device alone."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.errors import CommandRejected, DeviceFault, DriverError
from rtee.hand.model import Hand
from rtee.loop.clock import ManualClock
from rtee.loop.guarded_driver import GuardedDriver
from rtee.loop.handloop import HandLoop
from rtee.loop.settings import LoopSettings
from rtee.messages import DEVICE_STATUS, EVENT
from rtee.sample import ActuatorState
from rtee.touch import TouchReading
from rtee.types import Goal, Lifecycle, Named, Reference

from .hands import Rig, Watcher, device, make_library

pytestmark = pytest.mark.anyio

RATE = 100.0
"""Of the loop [Hz]."""

INDEX, THUMB = ("index_base", "index_tip"), ("thumb_base", "thumb_slide")


class Own(BaseException):
    """An exception that no handler of `Exception` catches."""


class Unprintable(Exception):
    """An error whose text is a bug itself."""

    def __str__(self) -> str:
        raise ZeroDivisionError


def raising(error: Callable[[], BaseException]) -> Callable[..., Any]:
    async def fail(self: Any, *_: Any) -> Any:
        raise error()

    return fail


def state(**changes: Any) -> Callable[..., Any]:
    """Return a ``sense`` whose states are changed."""

    async def sense(self: Any) -> ActuatorState:
        return replace(await KinematicDriver.sense(self), **changes)

    return sense


def giving(value: Any) -> Callable[..., Any]:
    async def give(self: Any, *_: Any) -> Any:
        return value

    return give


async def swallows(self: Any, *_: Any) -> Any:
    """Go on whatever happens, as ``except:`` in a loop does."""
    while True:
        try:
            await anyio.sleep(3600)
        except BaseException:
            continue


async def swallows_once(self: Any, *_: Any) -> Any:
    """Take a cancellation for an error of the bus, and wait for it again."""
    try:
        await anyio.sleep(3600)
    except BaseException:
        await asyncio.Event().wait()


async def new_warnings(self: Any) -> ActuatorState:
    found = await KinematicDriver.sense(self)
    self.count = getattr(self, "count", 0) + 20
    return replace(found, warnings=tuple(f"warning {self.count + k}" for k in range(20)))


async def new_faults(self: Any) -> ActuatorState:
    self.count = getattr(self, "count", 0) + 1
    raise DeviceFault("bad", self.count, f"fault {self.count}")


async def new_refusals(self: Any, reference: Reference) -> None:
    self.count = getattr(self, "count", 0) + 1
    raise CommandRejected("bad", f"refused {self.count}")


class Doing:
    """Does something else each time that somebody looks."""

    count = 0

    def __get__(self, *_: Any) -> str:
        self.count += 1
        return f"step {self.count}"


def failing_property(self: Any) -> Any:
    raise SystemExit


BAD: dict[str, dict[str, Any]] = {
    "no state": {"sense": giving(None)},
    "a list for a state": {"sense": giving([0.0, 0.0])},
    "something with a state's attributes": {"sense": giving(SimpleNamespace(position=[0.0]))},
    "too few positions": {"sense": state(position=np.zeros(1))},
    "a matrix of positions": {"sense": state(position=np.zeros((2, 2)))},
    "positions in a list": {"sense": state(position=[0.0, 0.0])},
    "positions that are texts": {"sense": state(position=np.array(["a", "b"]))},
    "objects for velocities": {"sense": state(velocity=np.array([None, None]))},
    "integers for temperatures": {"sense": state(temperature=np.zeros(2, np.int64))},
    "no stamp": {"sense": state(stamp=None)},
    "a stamp that is no number": {"sense": state(stamp=math.nan)},
    "a grasp of three": {"sense": state(grasped=(True, True, False))},
    "a grasp in words": {"sense": state(grasped=("yes", "no"))},
    "channels in a list": {"sense": state(extras=[1.0])},
    "a channel without values": {"sense": state(extras={"pressure": None})},
    "a channel of objects": {"sense": state(extras={"pressure": np.array([object()])})},
    "ten thousand channels": {"sense": state(extras={f"c{k}": np.zeros(1) for k in range(10_000)})},
    "a channel with a line break": {"sense": state(extras={"a\nb": np.zeros(1)})},
    "touch that is none": {"sense": state(touch="soft")},
    "touch without values": {"sense": state(touch=TouchReading(None, 0.0))},  # type: ignore[arg-type]
    "warnings in a text": {"sense": state(warnings="hot")},
    "twenty new warnings a state": {"sense": new_warnings},
    "SystemExit while it senses": {"sense": raising(SystemExit)},
    "KeyboardInterrupt while it moves": {"move": raising(KeyboardInterrupt)},
    "SystemExit while it connects": {"configure": raising(SystemExit)},
    "GeneratorExit": {"sense": raising(GeneratorExit)},
    "an exception of its own kind": {"sense": raising(Own)},
    "a cancellation that nobody asked for": {"sense": raising(asyncio.CancelledError)},
    "StopIteration": {"sense": raising(StopIteration)},
    "an error that cannot be printed": {"sense": raising(Unprintable)},
    "a megabyte of an error": {"sense": raising(lambda: DriverError("bad", "x" * 1_000_000))},
    "a new fault each time": {"sense": new_faults},
    "a fault without a number": {
        "sense": raising(lambda: DeviceFault("bad", None, None))  # type: ignore[arg-type]
    },
    "a new refusal each time": {"move": new_refusals},
    "cancellations swallowed while it senses": {"sense": swallows},
    "a cancellation taken for an error": {"sense": swallows_once},
    "cancellations swallowed while it connects": {"configure": swallows},
    "cancellations swallowed while it closes": {"close": swallows},
    "SystemExit while it closes": {"close": raising(SystemExit)},
    "SystemExit while it stops": {"stop": raising(SystemExit)},
    "a stop that never ends": {"stop": swallows},
    "no coroutine": {"sense": lambda self: 5},
    "capabilities that are none": {"capabilities": "all of them"},
    "capabilities that raise": {"capabilities": property(failing_property, lambda *_: None)},
    "counters that raise": {"counters": lambda self: 1 / 0},
    "counters in words": {"counters": lambda self: {"frames": "many"}},
    "something new that it does": {"doing": Doing()},
    "doing nothing that is a text": {"doing": 7},
}
"""What a driver does wrong, by attribute of the driver."""


# A coroutine that goes on whatever happens does so when it is collected, too.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("what", BAD)
async def test_a_bad_driver_costs_its_device_alone(hand: Hand, what: str) -> None:
    kind = type("Bad", (KinematicDriver,), BAD[what])
    clock = ManualClock(RATE)
    bad, good = device(hand, "bad", INDEX, rate=RATE), device(hand, "good", THUMB, rate=RATE)
    drivers = kind(bad.spec, BusPool()), KinematicDriver(good.spec, BusPool())
    for driver in drivers:
        driver.now = clock.now
    settings = LoopSettings(rate=RATE)
    pairs = list(zip((bad, good), drivers, strict=True))
    loop = HandLoop(hand, make_library(hand), settings, pairs, now=clock.now)
    watcher = Watcher()
    loop.add_observer(watcher)
    ticks = 0
    async with loop:
        rig = Rig(loop, clock, watcher)
        await rig.run(0.1)  # the good one connects, whatever the other does
        assert loop.devices["good"].active
        await rig.run(1.0)
        loop.submit(Goal(Named("Trig", ("thumb",))))
        await rig.run(1.5)
        ticks = len(watcher.records)
        (result,) = watcher.results
        assert result.reached, result.reason
        status = {each.name: each for each in loop.statuses()}
        assert status["good"].lifecycle is Lifecycle.ACTIVE
        assert status["good"].exchanges >= ticks - 3
        assert status["good"].errors == 0
        # All that is said of it can be published, and there is not more than people can read.
        for each in status.values():
            DEVICE_STATUS.encode(each)
        about = [event for event in watcher.events if event.source == "bad"]
        for event in about:
            EVENT.encode(event)
            assert event.text.isprintable()
            assert len(event.text) < 2000
        assert len(about) < 40
        confirmed = []

        async def stop() -> None:
            confirmed.append(dict(await loop.stop()))

        async with anyio.create_task_group() as group:
            group.start_soon(stop)
            while not confirmed:
                await rig.run(0.01)
        assert confirmed[0]["good"]
    # The run ends, and within bounds: leaving the context has returned.
    assert ticks == 260


async def test_a_driver_may_expect_what_a_future_raises(hand: Hand) -> None:
    """A task throws what its future raised into the outermost coroutine, past the driver's."""

    class Expecting(KinematicDriver):
        async def activate(self) -> None:
            future = asyncio.get_running_loop().create_future()
            asyncio.get_running_loop().call_soon(future.set_exception, KeyError("expected"))
            with pytest.raises(KeyError):
                await future
            await super().activate()

    own = device(hand, "own", INDEX, rate=RATE)
    guarded = GuardedDriver(Expecting(own.spec, BusPool()), "own", len(INDEX))
    await guarded.configure()
    await guarded.activate()
    assert (await guarded.sense()).position.shape == (len(INDEX),)


async def test_a_driver_may_wait_in_vain_as_often_as_it_likes(hand: Hand) -> None:
    """Its own timeouts cancel the task, too, but nobody has asked the driver to end."""

    class Patient(KinematicDriver):
        waited = 0

        async def configure(self) -> None:
            while self.waited < 10:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(0.001):
                        await asyncio.Event().wait()
                self.waited += 1
            await super().configure()

    own = device(hand, "own", INDEX, rate=RATE)
    driver = Patient(own.spec, BusPool())
    await GuardedDriver(driver, "own", len(INDEX)).configure()
    assert driver.waited == 10
