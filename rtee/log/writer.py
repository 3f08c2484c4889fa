"""The writer of the recorder, which encodes the loop's reports into chunks and files."""

from __future__ import annotations

import contextlib
import mmap
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from rtee.commands import CommandRecord, StreamSample
from rtee.hand.config_schema import Recorded, RecordingLayout
from rtee.hand.files import reason
from rtee.hand.frames import JointFrames
from rtee.hand.model import Hand
from rtee.hand.transmission import Transmission
from rtee.log.chunks import MESSAGE, ChunkBuilder, InColumns, PackedChunk, message_head
from rtee.log.digest import line_of
from rtee.log.layout import CHANNELS, Contents, library_name
from rtee.log.plans import GRIP, GripEstimate, encode_plan
from rtee.log.settings import RecorderSettings
from rtee.log.sink import DiskSink
from rtee.loop.grip import grip_at
from rtee.loop.plan import Plan
from rtee.loop.snapshot import Snapshot, to_bytes
from rtee.messages import GOAL, convert, topics
from rtee.messages.codec import SECOND, Codec, channel_fields, header
from rtee.messages.layout import (
    JOINT_ARRAYS,
    JOINT_STATE,
    STAMP,
    Template,
    TransformsEncoder,
    joint_state_fields,
    stamp_bytes,
)
from rtee.messages.schema import message_type
from rtee.messages.state import actuator_state_pieces, actuator_state_template
from rtee.messages.touch import TOUCH_SENSORS, TouchEncoder, sensors_fields
from rtee.monotonic import asked
from rtee.objects.description import ObjectDescription
from rtee.sample import FloatArray, TickRecord
from rtee.touch import TouchState
from rtee.types import DeviceStatus, Event, Feedback, Goal, LoopStatistics, Result

_TIMES = struct.Struct("<IQQ")
"""Layout of the end of a message record's head: sequence, log time and publish time [ns]."""

_HEAD = MESSAGE.size - _TIMES.size
"""Length of the constant beginning of that head [bytes]."""

_STEPS = float(2**36)
"""Number of steps per unit to which transforms are rounded: steps of 1.5e-11 [m | 1] are far below
any measurement, and rounded digits compress better."""


class TickEncoder:
    """Encodes the record of a tick into message records.

    In the joint states, the actuators come first, so that their values repeat those of the actuator
    states in one piece. Positions and velocities of the joints that follow actuators are rounded to
    single precision. Both make recordings smaller, and the exact values can be recomputed.

    The channels are those of joint states, actuator states and reference; `layout` has channel and
    offset of each message record in the block.
    """

    def __init__(
        self,
        joints: Sequence[str],
        actuators: Sequence[str],
        transmission: Transmission,
        channels: tuple[int, int, int],
    ) -> None:
        following = [row for row, name in enumerate(joints) if name not in actuators]
        self._transmission = transmission
        self._following = np.array(following, dtype=np.intp)
        self._no_effort = np.full(len(following), np.nan).tobytes()
        self._sequence = 0
        fields = joint_state_fields([*actuators, *(joints[row] for row in following)])
        changing = (STAMP, *JOINT_ARRAYS)
        messages = (
            Template(JOINT_STATE, fields, changing),
            actuator_state_template(actuators),
            Template(JOINT_STATE, joint_state_fields(actuators), changing),
        )
        self.layout: list[tuple[int, int]] = []
        # Constant and changing pieces alternate, as in a template; the changing ones are odd.
        self._parts = [b""]
        self._size = 0
        for channel, message in zip(channels, messages, strict=True):
            self.layout.append((channel, self._size))
            self._parts[-1] += message_head(channel, 0, 0, message.size)[:_HEAD]
            self._parts += (b"", *message.parts)
            self._size += MESSAGE.size + message.size

    def encode(self, record: TickRecord, wall_ns: int) -> bytes:
        """Return the message records of a tick at a time [ns since 1970].

        A joint that follows an actuator has no effort of its own, hence ``NaN``. Raises
        `ValueError` if the arrays do not fit the hand.
        """
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        times, stamp = _TIMES.pack(self._sequence, wall_ns, wall_ns), stamp_bytes(wall_ns)
        followed = self._transmission.joints(record.position)[self._following]
        moved = self._transmission.velocities(record.position, record.velocity)[self._following]
        measured = actuator_state_pieces(record)
        position, velocity, effort = measured[2:5]
        self._parts[1::2] = [
            times,
            stamp,
            position + _rounded(followed),
            velocity + _rounded(moved),
            effort + self._no_effort,
            times,
            stamp,
            *measured,
            times,
            stamp,
            record.reference_position.tobytes(),
            record.reference_velocity.tobytes(),
            record.reference_effort.tobytes(),
        ]
        # A single copy, which keeps the encoding of a tick at some 10 µs.
        block = b"".join(self._parts)
        if len(block) != self._size:
            raise ValueError("the arrays of a tick have the wrong length for this hand")
        return block


def _rounded(values: FloatArray) -> bytes:
    return values.astype(np.float32).astype(np.float64).tobytes()


class LinkTransforms:
    """Encodes the poses of the links of moving joints, at the rate in the recorder's settings.

    ``rate`` is that of the hand's loop [Hz].
    """

    def __init__(self, hand: Hand, rate: float, settings: RecorderSettings) -> None:
        self._frames = JointFrames(hand)
        self._transmission = hand.transmission
        self._last = hand.transmission.joints(hand.rest)
        parents, children = zip(*self._frames.moving, strict=True)
        self._encoder = TransformsEncoder(parents, children)
        every = rate / settings.tf_rate / settings.decimation if settings.tf_rate else 0.0
        self._turn = -1
        self._every = max(1, round(every)) * settings.decimation if settings.tf_rate else 0

    def due(self, tick: int) -> bool:
        """Return whether to record transforms at a tick, or at the next one after a missed tick."""
        # With tick % every, a missed tick would skip a whole period.
        if not self._every or tick // self._every == self._turn:
            return False
        self._turn = tick // self._every
        return True

    def encode(self, position: FloatArray, wall_ns: int) -> bytes:
        """Return the CDR bytes of a ``tf2_msgs/TFMessage`` at a time since 1970 [ns].

        An actuator without a position ``(n,)`` [rad | m], which is ``NaN``, keeps its last one,
        at first the rest position.
        """
        q = self._transmission.joints(position)
        self._last = q = np.where(np.isfinite(q), q, self._last)
        translation, rotation = self._frames.at(q)
        return self._encoder.encode(wall_ns, _stepped(translation), _stepped(rotation))


def _stepped(values: FloatArray) -> FloatArray:
    return np.rint(values * _STEPS) / _STEPS


Item = (
    Goal
    | Plan
    | CommandRecord
    | Feedback
    | Result
    | Event
    | DeviceStatus
    | LoopStatistics
    | ObjectDescription
)
"""Recorded items other than ticks."""

ITSELF = "recorder"
"""Source of the recorder's own events."""

FAULTS = frozenset({"device_fault", "device_lost", "loop_error", "fault"})
"""Kinds of events that make the flight recorder write, besides all events of severity error."""

_CODECS: Mapping[type, tuple[str, Codec[Any]]] = {
    Goal: (topics.GOALS, GOAL),
    CommandRecord: (topics.COMMANDS, convert.COMMAND),
    Feedback: (topics.FEEDBACK, convert.FEEDBACK),
    Result: (topics.RESULTS, convert.RESULT),
    Event: (topics.EVENTS, convert.EVENT),
    DeviceStatus: (topics.DEVICE_STATUS, convert.DEVICE_STATUS),
    LoopStatistics: (topics.LOOP_STATISTICS, convert.LOOP_STATISTICS),
    ObjectDescription: (topics.OBJECT, convert.OBJECT),
}
"""Topic and codec of each recorded item other than ticks and plans."""

_CHANNELS = message_type("rtee_msgs/msg/Channels")
_GRIP_PERIOD = 0.02
"""Time between recorded openings and forces [s]: a grip builds up in a few tenths of a second."""

_AROUND = 5 * SECOND
"""Time recorded before and after an occurrence [ns]: seconds later, a hand rests."""

_SELDOM = 1 << 30  # a period longer than any chunk: only its first tick
_FLIGHT_FILES = 20  # most names kept of the flight recorder's files, the newest last


class LogWriter:
    """Encodes items, packs them into chunks, and passes the chunks on in time.

    Runs in the recorder's thread and waits only for the disk.

    Args:
        contents: Content common to the recordings.
        settings: Settings of the recorder.
        notify: Receives events: recording lost or resumed, flight file written.
        monotonic: Clock [s].
        wall: Clock [ns since 1970].
        simulated: Whether a simulation stamps the items instead of ``monotonic``; the first stamp
            then counts as now.
    """

    def __init__(
        self,
        contents: Contents,
        settings: RecorderSettings,
        notify: Callable[[Event], None] | None = None,
        monotonic: Callable[[], float] = asked,
        wall: Callable[[], int] = time.time_ns,
        *,
        simulated: bool = False,
    ) -> None:
        hand = contents.hand
        self._contents = contents
        self._actuators = hand.actuator_names
        self._settings = settings
        self._notify = notify
        self._monotonic = monotonic
        self._wall = wall
        self._simulated = simulated
        self._stamp = 0.0
        self._encoder = TickEncoder(
            hand.joint_names,
            hand.actuator_names,
            hand.transmission,
            (
                CHANNELS[topics.JOINT_STATES],
                CHANNELS[topics.ACTUATOR_STATES],
                CHANNELS[topics.REFERENCE],
            ),
        )
        self._transforms = LinkTransforms(hand, contents.rate, settings)
        columns = None
        if settings.layout is RecordingLayout.COLUMNS:
            rate = contents.rate / settings.decimation
            every = max(1, round(rate / settings.tf_rate)) if settings.tf_rate else _SELDOM
            columns = InColumns(CHANNELS[topics.TICKS], every)
        self._builder = ChunkBuilder(self._encoder.layout, settings.level, columns)
        self._digest: list[Sequence[Any]] = []
        self._held: deque[tuple[PackedChunk, int]] = deque()
        self._until = 0  # what happens is recorded until then [ns since 1970]
        self._due: float | None = None
        # Writers of several hands in one process write their chunks at different times.
        self._chunk_time = settings.chunk_time * (1.0 + crc32(hand.name.encode()) / 2**32) / 2
        self._compared = False
        self._anchor = 0
        self._sequence = 0
        self._extras: dict[str, FloatArray] = {}
        self._touch: Mapping[str, TouchState] = {}
        self._touch_encoder = TouchEncoder()
        self._plan: Plan | None = None
        self._grip_due = -float("inf")
        self._lost_reported = 0
        self._dropped_reported = 0
        self._flight_due: float | None = None
        self._flight_cause = ""
        self._flight_done = -float("inf")
        self.sink = DiskSink(contents, settings, monotonic)
        self.flight = (
            FlightRecorder(settings.flight_recorder, settings.flight_size)
            if settings.flight_recorder > 0
            else None
        )
        self.flight_files: deque[Path] = deque(maxlen=_FLIGHT_FILES)
        self.dropped: Callable[[], int] = lambda: 0

    @property
    def idle(self) -> bool:
        """Whether items need no encoding, without a recording and a flight recorder."""
        return self.flight is None and not self.sink.wanted

    def wall_of(self, stamp: float) -> int:
        """Return the time since 1970 [ns] of a CLOCK_MONOTONIC, or simulated, time [s].

        The clocks are compared once per file, so that a step of the wall clock disturbs no file.
        """
        self._stamp = stamp
        if not self._compared:
            now = stamp if self._simulated else self._monotonic()
            self._compare(self._wall() - round(now * SECOND))
        return self._anchor + round(stamp * SECOND)

    def _compare(self, difference: int) -> None:
        """Set the difference of the clocks [ns], but never let recorded time go back."""
        self._compared = True
        self._anchor = max(self._anchor, difference)

    def tick(self, record: TickRecord) -> None:
        """Encode the record of a tick."""
        if self.idle or record.tick % self._settings.decimation:
            return
        if not (self._compared or self._simulated):
            self._compare(record.wall_ns - round(record.stamp * SECOND))
        wall = self.wall_of(record.stamp)
        self._builder.add_block(wall, self._encoder.encode(record, wall))
        if record.channels:
            self._add_extras(record, wall)
        if record.touch is not self._touch:
            self._add_touch(record.touch, wall)
        if self._plan is not None and record.stamp >= self._grip_due:
            self._add_grip(self._plan, record, wall)
        if self._transforms.due(record.tick):
            self._add(topics.TF, wall, self._transforms.encode(record.position, wall))
        self._begun()

    def _add_extras(self, record: TickRecord, wall: int) -> None:
        """Record the further channels that have changed."""
        known = self._extras
        # Compare by identity, since published arrays never change, and a change is another array.
        new = {name: each for name, each in record.channels.items() if known.get(name) is not each}
        if not new:
            return
        known |= new
        names, lengths, values = channel_fields(new)
        fields = {
            "header": header(wall),
            "tick": record.tick,
            "name": names,
            "length": lengths,
            "value": values,
        }
        self._add(topics.CHANNELS, wall, _CHANNELS.encode(fields))

    def _add_touch(self, states: Mapping[str, TouchState], wall: int) -> None:
        """Record the touch sensors that have new measurements, or became stale."""
        known, self._touch = self._touch, states
        new = [state for name, state in states.items() if known.get(name) is not state]
        if any(s.device not in known or known[s.device].sensors is not s.sensors for s in new):
            sensors = TOUCH_SENSORS.encode(sensors_fields(states.values(), wall))
            self._contents.latched[topics.TOUCH_SENSORS] = sensors  # copied into files begun later
            self._add(topics.TOUCH_SENSORS, wall, sensors)
        for state in new:
            measured = self.wall_of(state.stamp)
            self._add(topics.TOUCH, wall, self._touch_encoder.encode(state, measured))

    def _add_grip(self, plan: Plan, record: TickRecord, wall: int) -> None:
        """Record the opening and the force of the fingertips."""
        self._grip_due = record.stamp + _GRIP_PERIOD
        estimate = GripEstimate(record.stamp, plan.action, *grip_at(plan.grip, record))
        self._add(topics.GRIP, wall, GRIP.encode(estimate, wall=wall))

    def state(self, snapshot: Snapshot, tick: int, stamp: float) -> None:
        """Attach the controller's state after the tick at a time [s] to the file."""
        more = {"library": library_name(), "tick": tick, "wall": self.wall_of(stamp)}
        with contextlib.suppress(TypeError):  # this part is then checked with earlier ones
            self.sink.attach(to_bytes(snapshot, **more))

    def item(self, item: Item, stamp: float) -> None:
        """Encode an item other than a tick; ``stamp``: its time on CLOCK_MONOTONIC [s]."""
        if isinstance(item, ObjectDescription):  # also for files that are begun later
            self._contents.latched[topics.OBJECT] = convert.OBJECT.encode(item)
        if self.idle:
            return
        wall = self.wall_of(stamp)
        if not isinstance(item, (DeviceStatus, LoopStatistics)):
            self._until = wall + _AROUND
        if isinstance(item, Plan):
            self._plan = item if item.grip is not None else None
            data = encode_plan(item, self._actuators, time=stamp, wall=wall)
            self._add(topics.PLANS, wall, data)
        else:
            topic, codec = _CODECS[type(item)]
            if isinstance(item, CommandRecord) and isinstance(item.command, StreamSample):
                topic, codec = topics.STREAM_SAMPLES, convert.STREAM_SAMPLE
            self._add(topic, wall, codec.encode(item, time=stamp, wall=wall))
        self._tell(item, wall)
        if isinstance(item, Event) and (item.severity == "error" or item.kind in FAULTS):
            self.fault(f"{item.kind}: {item.text}")
        self._begun()

    def _tell(self, item: Item, wall: int) -> None:
        if line := line_of(item, wall):
            self._digest.append(line)

    def _add(self, topic: str, wall: int, data: bytes) -> None:
        # One counter for all these topics keeps their order at equal times.
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        self._builder.add(CHANNELS[topic], self._sequence, wall, data)

    def _begun(self) -> None:
        if self._due is None:
            self._due = self._monotonic() + self._chunk_time
            # The first chunk was shorter, by a share that depends on the hand's name, so that the
            # writers of several hands stay apart.
            self._chunk_time = self._settings.chunk_time

    def start(self) -> None:
        """Begin a recording on the disk."""
        if self.sink.wanted:
            return
        # Messages collected earlier go to the flight recorder only.
        self.flush()
        self._compared = False
        self._extras, self._touch = {}, {}
        try:
            self.sink.start(self._wall())
        except OSError:
            self.sink.problem = "the folder or the disk does not take it"

    def stop(self) -> None:
        """End the recording on the disk."""
        self.flush()
        self.sink.stop()

    def fault(self, cause: str) -> None:
        """Have the flight recorder write, unless its memory still holds chunks of its last file."""
        if self.flight is None or self._flight_due is not None:
            return
        now = self._monotonic()
        self._flight_cause = cause
        self._flight_due = max(now, self._flight_done + self._settings.flight_recorder)

    def waiting(self) -> float | None:
        """Return the time until `poll` is due [s]; ``None`` if not before the next item."""
        times = [due for due in (self._due, self._flight_due) if due is not None]
        return max(0.0, min(times) - self._monotonic()) if times else None

    def poll(self) -> None:
        """Write the chunk or the flight file that is due."""
        now = self._monotonic()
        if self._due is not None and now >= self._due:
            self.flush()
        if self._flight_due is not None and now >= self._flight_due:
            self._write_flight()

    def flush(self) -> None:
        """Pack the collected messages and pass the chunk on."""
        self._due = None
        # Before packing, so that the report is in the chunk after the gap.
        dropped = self.dropped()
        if dropped != self._dropped_reported:
            text = f"{dropped - self._dropped_reported} records dropped: the writer fell behind"
            self._dropped_reported = dropped
            self._report("log_dropped", text)
        # Packing clears this number.
        ticks = self._builder.blocks
        chunk = self._builder.pack()
        digest, self._digest = tuple(self._digest), []
        if chunk is None:
            return
        if self.flight is not None:
            # Before the disk, which may fail: the flight recorder must have chunks the file lacks.
            self.flight.add(chunk)
        before = self.sink.problem
        path = self.sink.path
        self._held.append((replace(chunk, digest=digest), ticks))
        if self._settings.record is not Recorded.GOALS or chunk.start <= self._until:
            while self._held:
                self.sink.write(*self._held.popleft())
        while self._held and self._held[0][0].end < chunk.end - _AROUND:
            self._held.popleft()
        if self.sink.problem and not before:
            self._report("log_failed", f"recording is lost: {self.sink.problem}")
        elif before and not self.sink.problem:
            lost = self.sink.lost_ticks - self._lost_reported
            self._lost_reported = self.sink.lost_ticks
            self._report("log_resumed", f"recording goes on after {lost} ticks were lost: {before}")
        if self.sink.path != path:
            self._compared = False
            self._extras = {}  # every file has all channels

    def _report(self, kind: str, text: str) -> None:
        now = self._stamp if self._simulated else self._monotonic()
        event = Event(kind, ITSELF, text, now, "warning")
        # Also into the recording itself, where it explains the gap to a reader.
        wall = self.wall_of(event.stamp)
        self._add(topics.EVENTS, wall, convert.EVENT.encode(event, wall=wall))
        self._tell(event, wall)
        if self._notify is not None:
            with contextlib.suppress(RuntimeError):  # the loop that would be notified has ended
                self._notify(event)

    def _write_flight(self) -> None:
        self._flight_due = None
        self._flight_done = self._monotonic()
        # The newest messages, too, since they show the fault.
        self.flush()
        assert self.flight is not None  # noqa: S101 - a fault is only noted with one
        chunks = tuple(self.flight.chunks())
        if not chunks:
            return
        try:
            path = self.sink.write_flight(chunks, self._wall(), self._flight_cause)
        except OSError as error:
            self._report("log_failed", f"the flight recorder cannot write: {reason(error)}")
            return
        self.flight_files.append(path)
        self._report("flight_recorded", f"{self.flight.seconds:.1f} s written to {path}")

    def close(self) -> None:
        """Write the remaining messages and a pending flight file, and close the file."""
        try:
            if self._flight_due is not None:
                self._write_flight()
            self.flush()
        finally:
            self.sink.stop()


class FlightRecorder:
    """Keeps the newest chunks within limits of time [s] and of memory, their ``size`` [bytes]."""

    def __init__(self, seconds: float, size: float) -> None:
        self._seconds = seconds
        self._limit = size
        self.size = 0
        self._chunks: deque[PackedChunk] = deque()

    @property
    def seconds(self) -> float:
        """Time from the first to the last message [s]."""
        if not self._chunks:
            return 0.0
        return (self._chunks[-1].end - self._chunks[0].start) / SECOND

    def add(self, chunk: PackedChunk) -> None:
        """Add a chunk; drop the oldest ones beyond the limits."""
        self._chunks.append(_in_memory_of_its_own(chunk))
        self.size += chunk.size
        oldest = chunk.end - int(self._seconds * SECOND)
        while self._chunks[0].end < oldest or (self.size > self._limit and len(self._chunks) > 1):
            self.size -= self._chunks.popleft().size

    def chunks(self) -> Iterable[PackedChunk]:
        """Return the chunks, oldest first."""
        return tuple(self._chunks)


def _in_memory_of_its_own(chunk: PackedChunk) -> PackedChunk:
    """Return a copy of a chunk in memory that returns to the system when the chunk is dropped.

    On the heap, blocks of many sizes that live for a minute would fragment the process's memory.
    """
    memory = mmap.mmap(-1, chunk.size)
    memory.write(chunk.record)
    memory.write(chunk.index)
    view, end = memoryview(memory), len(chunk.record)
    return replace(chunk, record=view[:end], index=view[end:])
