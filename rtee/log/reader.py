"""Read recordings into arrays."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

import numpy as np

from rtee.errors import GoalRejected, LogError, MessageError
from rtee.hand.files import failing
from rtee.hand.names import listed
from rtee.log import column_reader
from rtee.log.brief import Brief, actuators_of, brief, check_hands
from rtee.log.file_index import (
    MOST_TOLD,
    ChunkPlace,
    FileIndex,
    index_file,
    others_damaged,
)
from rtee.log.plans import GRIP, plan_of
from rtee.log.record_scanner import LATEST, DamagedRecordError, messages_of
from rtee.log.recording import (
    ActuatorSeries,
    Channel,
    Entry,
    JointSeries,
    Recording,
    TouchSeries,
    touch_series,
)
from rtee.log.rotation import MESHES, paths_of
from rtee.loop.plan import Plan
from rtee.messages import GOAL, convert, topics
from rtee.messages.codec import SECOND, channels_of
from rtee.messages.schema import MessageType, message_type, recorded_type
from rtee.messages.state import ACTUATOR_COLUMNS
from rtee.messages.tick_columns import decode_ticks
from rtee.messages.touch import sensors_of, touch_of
from rtee.sample import COLUMNS, FloatArray
from rtee.touch import TouchSensor, TouchState
from rtee.types import Goal, Named

T = TypeVar("T")

_AHEAD = 4
"""Number of chunks decompressed in advance: two keep the thread busy, and chunks of half a second
need little memory."""

_WINDOW = round(10 * SECOND)
"""Length of a piece of a recording [ns]: at 1 kHz, the arrays of twenty actuators take 20 MB."""

_TABLES = (topics.JOINT_STATES, topics.ACTUATOR_STATES, topics.REFERENCE)

Fields = Mapping[str, Any]
Message = tuple[int, int, Fields]
"""Log time [ns since 1970], sequence number and fields."""


def read(
    path: Path | str | Iterable[Path | str],
    *,
    series: bool = False,
    only: Iterable[str] | None = None,
) -> Recording:
    """Read a recording into memory.

    A file that was never closed is read up to its last sound chunk.

    Args:
        path: A file, several files of one hand, or a folder: its newest recording with all parts.
        series: With a file, read all parts of its recording.
        only: Names of topics to read, such as ``reference``; all unless given. Transforms, which
            are recorded for viewers and follow from the joint states, are never read.

    Raises:
        LogError: if a file cannot be opened, is not an MCAP file, or contains no recording of a
            hand.
    """
    return read_indexed([index_file(each) for each in paths_of(path, series=series)], only)


def read_indexed(
    file_indexes: Sequence[FileIndex], only: Iterable[str] | None = None, *, every: bool = False
) -> Recording:
    """Read files that were indexed; with ``every``, also look for damage in the other chunks."""
    return _Collector(file_indexes, _wanted(only), every=every).read()


def windows(
    path: Path | str | Iterable[Path | str],
    *,
    series: bool = False,
    only: Iterable[str] | None = None,
    start: float | None = None,
    end: float | None = None,
) -> Iterator[Recording]:
    """Read a recording piece by piece, in memory that does not grow with its length.

    Yields pieces of 10 s in order of time, at least one. Their ``t``, ``start`` and ``end`` are
    those of the whole; notes and damage are those found so far. Only chunks with messages from
    ``start`` to ``end`` since the recording's start [s] are read. The other arguments and errors
    are those of `read`.
    """
    wanted = _wanted(only)
    briefs = [brief(each) or index_file(each) for each in paths_of(path, series=series)]
    briefs.sort(key=lambda each: each.start)
    span = _span(briefs)
    first = span[0] + round((start or 0.0) * SECOND)
    last = span[1] if end is None else span[0] + round(end * SECOND)
    check_hands({each.path: each.hand for each in briefs})
    chosen = [each for each in briefs if each.end >= first and each.start <= last]
    for file in chosen or briefs[:1]:
        # One after the other: the index of an hour takes some 30 MB.
        whole = file if isinstance(file, FileIndex) else index_file(file.path)
        yield from _Collector([whole], wanted, span).pieces(first, last)


def _wanted(only: Iterable[str] | None) -> set[str]:
    if only is None:
        wanted = set(topics.TYPES) - topics.FOR_VIEWERS
    else:
        wanted = set(listed(only, "topics", LogError))
    unknown = wanted - set(topics.TYPES)
    if unknown:
        raise LogError(f"unknown topics {sorted(unknown)}; valid: {sorted(topics.TYPES)}")
    return wanted | {topics.TICKS} if wanted.intersection(_TABLES) else wanted


def _span(file_indexes: Sequence[FileIndex | Brief]) -> tuple[int, int]:
    """Return the earliest and the latest log time [ns since 1970]; 0 without messages."""
    return (
        min((each.start for each in file_indexes if each.end), default=0),
        max((each.end for each in file_indexes), default=0),
    )


class _Topic(NamedTuple):
    """A channel of a file: the name of its topic and the type of its messages."""

    name: str
    kind: MessageType


class _Collector:
    """Collects messages of files; ``span`` [ns] if these are only a part of a recording."""

    def __init__(
        self,
        file_indexes: Sequence[FileIndex],
        wanted: set[str],
        span: tuple[int, int] | None = None,
        *,
        every: bool = False,
    ) -> None:
        self._file_indexes = file_indexes
        self._every = every
        self._wanted = wanted
        self._hand = file_indexes[0].hand
        check_hands({each.path: each.hand for each in file_indexes})
        self._span = span or _span(file_indexes)
        self._from, self._before = 0, LATEST + 1  # log times of the messages that are taken [ns]
        self._notes = [f"{each.path.name}: {note}" for each in file_indexes for note in each.notes]
        self._notes += [
            f"{each.path.name}: {each.loose} messages outside chunks are not read"
            for each in file_indexes
            if each.loose
        ]
        self._names = {topics.log_topic(self._hand, name): name for name in topics.TYPES}
        self._files = [(each, self._channels(each)) for each in file_indexes]
        # The indexes give the number of messages, and so the final size of the arrays of a whole
        # recording.
        counts = dict.fromkeys(_TABLES, 0)
        for file, channels in self._files:
            for number, channel in channels.items():
                if channel.name in counts and span is None:
                    counts[channel.name] += file.count(number)
        self._rows = {name: column_reader.MessageColumns(count) for name, count in counts.items()}
        self._messages: dict[str, list[Message]] = {name: [] for name in topics.TYPES}
        self._damage = [
            f"{each.path.name}: {note}" for each in file_indexes for note in each.damage
        ]
        self._damaged = 0
        self._skipped = 0
        self._told: set[int] = set()  # damaged chunks

    def _channels(self, file: FileIndex) -> dict[int, _Topic]:
        """Return the wanted channels of a file that have the types of rtee."""
        channels = {}
        for number, channel in file.channels.items():
            name = self._names.get(channel.topic)
            schema = file.schemas.get(channel.schema_id)
            if name in self._wanted and schema is not None and schema.name == topics.TYPES[name]:
                try:
                    kind = recorded_type(schema.name, schema.data.decode("utf-8", "replace"))
                except MessageError as error:
                    self._notes.append(f"{file.path.name}: {channel.topic} is left out: {error}")
                else:
                    channels[number] = _Topic(name, kind)
        return channels

    def read(self) -> Recording:
        for file, channels in self._files:
            self._file(file, channels, file.chunks)
        return self._recording(ended=True)

    def pieces(self, first: int, last: int) -> Iterator[Recording]:
        """Yield the only file's messages between two log times [ns], piece by piece."""
        ((file, channels),) = self._files
        latched = {k: each for k, each in channels.items() if each.name in topics.LATCHED}
        # Values from before the piece that are still valid.
        self._before = first
        self._file(file, latched, [each for each in file.chunks if each.start < first])
        places = sorted(file.chunks, key=lambda each: each.start)
        places = [each for each in places if each.end >= first and each.start <= last]
        held: list[ChunkPlace] = []  # chunks that reach into the next piece
        self._before, taken, ended = first, 0, False
        while not ended:
            self._from = begin = self._before
            begin = begin if held or taken == len(places) else max(begin, places[taken].start)
            while taken < len(places) and places[taken].start < begin + _WINDOW:
                held.append(places[taken])
                taken += 1
            ended = taken == len(places)
            # A piece ends where a chunk begins, so that most chunks are read once.
            self._before = last + 1 if ended else places[taken].start
            self._file(file, channels, held)
            held = [each for each in held if each.end >= self._before]
            yield self._recording(ended=ended)
            for table in self._rows.values():
                table.clear()
            for name, messages in self._messages.items():
                if name not in topics.LATCHED:
                    messages.clear()

    def _file(
        self, file: FileIndex, channels: Mapping[int, _Topic], places: Sequence[ChunkPlace]
    ) -> None:
        # Any topic of a hand makes it a recording, even if none of the wanted ones is there.
        if not file.values and not any(c.topic in self._names for c in file.channels.values()):
            raise LogError("contains no recording of a hand", path=file.path)
        wanted = [
            place
            for place in places
            if self._every or not place.indexes or channels.keys() & place.indexes.keys()
        ]
        with (
            failing("cannot be read", file.path, LogError),
            file.path.open("rb") as stream,
        ):
            for place, data in _chunks_ahead(file.path, wanted):
                if not isinstance(data, DamagedRecordError):
                    self._chunk(place, data, stream, channels)
                elif id(place) not in self._told:  # not yet reported by the previous piece
                    self._told.add(id(place))
                    if len(self._told) <= MOST_TOLD:
                        self._note_damage(f"{file.path.name}: {file.lost(place, data)}")

    def _chunk(
        self, place: ChunkPlace, data: bytes, stream: BinaryIO, channels: Mapping[int, _Topic]
    ) -> None:
        found = column_reader.messages_of(place, stream, data, channels)
        for number in [k for k in found if channels[k].name == topics.TICKS]:
            for message in found.pop(number).contents():
                try:
                    # They replace the few of these samples that are also in the file as messages.
                    ticks = column_reader.messages_in(*decode_ticks(message))
                except MessageError:
                    self._damaged += 1
                else:
                    found |= {k: each for k, each in ticks.items() if k in channels}
        for number, messages in found.items():
            name, kind = channels[number]
            times = messages.times
            # A damaged time would put a message anywhere in the recording.
            sound = (times >= place.start) & (times <= place.end)
            self._damaged += int(len(sound) - sound.sum())
            taken = messages.where(sound & (times >= self._from) & (times < self._before))
            if name in _TABLES:
                self._rows[name].add(kind, taken)
            else:
                self._decode(name, kind, taken)

    def _decode(self, name: str, kind: MessageType, messages: column_reader.Messages) -> None:
        ours = message_type(kind.name)
        times, order = messages.times.tolist(), messages.heads["sequence"].tolist()
        for message, time, number in zip(messages.contents(), times, order, strict=True):
            try:
                fields = kind.decode(message)
            except MessageError:
                self._damaged += 1
                continue
            if kind is not ours:
                # Fields that an older recording lacks get their default values.
                fields = ours.completed(fields)
            self._messages[name].append((time, number, fields))

    # --- from messages to a recording --------------------------------------------------------

    def _recording(self, *, ended: bool) -> Recording:
        start, end = self._span
        joint_states = self._series(topics.JOINT_STATES, start)
        reference = self._series(topics.REFERENCE, start)
        actuator_states = self._actuators(start)
        # In earlier versions the planned speed was recorded in the goal, not in the plan.
        speeds = {each["goal_id"]: each["speed"] for _, _, each in self._messages[topics.GOALS]}
        goals = self._entries(topics.GOALS, _goal, start)
        by_id = {entry.value.goal_id: entry.value for entry in goals}
        written = actuators_of(self._file_indexes[0].values)
        names = actuator_states.names or tuple(written)

        def plan(fields: Fields) -> Plan:
            goal_id = fields["goal_id"]
            goal = by_id.get(goal_id, Goal(Named(fields["action"]), goal_id=goal_id))
            if math.isnan(fields["speed"]):
                fields = {**fields, "speed": speeds.get(goal_id, 1.0)}
            return plan_of(fields, goal, names)

        def entries(name: str, make: Callable[[Fields], T]) -> list[Entry[T]]:
            return self._entries(name, make, start)

        objects = entries(topics.OBJECT, convert.OBJECT.of)
        attachments = self._attachments()
        recording = Recording(
            paths=tuple(each.path for each in self._file_indexes),
            hand=self._hand,
            start=start,
            end=end,
            finished=all(each.finished for each in self._file_indexes),
            metadata=self._file_indexes[0].values,
            attachments=attachments,
            joint_states=joint_states,
            actuator_states=actuator_states,
            reference=reference,
            goals=goals,
            plans=entries(topics.PLANS, plan) if names else (),
            commands=entries(topics.COMMANDS, convert.COMMAND.of),
            stream_samples=entries(topics.STREAM_SAMPLES, convert.STREAM_SAMPLE.of),
            grip=entries(topics.GRIP, GRIP.of),
            feedback=entries(topics.FEEDBACK, convert.FEEDBACK.of),
            results=entries(topics.RESULTS, convert.RESULT.of),
            events=entries(topics.EVENTS, convert.EVENT.of),
            device_status=entries(topics.DEVICE_STATUS, convert.DEVICE_STATUS.of),
            loop_statistics=entries(topics.LOOP_STATISTICS, convert.LOOP_STATISTICS.of),
            channels=_channels_of(self._messages[topics.CHANNELS], start),
            touch=self._touch(start),
            object_description=objects[-1].value if objects else None,
            urdf=self._urdf(attachments),
            meshes=self._file_indexes[0].metadata.get(MESHES, {}),
            # Entries that stay valid are kept for later pieces, but returned only once.
            others={
                name: [entry for entry in entries(name, _fields) if entry.wall >= self._from]
                for name in topics.DESCRIBING
            },
        )
        self._skipped += sum(table.skipped for table in self._rows.values())
        if len(self._told) > MOST_TOLD and ended:
            self._note_damage(others_damaged(len(self._told) - MOST_TOLD))
        if self._damaged and ended:
            self._note_damage(f"messages that make no sense and are left out: {self._damaged}")
        if self._skipped and ended:
            self._notes.append(f"{self._skipped} messages with other joints are left out")
        # Making the entries above has added notes; the frozen object is not shared yet.
        object.__setattr__(recording, "notes", tuple(self._notes))
        object.__setattr__(recording, "damage", tuple(self._damage))
        return recording

    def _attachments(self) -> dict[str, bytes]:
        return {
            name: bytes(attachment.data)
            # The attachments of the first file take precedence, being those of the start.
            for index in reversed(self._file_indexes)
            for name, attachment in index.attachments.items()
        }

    def _note_damage(self, text: str) -> None:
        self._notes.append(text)
        self._damage.append(text)

    def _urdf(self, attachments: Mapping[str, bytes]) -> str:
        """Return the attached URDF, since the published one may have embedded meshes."""
        attached = attachments.get(f"{self._hand}.urdf")
        if attached is not None:
            return attached.decode("utf-8", "replace")
        descriptions = self._messages[topics.ROBOT_DESCRIPTION]
        return str(descriptions[0][2]["data"]) if descriptions else ""

    def _series(self, name: str, start: int) -> JointSeries:
        table = self._rows[name]
        order = column_reader.order_of(table.times)
        wall = table.times[order]
        return JointSeries(
            t=(wall - start) / SECOND,
            wall=wall,
            names=table.names,
            **{
                key: table.column(key, math.nan)[order]
                for key in ("position", "velocity", "effort")
            },
        )

    def _actuators(self, start: int) -> ActuatorSeries:
        table = self._rows[topics.ACTUATOR_STATES]
        order = column_reader.order_of(table.times)
        wall = table.times[order]
        return ActuatorSeries(
            t=(wall - start) / SECOND,
            wall=wall,
            names=table.names,
            tick=table.scalars("tick")[order].astype(np.int64),
            time=table.scalars("time")[order],
            **{name: table.column(name, COLUMNS[name].default)[order] for name in ACTUATOR_COLUMNS},
        )

    def _touch(self, start: int) -> dict[str, TouchSeries]:
        known: dict[str, tuple[TouchSensor, ...]] = {}
        for _, _, fields in self._messages[topics.TOUCH_SENSORS]:
            try:
                known |= sensors_of(fields)
            except MessageError:
                self._damaged += 1
        by_device: dict[str, list[tuple[int, TouchState]]] = {}
        for time, _, fields in sorted(self._messages[topics.TOUCH], key=lambda each: each[:2]):
            try:
                state = touch_of(fields, known)
            except MessageError:
                self._damaged += 1
            else:
                by_device.setdefault(state.device, []).append((time, state))
        series, others = touch_series(by_device, start)
        if others:
            self._notes.append(f"{others} messages of other touch sensors are left out")
        return series

    def _entries(self, name: str, make: Callable[[Fields], T], start: int) -> list[Entry[T]]:
        entries = []
        for time, number, fields in self._messages[name]:
            try:
                value = make(fields)
            except (MessageError, GoalRejected):
                self._damaged += 1
                continue
            stamp = float(fields.get("time", 0.0))
            entries.append(Entry((time - start) / SECOND, time, stamp, value, number))
        # A stable sort keeps entries of the same time in the order of the file.
        return sorted(entries, key=lambda entry: entry.wall)


def _chunks_ahead(
    path: Path, places: Sequence[ChunkPlace]
) -> Iterator[tuple[ChunkPlace, bytes | DamagedRecordError]]:
    """Yield chunks with their uncompressed records, or with the error of a damaged one.

    A thread reads and decompresses the next chunks while the caller parses the present one. Raises
    `OSError` if the file cannot be read.
    """

    def load(place: ChunkPlace) -> bytes | DamagedRecordError:
        try:
            return messages_of(place.record.read(stream))[0]
        except DamagedRecordError as error:
            return error

    with path.open("rb") as stream, ThreadPoolExecutor(1, "rtee-chunks") as pool:
        waiting: deque[tuple[ChunkPlace, Future[bytes | DamagedRecordError]]] = deque()
        try:
            for place in places:
                waiting.append((place, pool.submit(load, place)))
                if len(waiting) > _AHEAD:
                    first, future = waiting.popleft()
                    yield first, future.result()
            while waiting:
                first, future = waiting.popleft()
                yield first, future.result()
        finally:
            for _, future in waiting:
                # If the caller stops early, chunks that have not begun need no decompression.
                future.cancel()


def _goal(fields: Fields) -> Goal:
    # Older recordings have the share beside the speed of the opening.
    return GOAL.of(fields if math.isnan(fields["tip_speed"]) else {**fields, "speed": 1.0})


def _fields(fields: Fields) -> Fields:
    return fields


def _channels_of(messages: Sequence[Message], start: int) -> dict[str, Channel]:
    times: dict[str, list[float]] = {}
    values: dict[str, list[FloatArray]] = {}
    for time, _, fields in messages:
        try:
            changed = channels_of(fields["name"], fields["length"], fields["value"])
        except MessageError:
            continue
        for name, value in changed.items():
            times.setdefault(name, []).append((time - start) / SECOND)
            values.setdefault(name, []).append(value)
    return {name: Channel(name, np.array(times[name]), tuple(values[name])) for name in times}
