"""The replay driver: it returns the states of a recording and ignores references."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import anyio.to_thread
import numpy as np
from msgspec import Meta

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.replay.states import Block, RecordedStates
from rtee.errors import NotConnected
from rtee.hand.validation import Section
from rtee.sample import MEASURED, NOTHING, ActuatorState, FloatArray
from rtee.touch import TouchReading, TouchState
from rtee.types import DeviceSpec, Reference

_PATIENCE = 0.02
"""Longest time that `sense` waits for the file [s]; if it took longer, the supervisor would count a
timeout."""

_WORDS: dict[int, bool | None] = {-1: None, 0: False, 1: True}  # recorded values of `grasped`


class ReplayOptions(Section, frozen=True):
    """Recording to play back, and its playback settings."""

    file: Path
    """The recording, an MCAP file."""
    speed: Annotated[float, Meta(gt=0, le=1000)] = 1.0
    """Speed of the playback relative to the recording."""
    repeat: bool = False
    """Begin again at the end of the recording; otherwise stay there."""


class ReplayDriver(Driver):
    """Plays back the states of a recording, starting when it is first activated.

    Neither disabling nor activating it again interrupts the playback.

    Attributes:
        now: Clock of the playback [s].
        ended: Whether the recording has been played to its end.
        behind: Whether the state that is due is still being read; `sense` repeats the last one.
    """

    Options = ReplayOptions
    options: ReplayOptions

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.now: Callable[[], float] = monotonic.asked
        self.ended = self.behind = False
        self._states: RecordedStates | None = None
        self._blocks: Iterator[Block] = iter(())
        self._block: Block | None = None
        self._next: Block | None = None
        self._first = 0.0
        self._following: asyncio.Future[Block | None] | None = None
        self._beginning: asyncio.Future[None] | None = None
        self._row = 0
        self._shown = -1
        self._begin: float | None = None
        self._patience = 0.0
        self._blank: dict[str, FloatArray] = {}
        self._felt: Mapping[str, TouchState] = NOTHING
        self._touch: TouchReading | None = None
        self.capabilities = Capabilities(
            measures=frozenset(MEASURED),
            accepts=frozenset(),
            refuses={"position": f"it plays {self.options.file.name}"},
            identity={"model": "replay", "file": self.options.file.name},
        )

    async def configure(self) -> None:
        """See `Driver.configure`."""
        names = tuple(actuator.name for actuator in self.spec.actuators)
        self._states = await anyio.to_thread.run_sync(
            RecordedStates, self.options.file, self.spec.hand, names
        )
        self.object_description = await anyio.to_thread.run_sync(self._states.object_description)
        sensors = await anyio.to_thread.run_sync(self._states.touch_sensors)
        taxels = {name: sum(sensor.taxels for sensor in each) for name, each in sensors.items()}
        self._blank = {name: np.full(count, np.nan) for name, count in taxels.items()}
        together = tuple(sensor for each in sensors.values() for sensor in each)
        self.refine(touch=together)
        await self._rewind()
        self._begin = None
        self.ended = False

    async def activate(self) -> None:
        """See `Driver.activate`."""
        # Only once, since the playback cannot go back to blocks that were read before.
        if self._begin is None:
            self._begin = self.now()

    async def sense(self) -> ActuatorState:
        """See `Driver.sense`."""
        if self._block is None:
            raise NotConnected(self.spec.name, "is not open")
        passed = 0.0 if self._begin is None else self.now() - self._begin
        self._patience = asyncio.get_running_loop().time() + _PATIENCE
        await self._advance(passed * self.options.speed)
        block, row = self._block, self._row
        # The loop may run faster than the recording was made.
        fresh, self._shown = row != self._shown, row
        words = block.grasped[row].tolist()
        return ActuatorState(
            *block.values[row],
            stamp=self.now(),
            fresh=fresh,
            grasped=None if max(words) < 0 else tuple(_WORDS[word] for word in words),
            extras=block.extras[row],
            touch=self._reading(block.touch[row]),
        )

    def _reading(self, states: Mapping[str, TouchState]) -> TouchReading | None:
        """Return the combined reading of the touch sensors of all recorded devices."""
        # The same mapping means that there was no new message, so the reading is unchanged.
        if states is not self._felt:
            self._felt = states
            current = {name: state.values for name, state in states.items() if not state.stale}
            # The values of a device without a recent measurement are NaN.
            values = [current.get(name, blank) for name, blank in self._blank.items()]
            if not self._blank.keys().isdisjoint(current):
                self._touch = TouchReading(np.concatenate(values), self.now())
        return self._touch

    async def move(self, reference: Reference) -> None:
        """See `Driver.move`: a recording cannot be moved, so this does nothing."""

    async def close(self) -> None:
        """See `Driver.close`."""
        reading = [task for task in (self._beginning, self._following) if task is not None]
        self._beginning = self._following = None
        for task in reading:
            task.cancel()
            # The thread may still be reading, and the file must not be closed before it is done.
            await asyncio.wait([task])
        states, self._states = self._states, None
        self._block = self._next = None
        if states is not None:
            await anyio.to_thread.run_sync(states.close)

    async def _rewind(self) -> None:
        if self._states is None:
            raise NotConnected(self.spec.name, "is not open")
        self._blocks = self._states.blocks()
        self._block = await anyio.to_thread.run_sync(next, self._blocks, None)
        self._next = None
        self._row, self._shown = 0, -1
        self._first = 0.0 if self._block is None else float(self._block.stamp[0])
        self._fetch()

    def _fetch(self) -> None:
        """Begin to read the next block in a thread, while the current one is played."""
        self._following = asyncio.ensure_future(anyio.to_thread.run_sync(next, self._blocks, None))

    async def _advance(self, played: float) -> None:
        """Go to the last state that is not later than a time after the first one [s]."""
        if self._beginning is not None:
            if not await self._has_read(self._beginning):
                return
            beginning, self._beginning = self._beginning, None
            # Raises the error of the reading thread, if there was one.
            beginning.result()
            # Time starts when the first block has been read, so that no state of it is skipped.
            self._begin, played = self.now(), 0.0
        wanted = self._first + played
        while self._block is not None:
            stamps = self._block.stamp
            # Before the first time stamp, the first state is returned.
            self._row = max(0, int(np.searchsorted(stamps, wanted, side="right")) - 1)
            if self._row < len(stamps) - 1 or self.ended:
                return
            if self._next is None and self._following is not None:
                if not await self._has_read(self._following):
                    return
                self._next, self._following = self._following.result(), None
            if self._next is not None:
                if wanted < self._next.stamp[0]:
                    return
                self._block, self._next = self._next, None
                # Rows count from 0 again, and the first one must count as new.
                self._shown = -1
                self._fetch()
            elif self.options.repeat:
                self._beginning = asyncio.ensure_future(self._rewind())
                await self._advance(0.0)
                return
            else:
                self.ended = True

    async def _has_read(self, reading: asyncio.Future[Any]) -> bool:
        """Wait for a reading thread until `sense` has to return; return whether it is done."""
        left = self._patience - asyncio.get_running_loop().time()
        done, _ = await asyncio.wait([reading], timeout=max(0.0, left))
        self.behind = not done
        return bool(done)
