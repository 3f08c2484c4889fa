"""Hands on emulated wires: the real drivers, the real bytes, devices that are played."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import anyio

from rtee.buses.emulator import Emulator
from rtee.buses.pool import BusPool
from rtee.drivers.registry import find_driver
from rtee.errors import RteeError
from rtee.hand.files import make_folder
from rtee.log import Recorder, RecorderSettings
from rtee.loop.clock import Clock
from rtee.loop.handloop import HandLoop, drive
from rtee.loop.observer import Observer
from rtee.running.run import PreparedHand, RunOptions, prepare
from rtee.types import Event, Goal, Lifecycle, Result

_PATIENCE = 30.0
_STEADY = 5


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
        return self._pool.played(self.prepared.devices[0].spec.owner)

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


def wired(name: str, rate: float | None = None, *, obj: str | None = None) -> PreparedHand:
    """Read a hand that is to run against its emulated devices.

    Args:
        name: The hand.
        rate: Ticks per second [Hz]; ``None``: its own.
        obj: What is between its fingers, such as ``50mm``.
    """
    return prepare(name, RunOptions(emulated=True, rate=rate, object_in_hand=obj))


async def _activate(loop: HandLoop) -> None:
    """Have all devices activated; those that home do it only when asked.

    Raises:
        TimeoutError: if they do not get active.
    """
    since = 0
    with anyio.fail_after(_PATIENCE):
        while since < _STEADY:
            if all(status.lifecycle is Lifecycle.ACTIVE for status in loop.statuses()):
                since += 1
            else:
                since = 0
                with suppress(RteeError):  # an answer that came too late is asked for again
                    await loop.recover()
            await anyio.sleep(0.05)


@asynccontextmanager
async def on_the_wire(prepared: PreparedHand, folder: Path | None) -> AsyncIterator[WiredHand]:
    """Run a hand against its emulated devices for as long as the context lasts, recorded.

    Args:
        prepared: The hand with its emulated devices; see `wired`.
        folder: Where the recording goes; ``None``: nowhere.
    """
    async with BusPool() as pool:
        devices = [
            (device, find_driver(device.spec.driver)(device.spec, pool))
            for device in prepared.devices
        ]
        loop = HandLoop(prepared.hand, prepared.library, prepared.settings, devices)
        recorder = Recorder(
            prepared.hand,
            RecorderSettings(
                Path() if folder is None else make_folder(folder),
                enabled=folder is not None,
                flight_recorder=0.0,
            ),
            rate=prepared.settings.rate,
            loop=prepared.settings,
            attachments=prepared.attachments(),
            metadata={"drivers": " ".join(device.spec.driver for device in prepared.devices)},
        )
        hand = WiredHand(prepared, loop, pool)
        async with recorder:
            loop.add_observer(recorder)
            loop.add_observer(hand)
            async with loop, anyio.create_task_group() as group:
                await loop.ready()
                group.start_soon(drive, [loop], Clock(prepared.settings.rate))
                await _activate(loop)
                yield hand
                group.cancel_scope.cancel()
