"""Who watches the loop: the recorder and the server, each an observer of every hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from rtee.commands import CommandRecord
from rtee.sample import TickRecord as TickRecord  # what `on_tick` is given
from rtee.types import DeviceStatus, Event, Feedback, Goal, LoopStatistics, Result


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
