"""Observers of the loop: the recorder and the server, for example, each observe every hand."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from rtee import monotonic
from rtee.commands import CommandRecord
from rtee.loop.plan import Plan
from rtee.objects.description import ObjectDescription
from rtee.sample import TickRecord
from rtee.types import DeviceStatus, Event, Feedback, Goal, LoopStatistics, Result

log = logging.getLogger(__name__)


class Observer:
    """Receives everything that happens in one hand's loop.

    Subclass it and override the methods you need; the others do nothing. All are called in the
    loop's thread and must return at once: no I/O, no waiting. An observer that raises is removed,
    with an event; the hand goes on.
    """

    def on_tick(self, record: TickRecord) -> None:
        """Receive the record of a tick; called at every tick."""

    def on_goal(self, goal: Goal, stamp: float) -> None:
        """Receive an accepted goal, at the tick at which it begins, before its first reference."""

    def on_plan(self, plan: Plan, stamp: float) -> None:
        """Receive the plan of an accepted goal, after the goal."""

    def on_object(self, obj: ObjectDescription, stamp: float) -> None:
        """Receive the object that a simulated device grasps; called once for each object."""

    def on_command(self, record: CommandRecord) -> None:
        """Receive a command to the controller; goals and commands arrive in their order."""

    def on_feedback(self, feedback: Feedback) -> None:
        """Receive a goal's progress."""

    def on_result(self, result: Result) -> None:
        """Receive the result of a goal; called exactly once for every accepted goal."""

    def on_event(self, event: Event) -> None:
        """Receive an event."""

    def on_status(self, statuses: Sequence[DeviceStatus], statistics: LoopStatistics) -> None:
        """Receive the status of the devices and the clock; called about once a second."""


class Observers:
    """The observers of one hand. An observer that fails is removed, with an event."""

    def __init__(self, now: Callable[[], float] = monotonic.asked) -> None:
        self._now = now
        self._all: tuple[Observer, ...] = ()
        self._object: ObjectDescription | None = None

    def add(self, observer: Observer) -> None:
        """Add an observer, unless it was added before."""
        if observer not in self._all:
            # A new tuple: an observer may remove itself while the old tuple is iterated over.
            self._all = (*self._all, observer)

    def remove(self, observer: Observer) -> None:
        """Remove an observer, if it is there."""
        self._all = tuple(other for other in self._all if other is not observer)

    @property
    def dropped(self) -> int:
        """Number of records that observers had to drop."""
        return sum(int(getattr(observer, "dropped", 0)) for observer in self._all)

    def each(self, call: Callable[[Observer], None]) -> None:
        """Call a method of every observer."""
        for observer in self._all:
            try:
                call(observer)
            except Exception as error:
                self._failed(observer, error)

    def _failed(self, observer: Observer, error: Exception) -> None:
        # Before the event, which would otherwise reach the observer and fail again, without end.
        self.remove(observer)
        name = type(observer).__name__
        log.error("the observer %s failed and is dropped", name, exc_info=error)
        text = f"the observer {name} failed and is dropped: {error}"
        self.event(Event("observer_failed", name, text, self._now(), "error"))

    def tick(self, record: TickRecord) -> None:
        """Report the record of a tick."""
        for observer in self._all:
            try:
                observer.on_tick(record)
            except Exception as error:
                self._failed(observer, error)

    def goal(self, goal: Goal, plan: Plan, stamp: float) -> None:
        """Report a goal that begins, and its plan."""
        self.each(lambda observer: observer.on_goal(goal, stamp))
        self.each(lambda observer: observer.on_plan(plan, stamp))

    def describe_object(self, obj: ObjectDescription | None, stamp: float) -> None:
        """Report a new simulated object."""
        if obj is not self._object and obj is not None:
            self._object = obj
            self.each(lambda observer: observer.on_object(obj, stamp))

    def command(self, record: CommandRecord) -> None:
        """Report a command."""
        self.each(lambda observer: observer.on_command(record))

    def feedback(self, feedback: Feedback) -> None:
        """Report feedback."""
        self.each(lambda observer: observer.on_feedback(feedback))

    def result(self, result: Result) -> None:
        """Report a result."""
        self.each(lambda observer: observer.on_result(result))

    def event(self, event: Event) -> None:
        """Report an event."""
        self.each(lambda observer: observer.on_event(event))
