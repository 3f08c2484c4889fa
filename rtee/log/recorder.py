"""The recorder, an observer of the loop that never delays it."""

from __future__ import annotations

import contextlib
import logging
import math
import mmap
import os
import queue
import struct
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from rtee import monotonic
from rtee.commands import CommandRecord
from rtee.errors import LogError, UserError
from rtee.hand.config_schema import Recorded
from rtee.hand.embedded_meshes import EmbeddedMeshes, embed_meshes
from rtee.hand.files import cleared_on_failure, reason
from rtee.hand.model import Hand
from rtee.log.dataclass_json import to_json
from rtee.log.layout import REPLAY, Contents, Replayable
from rtee.log.settings import RecorderSettings, RecorderStatus
from rtee.log.writer import ITSELF, Item, LogWriter
from rtee.loop import contact_rules
from rtee.loop.controller import Controller
from rtee.loop.observer import Observer
from rtee.loop.plan import Plan
from rtee.loop.settings import LoopSettings
from rtee.loop.snapshot import capture
from rtee.objects.description import ObjectDescription
from rtee.sample import COLUMNS, NOTHING, FloatArray, TickRecord
from rtee.touch import TouchState
from rtee.types import DeviceStatus, Event, Feedback, Goal, LoopStatistics, Result

_HEAD: Final = struct.Struct("<qdq")
"""Values before the arrays of a tick: its number, its stamp [s] and the time since 1970 [ns]."""

_MEMORY: Final = 256 * 1024
"""Memory for the ticks of one piece [byte]: a third of a second of nine actuators at 1 kHz, and
little enough to be given back within some ten microseconds."""

_arrays = attrgetter(*COLUMNS)


class PackedTicks:
    """A piece of the backlog: ticks that one thread adds and another takes.

    As records, the ticks of some seconds are a hundred thousand objects. Other objects would be
    allocated between them, and the process would never return their memory to the system. Here they
    are rows of one separate mapping, which is returned with this object. All have arrays of the
    same lengths as the tick ``like``.
    """

    def __init__(self, like: TickRecord) -> None:
        self._types = [np.dtype(quantity.dtype) for quantity in COLUMNS.values()]
        self._actuators = len(like.position)
        self._size = _HEAD.size + self._actuators * sum(kind.itemsize for kind in self._types)
        self._room = max(1, _MEMORY // self._size)
        # Private, so that it counts as this process's own memory.
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
        self._memory = mmap.mmap(-1, self._room * self._size, flags)
        # Kept as they are, since many ticks share one object.
        self._channels: list[Mapping[str, FloatArray]] = [NOTHING] * self._room
        self._touch: list[Mapping[str, TouchState]] = [NOTHING] * self._room
        self._added = 0
        self._taken = 0

    def add(self, record: TickRecord) -> bool:
        """Add a tick; return whether there was room for it."""
        place = self._added
        if place == self._room:
            return False
        head = _HEAD.pack(record.tick, record.stamp, record.wall_ns)
        row = head + b"".join([array.tobytes() for array in _arrays(record)])
        # Rows must have one size; the arrays of a tick that does not fit the hand may have others.
        if len(row) != self._size:
            return False
        self._memory[place * self._size : (place + 1) * self._size] = row
        self._channels[place], self._touch[place] = record.channels, record.touch
        self._added = place + 1
        return True

    def take(self) -> TickRecord:
        """Return the oldest tick that was not taken yet."""
        place, self._taken = self._taken, self._taken + 1
        # A copy, so that arrays of this tick do not keep the whole mapping.
        row = self._memory[place * self._size : (place + 1) * self._size]
        tick, stamp, wall_ns = _HEAD.unpack_from(row)
        arrays: dict[str, Any] = {}
        begin = _HEAD.size
        for name, kind in zip(COLUMNS, self._types, strict=True):
            arrays[name] = np.frombuffer(row, kind, self._actuators, begin)
            begin += self._actuators * kind.itemsize
        channels, touch = self._channels[place], self._touch[place]
        self._channels[place], self._touch[place] = NOTHING, NOTHING
        return TickRecord(
            **arrays, tick=tick, stamp=stamp, wall_ns=wall_ns, channels=channels, touch=touch
        )


log = logging.getLogger(__name__)

# Pause between two items while the queue is long [s], in which the loop gets the interpreter.
_YIELD: Final = 50e-6
_LEAST_QUEUE: Final = 200  # least length of the queue [items], for loops of a low rate
_CLOSING: Final = 10.0  # longest wait for the thread to write the queue to a slow disk [s]

_GATHER: Final = 4e-3
"""Time between two wake-ups of the writer [s]; waking it at every tick would disturb the loop."""

_LONGEST_NAP: Final = 20e-3
"""Loops of a longer period than this [s] wake the writer."""

_BEHIND: Final = 1.0
"""Length of the queue, as time [s], from which the writer no longer avoids the loop's ticks: losing
records would be worse than a late tick."""

_PACKED: Final = 0.1
"""With more waiting than this [s], ticks are packed: a backlog must not leave holes in memory."""

_QUIET: Final = (0.45, 0.85)
"""Part of the loop's period in which the writer works, as shares of it: the loop works at its
beginning, and the last share is a margin before the next tick."""

Work = TickRecord | PackedTicks | tuple[Item, float] | Callable[[], None] | None
"""Items that wait for the writer: packed ticks once for each tick, ``None`` for the end."""


class Recorder(Observer):
    """Observer of a hand's loop that records it with a writer thread.

    The loop's reports go into a bounded queue. A thread that wakes up between the loop's ticks
    writes them item by item, so that neither waits for the other. A full queue drops and counts
    ticks.

    Attributes:
        controller: The loop's controller, if each part of the recording should be recomputable
            alone: it then begins with the controller's state.

    Args:
        hand: The hand.
        settings: Settings of the recorder.
        rate: Rate of the loop [Hz].
        loop: Settings of the loop, needed to recompute the references from a recording.
        attachments: Files to attach by name: ``hand.yaml``, SRDF, actions; the URDF always is.
        metadata: Further metadata: name to value.
        notify: Called in the writer's thread with events: recording lost or resumed, flight file
            written.
        simulated: Whether stamps are those of a simulation that begins now instead of
            CLOCK_MONOTONIC.
    """

    def __init__(
        self,
        hand: Hand,
        settings: RecorderSettings,
        *,
        rate: float,
        loop: LoopSettings | None = None,
        attachments: Mapping[str, bytes] | None = None,
        metadata: Mapping[str, str] | None = None,
        notify: Callable[[Event], None] | None = None,
        simulated: bool = False,
    ) -> None:
        self._settings = settings
        files = dict(attachments or {})
        if loop is not None:
            files[REPLAY] = to_json(
                Replayable(loop, hand.actuators, contact_rules.VERSION, hand.dynamics)
            ).encode()
        more = {
            "decimation": str(settings.decimation),
            "record": settings.record.value,
            "layout": settings.layout.value,
            **(metadata or {}),
        }
        # Read now, since opening files could delay the loop once it runs.
        meshes = embed_meshes(hand) if settings.meshes else EmbeddedMeshes({}, {})
        for address, why in meshes.left_out.items():
            log.warning("the mesh '%s' is not in the recording: %s", address, why)
        contents = Contents(hand, rate, files, more, meshes)
        contents.prepare()
        self._writer = LogWriter(contents, settings, notify, simulated=simulated)
        self._writer.dropped = lambda: self.dropped
        self._queue: queue.SimpleQueue[Work] = queue.SimpleQueue()
        self._limit = max(_LEAST_QUEUE, int(settings.queue_time * rate))
        self._few = int(_PACKED * rate)
        self._backlog: PackedTicks | None = None
        self._period = 1.0 / rate
        self._stamp: float | None = 0.0 if simulated else None
        # Simulated time runs ahead of the disk, so that closing waits without a limit.
        self._closing = None if simulated else _CLOSING
        self.dropped = 0
        self._failed = 0
        self._failure = ""
        self._thread: threading.Thread | None = None
        self.controller: Controller | None = None

    # --- life --------------------------------------------------------------------------------

    def open(self) -> None:
        """Begin to record.

        Raises:
            LogError: if recording to the disk is on and the folder cannot be written.
        """
        if self._thread is not None:
            return
        if self._settings.enabled and self._settings.record is not Recorded.FAULTS:
            try:
                with cleared_on_failure(self._settings.folder):
                    self._writer.sink.start(time.time_ns())
            except OSError as error:
                raise LogError(
                    f"no recording can be written here: {reason(error)}; --log gives another"
                    " folder, --no-log records nothing",
                    path=self._settings.folder,
                ) from error
        # A daemon, so that a disk that hangs cannot keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="rtee-recorder", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Write the queue, close the file and end; waits for the disk. Further calls do nothing."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._queue.put(None)
            thread.join(self._closing)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    async def __aenter__(self) -> Self:
        self.open()
        return self

    async def __aexit__(self, _: object, error: BaseException | None, __: object) -> None:
        import anyio
        import anyio.to_thread

        sink = self._writer.sink
        path = sink.path
        # Shielded, so that the queue is written although the run is being cancelled.
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(self.close)
        # A recording that a mistake kept from starting must not count as the newest one.
        if path is not None and isinstance(error, UserError) and not sink.written_ticks:
            path.unlink(missing_ok=True)

    # --- observing the loop ------------------------------------------------------------------

    def on_tick(self, record: TickRecord) -> None:
        """Record a tick, or drop it when the writer is too far behind."""
        self._stamp = record.stamp
        if self._writer.sink.begun and self.controller is not None:
            self._capture(self.controller, record)
        waiting = self._queue.qsize()
        if waiting >= self._limit:
            self.dropped += 1  # never waited for: the loop's thread calls this
        elif waiting <= self._few:
            # The writer may take its last ticks now; then its memory must go back to the system.
            self._backlog = None
            self._queue.put(record)
        else:
            self._queue.put(self._packed(record))

    def _capture(self, controller: Controller, record: TickRecord) -> None:
        """Queue the controller's state for a newly begun file, unless this is the first tick."""
        self._writer.sink.begun = False
        if record.tick:
            snapshot = capture(controller)
            self._queue.put(lambda: self._writer.state(snapshot, record.tick, record.stamp))

    def _packed(self, record: TickRecord) -> PackedTicks | TickRecord:
        """Add a tick to the backlog and return the piece it is in; return a tick that fits none."""
        if self._backlog is not None and self._backlog.add(record):
            return self._backlog
        backlog = PackedTicks(record)
        if not backlog.add(record):
            return record  # its arrays do not fit one another, which the writer reports
        self._backlog = backlog
        return backlog

    def _now(self) -> float:
        """Return the time of the last tick [s], or the present time before the first one."""
        return monotonic.now() if self._stamp is None else self._stamp

    def _put(self, item: Item, stamp: float) -> None:
        # Other items are rare and worth more than ticks, so that they may fill twice the limit.
        if self._queue.qsize() >= 2 * self._limit:
            self.dropped += 1
        else:
            self._queue.put((item, stamp))

    def on_goal(self, goal: Goal, stamp: float) -> None:
        """Record a goal."""
        self._put(goal, stamp)

    def on_plan(self, plan: Plan, stamp: float) -> None:
        """Record the plan of a goal."""
        self._put(plan, stamp)

    def on_object(self, obj: ObjectDescription, stamp: float) -> None:
        """Record the object in a simulated hand."""
        self._put(obj, stamp)

    def on_command(self, record: CommandRecord) -> None:
        """Record a command."""
        self._put(record, record.stamp)

    def on_feedback(self, feedback: Feedback) -> None:
        """Record the progress of a goal."""
        self._put(feedback, feedback.stamp)

    def on_result(self, result: Result) -> None:
        """Record the result of a goal."""
        self._put(result, self._now())

    def on_event(self, event: Event) -> None:
        """Record an event; a fault makes the flight recorder write."""
        if event.source != ITSELF:  # the loop returns the recorder's own events, already recorded
            self._put(event, event.stamp)

    def on_status(self, statuses: Sequence[DeviceStatus], statistics: LoopStatistics) -> None:
        """Record the status of the devices and the statistics of the loop."""
        now = self._now()
        for status in statuses:
            self._put(status, now)
        self._put(statistics, now)

    # --- while it runs -----------------------------------------------------------------------

    def start(self) -> None:
        """Begin a new recording on the disk, unless one is being written; returns at once."""
        # In the writer's thread, in order with the records before it.
        self._queue.put(self._writer.start)

    def stop(self) -> None:
        """End the recording on the disk; the flight recorder continues. Returns at once."""
        self._queue.put(self._writer.stop)

    def mark(self, text: str) -> None:
        """Put a mark with a text into the recording."""
        now = self._now()
        self._put(Event("mark", "user", text, now), now)

    def fault(self, cause: str) -> None:
        """Have the flight recorder write its chunks; returns at once."""
        self._queue.put(lambda: self._writer.fault(cause))

    @property
    def flight_folder(self) -> Path | None:
        """Folder of the flight recorder's files; ``None`` without a flight recorder."""
        return None if self._writer.flight is None else self._settings.folder

    def status(self) -> RecorderStatus:
        """Return the status of the recorder."""
        writer = self._writer
        return RecorderStatus(
            recording=writer.sink.wanted,
            path=writer.sink.path,
            size=writer.sink.size,
            ticks=writer.sink.written_ticks,
            dropped=self.dropped + self._failed,
            lost=writer.sink.lost_ticks,
            problem=writer.sink.problem or self._failure,
            flight_seconds=writer.flight.seconds if writer.flight else 0.0,
            flight_files=tuple(writer.flight_files),
        )

    # --- the writer's thread -----------------------------------------------------------------

    def _run(self) -> None:
        # The thread inherits the loop's real-time priority, with which it must not compete.
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        writer = self._writer
        while True:
            work: Work = None  # not kept while it waits: packed ticks give their memory back
            try:
                work = self._queue.get(timeout=writer.waiting())
            except queue.Empty:
                self._do(writer.poll)
                continue
            if work is None:
                break
            if isinstance(work, TickRecord):
                self._do(writer.tick, work)
            elif isinstance(work, PackedTicks):
                self._do(writer.tick, work.take())
            elif isinstance(work, tuple):
                self._do(writer.item, *work)
            else:
                self._do(work)
            self._do(writer.poll)
            self._give_way()
        self._do(writer.close)

    def _give_way(self) -> None:
        """Sleep while the loop works, and until there is enough to write."""
        waiting, period = self._queue.qsize(), self._period
        if waiting * period > _BEHIND:
            time.sleep(_YIELD)
        elif self._stamp is not None and period <= _LONGEST_NAP:
            begin, end = _QUIET
            phase = (monotonic.now() - self._stamp) / period % 1.0
            if not waiting:
                time.sleep((math.ceil(_GATHER / period) + begin - phase) * period)
            elif not begin <= phase <= end:
                time.sleep((begin - phase) % 1.0 * period)

    def _do(self, call: Callable[..., None], *arguments: object) -> None:
        # An error with one record must not end the recording of all others.
        try:
            call(*arguments)
        except Exception as error:
            self._failed += 1
            self._failure = f"{type(error).__name__}: {error}"
