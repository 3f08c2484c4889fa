"""Hands on emulated wires: the real drivers, the real bytes, devices that are played."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import anyio

from rtee.buses.emulator import Emulator
from rtee.buses.pool import BusPool
from rtee.drivers.emulators import owner_of
from rtee.drivers.registry import find_driver
from rtee.hand.files import make_folder
from rtee.log import Recorder, RecorderSettings
from rtee.loop.clock import Clock
from rtee.loop.handloop import HandLoop
from rtee.loop.observer import Observer
from rtee.loop.ticker import drive
from rtee.run import PreparedHand, RunOptions, prepare
from rtee.types import Event, Goal, Lifecycle, Result

_PATIENCE = 30.0


class WiredHand(Observer):
    """A hand whose devices are played on their wires, run in real time.

    Attributes:
        prepared: The hand, its actions and settings.
        loop: Its loop.
        emulator: What plays its (first) device.
        events: Kinds of the events since the start.
    """

    def __init__(self, prepared: PreparedHand, loop: HandLoop, pool: BusPool) -> None:
        self.prepared = prepared
        self.loop = loop
        self.events: list[str] = []
        self._pool = pool
        self._results: dict[str, Result] = {}
        self._news = anyio.Event()

    @property
    def emulator(self) -> Emulator:
        """What plays its (first) device."""
        return self._pool.played(owner_of(self.prepared.devices[0].spec))

    def on_result(self, result: Result) -> None:
        """Keep how a goal ended."""
        self._results[result.goal_id] = result
        self._tell()

    def on_event(self, event: Event) -> None:
        """Keep what happened."""
        self.events.append(event.kind)

    def _tell(self) -> None:
        news, self._news = self._news, anyio.Event()
        news.set()

    async def do(self, goal: Goal) -> Result:
        """Execute a goal to its end.

        Raises:
            TimeoutError: if it does not end.
        """
        self.loop.submit(goal)
        with anyio.fail_after(_PATIENCE):
            while goal.goal_id not in self._results:
                await self._news.wait()
        return self._results[goal.goal_id]


async def _activate(loop: HandLoop) -> None:
    """Have all devices activated; those that home do it only when asked.

    Raises:
        TimeoutError: if they do not get active.
    """
    with anyio.fail_after(_PATIENCE):
        await loop.recover()
        while True:
            if all(status.lifecycle is Lifecycle.ACTIVE for status in loop.statuses()):
                return
            await anyio.sleep(0.05)


@asynccontextmanager
async def on_the_wire(
    name: str, folder: Path, put: Callable[[Emulator], None] = lambda _: None
) -> AsyncIterator[WiredHand]:
    """Run a hand against its emulated devices for as long as the context lasts, recorded.

    Args:
        name: The hand.
        folder: Where the recording goes.
        put: Prepares the emulator once the hand is active: an object between the fingers.
    """
    prepared = prepare(name, RunOptions(emulated=True))
    async with BusPool() as pool:
        devices = [
            (device, find_driver(device.spec.driver)(device.spec, pool))
            for device in prepared.devices
        ]
        loop = HandLoop(prepared.hand, prepared.library, prepared.settings, devices)
        recorder = Recorder(
            prepared.hand,
            RecorderSettings(make_folder(folder), flight_recorder=0.0),
            rate=prepared.settings.rate,
            loop=prepared.settings,
            attachments=prepared.attachments(),
            metadata={"drivers": " ".join(device.spec.driver for device in prepared.devices)},
        )
        wired = WiredHand(prepared, loop, pool)
        async with recorder:
            loop.add_observer(recorder)
            loop.add_observer(wired)
            async with loop, anyio.create_task_group() as group:
                await loop.ready()
                group.start_soon(drive, [loop], Clock(prepared.settings.rate))
                await _activate(loop)
                put(wired.emulator)
                yield wired
                group.cancel_scope.cancel()
