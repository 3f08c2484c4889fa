"""A recording in memory: arrays by topic, goals with their spans, attachments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from rtee.commands import CommandRecord
from rtee.errors import LogError, suggestion
from rtee.log.brief import rate_of, spans_of
from rtee.log.plans import GripEstimate
from rtee.loop.plan import Plan
from rtee.messages.codec import SECOND
from rtee.objects.description import ObjectDescription
from rtee.sample import BoolArray, FloatArray, Measurements
from rtee.touch import TouchSensor, TouchState, totals
from rtee.types import DeviceStatus, Event, Feedback, Goal, LoopStatistics, Result
from rtee.values import Value

T = TypeVar("T")


def row_at(times: FloatArray, time: float) -> int:
    """Return the row of the last values up to a time, otherwise the first row."""
    return max(0, int(np.searchsorted(times, time, side="right")) - 1)


@dataclass(frozen=True)
class JointSeries(Value):
    """Joint states over time.

    Attributes:
        t: Time since the recording's start ``(k,)`` [s].
        wall: The same since 1970 ``(k,)`` [ns].
        names: Names of the ``n`` joints or actuators.
        position: Positions ``(k, n)`` [rad | m].
        velocity: Velocities ``(k, n)`` [rad/s | m/s].
        effort: Efforts ``(k, n)`` [N·m | N]; in a reference the effort limits.
    """

    t: FloatArray
    wall: NDArray[np.int64]
    names: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray

    def __len__(self) -> int:
        return len(self.t)

    def index(self, name: str) -> int:
        """Return the column of a joint.

        Raises:
            LogError: if it is not in the recording.
        """
        try:
            return self.names.index(name)
        except ValueError:
            raise LogError(
                f"'{name}' is not in the recording; {suggestion(name, self.names)}"
            ) from None


@dataclass(frozen=True)
class ActuatorSeries(JointSeries, Measurements):
    """Measurements of the actuators over time, as the loop received them.

    Attributes:
        tick: Numbers of the ticks ``(k,)``; a gap is a missed or lost tick.
        time: CLOCK_MONOTONIC of the ticks ``(k,)`` [s].
        grasped: Reports of the devices ``(k, n)``: 1 holding, 0 not holding, -1 no report.
        fresh: Whether a value was measured since the tick before ``(k, n)``.
    """

    tick: NDArray[np.int64]
    time: FloatArray
    grasped: NDArray[np.int8]
    fresh: BoolArray


@dataclass(frozen=True, slots=True)
class Entry(Value, Generic[T]):
    """A message that is recorded once, such as a goal, result or event.

    Attributes:
        t: Time since the recording's start [s].
        wall: The same time since 1970 [ns].
        stamp: The same time by CLOCK_MONOTONIC [s]; 0 if unknown.
        value: Content of the message.
        sequence: Number that orders entries of the same time, also those of different topics.
    """

    t: float
    wall: int
    stamp: float
    value: T
    sequence: int = 0


@dataclass(frozen=True, slots=True)
class Channel(Value):
    """A further measured channel over time.

    Attributes:
        name: Name of the channel.
        t: Times of the changes since the recording's start [s].
        values: Values at those times.
    """

    name: str
    t: FloatArray
    values: tuple[FloatArray, ...]


@dataclass(frozen=True)
class TouchSeries(Value):
    """Readings of the touch sensors of a device over time.

    Attributes:
        device: The device.
        sensors: Its sensors.
        t: Time of reception in the loop since the recording's start ``(k,)`` [s].
        wall: The same time since 1970 ``(k,)`` [ns].
        time: Time of the oldest value, CLOCK_MONOTONIC ``(k,)`` [s].
        stale: Whether the readings had stopped for a while ``(k,)``.
        values: Values of all taxels, one sensor after the other, in their units ``(k, n)``.
    """

    device: str
    sensors: tuple[TouchSensor, ...]
    t: FloatArray
    wall: NDArray[np.int64]
    time: FloatArray
    stale: BoolArray
    values: FloatArray

    def __len__(self) -> int:
        return len(self.t)

    def state(self, row: int) -> TouchState:
        """Return the readings of a row as a state."""
        return TouchState(
            self.device,
            self.sensors,
            self.values[row],
            float(self.time[row]),
            bool(self.stale[row]),
        )

    @cached_property
    def totals(self) -> FloatArray:
        """The sum over the taxels of each sensor ``(k, sensors)``, in its unit."""
        return totals(self.sensors, self.values)


def touch_series(
    by_device: Mapping[str, Sequence[tuple[int, TouchState]]], start: int
) -> tuple[dict[str, TouchSeries], int]:
    """Return states of touch sensors as series by device, and the number of states left out.

    The states of a device come in order, each with its time since 1970 [ns]; ``start`` is the start
    of the recording, since 1970 [ns].
    """
    series, others = {}, 0
    for device, states in by_device.items():
        last = states[-1][1]
        names = [(sensor.name, sensor.taxels) for sensor in last.sensors]
        # Keep the states of the last sensors, if the device was replaced by another one.
        same = [s for s in states if [(x.name, x.taxels) for x in s[1].sensors] == names]
        others += len(states) - len(same)
        wall = np.array([time for time, _ in same], dtype=np.int64)
        series[device] = TouchSeries(
            device,
            last.sensors,
            (wall - start) / SECOND,
            wall,
            np.array([state.stamp for _, state in same]),
            np.array([state.stale for _, state in same]),
            np.array([state.values for _, state in same]),
        )
    return series, others


@dataclass(frozen=True, slots=True)
class Span(Value):
    """The time an action took.

    Attributes:
        name: The action with its elements, or the inner action's name.
        start: Time of its start since the recording's start [s].
        end: Time of its end [s]; the recording's end if it was still running. If its result was
            lost on a full disk, the start of the next one.
        outcome: That of the result, `rtee.types.Outcome`; ``running`` until there is one, or
            ``unknown``.
        goal_id: The goal.
        inner: The inner actions of a timed action.
    """

    name: str
    start: float
    end: float
    outcome: str
    goal_id: str
    inner: tuple[Span, ...] = ()


@dataclass(frozen=True)
class Recording(Value):
    """A recording in memory.

    Attributes:
        paths: The files, in order.
        hand: Name of the hand.
        start: Time of the first message since 1970 [ns].
        end: Time of the last message since 1970 [ns].
        finished: Whether all files were closed properly.
        metadata: Metadata of the files: rate, actuators, session and others.
        attachments: Attached files by name: URDF, hand.yaml, actions.
        joint_states: States of all joints, including those that follow others.
        actuator_states: Measurements of the actuators.
        reference: Set-points sent to the devices.
        goals: Accepted goals.
        plans: Plans of the goals.
        commands: Other commands to the hand.
        stream_samples: Samples of streams, as commands.
        grip: Opening and force of the fingertips during goals that have one.
        feedback: Progress of the goals.
        results: Results of the goals.
        events: Events, including marks.
        device_status: Device status, about once per second.
        loop_statistics: Loop statistics, about once per second.
        channels: Further measured channels by name.
        touch: Readings of touch sensors, by device.
        object_description: Object in a simulated hand, if there was one.
        urdf: Text of the URDF.
        meshes: Names of attachments by address of a mesh in the URDF.
        others: Messages by topic that have no place above, as fields: descriptions, transforms.
        notes: Sentences about problems of the files.
        damage: Those notes that report damage.
    """

    paths: tuple[Path, ...]
    hand: str
    start: int
    end: int
    finished: bool
    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]
    joint_states: JointSeries
    actuator_states: ActuatorSeries
    reference: JointSeries
    goals: Sequence[Entry[Goal]] = ()
    plans: Sequence[Entry[Plan]] = ()
    commands: Sequence[Entry[CommandRecord]] = ()
    stream_samples: Sequence[Entry[CommandRecord]] = ()
    grip: Sequence[Entry[GripEstimate]] = ()
    feedback: Sequence[Entry[Feedback]] = ()
    results: Sequence[Entry[Result]] = ()
    events: Sequence[Entry[Event]] = ()
    device_status: Sequence[Entry[DeviceStatus]] = ()
    loop_statistics: Sequence[Entry[LoopStatistics]] = ()
    channels: Mapping[str, Channel] = field(default_factory=dict)
    touch: Mapping[str, TouchSeries] = field(default_factory=dict)
    object_description: ObjectDescription | None = None
    urdf: str = ""
    meshes: Mapping[str, str] = field(default_factory=dict)
    others: Mapping[str, Sequence[Entry[Mapping[str, Any]]]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()

    @property
    def states(self) -> JointSeries:
        """The states of the actuators; in recordings of other programs, those of the joints."""
        return self.actuator_states if len(self.actuator_states) else self.joint_states

    @property
    def duration(self) -> float:
        """Time from the first to the last message [s]."""
        return (self.end - self.start) / SECOND

    @property
    def rate(self) -> float:
        """Rate of the loop [Hz]; 0 if unknown."""
        return rate_of(self.metadata)

    @property
    def marks(self) -> list[Entry[Event]]:
        """The marks set by users."""
        return [entry for entry in self.events if entry.value.kind == "mark"]

    @cached_property
    def spans(self) -> list[Span]:
        """The spans of all goals, in order."""
        feedback: dict[str, list[Entry[Feedback]]] = {}
        for entry in self.feedback:
            feedback.setdefault(entry.value.goal_id, []).append(entry)
        told = spans_of(
            [
                (e.t, e.value.goal_id, getattr(e.value.what, "action", ""), e.value.what.elements)
                for e in self.goals
            ],
            {entry.value.goal_id: entry.value.action for entry in self.plans},
            {entry.value.goal_id: (entry.t, entry.value.outcome) for entry in self.results},
            self.duration,
        )
        return [
            Span(*span, tuple(_inner_spans(feedback.get(span[-1], []), *reversed(span[2:]))))
            for span in told
        ]


def _inner_spans(
    feedback: Sequence[Entry[Feedback]], goal_id: str, outcome: str, end: float
) -> Iterator[Span]:
    """Yield the inner actions of a timed action, as its feedback names them."""
    name, start = "", 0.0
    for entry in feedback:
        if entry.value.inner == name:
            continue
        if name:
            yield Span(name, start, entry.t, "reached", goal_id)
        name, start = entry.value.inner, entry.t
    # The last inner action has the outcome of the whole; the earlier ones were reached.
    if name:
        yield Span(name, start, end, outcome, goal_id)
