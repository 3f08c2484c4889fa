"""A recording in memory: arrays by topic, goals with their spans, attachments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from rtee.commands import CommandRecord
from rtee.errors import LogError, suggestion
from rtee.loop.plan import Plan
from rtee.messages.codec import SECOND
from rtee.object_description import ObjectDescription
from rtee.sample import BoolArray, FloatArray, Measurements
from rtee.touch import TouchSensor, TouchState, totals
from rtee.types import DeviceStatus, Event, Feedback, Goal, LoopStatistics, Result

T = TypeVar("T")


@dataclass(frozen=True)
class JointSeries:
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
    """What the actuators measured over time, as the loop received it.

    Attributes:
        tick: Numbers of the ticks ``(k,)``; a gap is a missed or lost tick.
        time: CLOCK_MONOTONIC of the ticks ``(k,)`` [s].
        grasped: What the devices report themselves ``(k, n)``: 1 holding, 0 not, -1 nothing.
        fresh: Whether it was measured since the tick before ``(k, n)``.
    """

    tick: NDArray[np.int64]
    time: FloatArray
    grasped: NDArray[np.int8]
    fresh: BoolArray


@dataclass(frozen=True, slots=True)
class Entry(Generic[T]):
    """Something that happened.

    Attributes:
        t: When, since the recording's start [s].
        wall: The same since 1970 [ns].
        stamp: The same by CLOCK_MONOTONIC [s], where it is known, else 0.
        value: What.
        sequence: Orders entries of the same time, also of different topics.
    """

    t: float
    wall: int
    stamp: float
    value: T
    sequence: int = 0


@dataclass(frozen=True, slots=True)
class Channel:
    """A further measured channel over time.

    Attributes:
        name: Its name.
        t: Times since the recording's start [s], of the changes only.
        values: Values at those times.
    """

    name: str
    t: FloatArray
    values: tuple[FloatArray, ...]


@dataclass(frozen=True)
class TouchSeries:
    """What the touch sensors of a device measured over time.

    Attributes:
        device: The device.
        sensors: Its sensors.
        t: Time since the recording's start at which the loop received it ``(k,)`` [s].
        wall: The same since 1970 ``(k,)`` [ns].
        time: When the oldest value was measured, CLOCK_MONOTONIC ``(k,)`` [s].
        stale: Whether nothing newer had come for a while ``(k,)``.
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
        """Return one of them as a state."""
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
    found: Mapping[str, Sequence[tuple[int, TouchState]]], start: int
) -> tuple[dict[str, TouchSeries], int]:
    """Return states of touch sensors as series by device, and how many fit none of them.

    Args:
        found: The states by device, each with its time since 1970 [ns], in order.
        start: The recording's start [ns].
    """
    series, others = {}, 0
    for device, states in found.items():
        last = states[-1][1]
        names = [(sensor.name, sensor.taxels) for sensor in last.sensors]
        # A device may have been exchanged for one with other sensors: the last ones count.
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
class Span:
    """The time an action took.

    Attributes:
        name: The action with its elements, or the inner action's name.
        start: When it began, since the recording's start [s].
        end: When it ended [s]; the recording's end if it still ran. Where a full disk took its
            result: when the next one began, at the latest.
        outcome: ``reached``, ``grasped``, ``stalled``, ``preempted``, ``cancelled``,
            ``timed_out``, ``aborted``, ``running``, or ``unknown``.
        goal_id: The goal.
        inner: The inner actions of a timed action.
    """

    name: str
    start: float
    end: float
    outcome: str
    goal_id: str
    inner: tuple[Span, ...] = ()


def outcome_of(result: Result) -> str:
    """Return the word that describes best how a goal ended."""
    # Why it ended goes before how far it came: several may be true at once.
    for word in ("aborted", "cancelled", "preempted", "timed_out", "grasped", "reached", "stalled"):
        if getattr(result, word):
            return word
    return "ended"


@dataclass(frozen=True)
class Recording:
    """A recording in memory.

    Attributes:
        paths: The files it was read from, in order.
        hand: The hand's name.
        start: Time of its first message since 1970 [ns].
        end: Time of its last message since 1970 [ns].
        finished: All its files have been closed properly.
        metadata: What was written about it: rate, actuators, session and so on.
        attachments: Attached files by name: URDF, hand.yaml, actions.
        joint_states: All joints, those that follow included.
        actuator_states: The actuators as measured.
        reference: What was sent to the devices.
        goals: Goals that were accepted.
        plans: The plans made for the goals.
        commands: Calls that steered the hand otherwise.
        stream_samples: Samples of streams, as commands.
        feedback: Progress of the goals.
        results: How they ended.
        events: Events, marks among them.
        device_status: Device status, about once a second.
        loop_statistics: Loop statistics, about once a second.
        channels: Further measured channels by name.
        touch: What touch sensors measured, by device.
        object_description: What a simulated device grasped, if it did.
        urdf: The URDF as it was read.
        meshes: Address of a mesh in the URDF to the name of its attachment.
        notes: What is wrong with the files, one sentence each.
        damage: Those notes that say that something is not as it was written.
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
    notes: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()

    @property
    def duration(self) -> float:
        """Time from the first to the last message [s]."""
        return (self.end - self.start) / SECOND

    @property
    def rate(self) -> float:
        """Rate of the loop [Hz]; 0 if it is not known."""
        try:
            return float(self.metadata.get("rate", "0"))
        except ValueError:
            return 0.0

    @property
    def marks(self) -> list[Entry[Event]]:
        """The marks that the user set."""
        return [entry for entry in self.events if entry.value.kind == "mark"]

    @cached_property
    def spans(self) -> list[Span]:
        """The time that every goal took, in order."""
        results = {entry.value.goal_id: entry for entry in self.results}
        feedback: dict[str, list[Entry[Feedback]]] = {}
        for entry in self.feedback:
            feedback.setdefault(entry.value.goal_id, []).append(entry)
        spans = []
        names = {plan.value.goal.goal_id: plan.value.action for plan in self.plans}
        # Where a result is missing: the next goal preempted this one at the latest.
        ends = [(entry.t, "unknown") for entry in self.goals[1:]] + [(self.duration, "running")]
        for goal, (after, left) in zip(self.goals, ends, strict=False):
            action = names.get(goal.value.goal_id, goal.value.action)
            name = " ".join((action, *goal.value.elements))
            ended = results.get(goal.value.goal_id)
            end = ended.t if ended else after
            outcome = outcome_of(ended.value) if ended else left
            given = feedback.get(goal.value.goal_id, [])
            inner = tuple(_inner_spans(given, goal.value.goal_id, end, outcome))
            spans.append(Span(name, goal.t, end, outcome, goal.value.goal_id, inner))
        return spans


def _inner_spans(
    feedback: Sequence[Entry[Feedback]], goal_id: str, end: float, outcome: str
) -> Iterator[Span]:
    """Yield the inner actions of a timed action, as its feedback names them."""
    name, start = "", 0.0
    for entry in feedback:
        if entry.value.inner == name:
            continue
        if name:
            yield Span(name, start, entry.t, "reached", goal_id)
        name, start = entry.value.inner, entry.t
    # Only the last inner action shares the outcome of the whole; the ones before were reached.
    if name:
        yield Span(name, start, end, outcome, goal_id)
