"""Who watches the loop: the recorder and the server, each an observer of every hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtee.commands import CommandRecord
from rtee.types import (
    BoolArray,
    DeviceStatus,
    Event,
    Feedback,
    FloatArray,
    Goal,
    LoopStatistics,
    Result,
)


@dataclass(slots=True)
class TickRecord:
    """What was known at one tick; made once and never changed afterwards.

    All arrays have the hand's order of actuators, shape ``(n,)``; ``NaN`` means not measured.

    Attributes:
        tick: Number of the tick; a missed one leaves a gap.
        stamp: When the tick was due, CLOCK_MONOTONIC [s].
        wall_ns: Wall-clock time of the same moment [ns since 1970]; for log times only.
        position: Measured position [rad | m].
        velocity: Measured velocity [rad/s | m/s].
        effort: Measured effort [N·m | N].
        current: Measured motor current [A].
        temperature: Measured temperature [°C].
        fresh: Whether the measurement is newer than at the tick before, per actuator.
        reference_position: Position handed to the devices, after the limiter [rad | m].
        reference_velocity: Its velocity [rad/s | m/s].
        reference_effort: Effort limit handed to the devices [N·m | N]; ``inf``: the device's own.
        grasped: The devices' own word, ``int8``: 1 holding, 0 not, -1 none given.
        extras: Further measured channels, ``device/channel`` to values.
    """

    tick: int
    stamp: float
    wall_ns: int
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray
    current: FloatArray
    temperature: FloatArray
    fresh: BoolArray
    reference_position: FloatArray
    reference_velocity: FloatArray
    reference_effort: FloatArray
    grasped: NDArray[np.int8]
    extras: Mapping[str, FloatArray]


class LoopObserver(Protocol):
    """Is told everything that happens in one hand's loop.

    An observer may also have ``on_plan(plan, stamp)``: it is called after `on_goal` with what the
    goal comes to, a `rtee.loop.plan.Plan`.

    All methods are called in the loop's thread and must return at once: no I/O, no waiting. An
    observer that raises is dropped with an event; the hand goes on.
    """

    def on_tick(self, record: TickRecord) -> None:
        """Take what was known at a tick; called at every tick."""

    def on_goal(self, goal: Goal, stamp: float) -> None:
        """Take a goal that was accepted, at the tick it takes effect, before its set-points."""

    def on_command(self, record: CommandRecord) -> None:
        """Take a call that steered the controller; goals and commands come in their order."""

    def on_feedback(self, feedback: Feedback) -> None:
        """Take a goal's progress."""

    def on_result(self, result: Result) -> None:
        """Take how a goal ended; follows every accepted goal exactly once."""

    def on_event(self, event: Event) -> None:
        """Take an event."""

    def on_status(self, statuses: Sequence[DeviceStatus], statistics: LoopStatistics) -> None:
        """Take how devices and clock are doing; called about once a second."""


class Observer:
    """An observer that does nothing; derive from it and override what matters."""

    def on_tick(self, record: TickRecord) -> None:
        """Ignore it."""

    def on_goal(self, goal: Goal, stamp: float) -> None:
        """Ignore it."""

    def on_command(self, record: CommandRecord) -> None:
        """Ignore it."""

    def on_feedback(self, feedback: Feedback) -> None:
        """Ignore it."""

    def on_result(self, result: Result) -> None:
        """Ignore it."""

    def on_event(self, event: Event) -> None:
        """Ignore it."""

    def on_status(self, statuses: Sequence[DeviceStatus], statistics: LoopStatistics) -> None:
        """Ignore it."""
