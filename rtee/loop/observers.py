"""Tell all observers; one that fails is dropped, the hand goes on."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence

from rtee.commands import CommandRecord
from rtee.loop.observer import LoopObserver, TickRecord
from rtee.loop.plan import Plan
from rtee.types import DeviceStatus, Event, Feedback, Goal, LoopStatistics, Result

log = logging.getLogger(__name__)


class Observers:
    """The observers of one hand, told one after the other."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._all: tuple[LoopObserver, ...] = ()

    def add(self, observer: LoopObserver) -> None:
        """Add one; adding it twice counts once."""
        if observer not in self._all:
            self._all = (*self._all, observer)

    def remove(self, observer: LoopObserver) -> None:
        """Remove one, if it is there."""
        self._all = tuple(other for other in self._all if other is not observer)

    @property
    def dropped(self) -> int:
        """Records that observers had to drop."""
        return sum(int(getattr(observer, "dropped", 0)) for observer in self._all)

    def _failed(self, observer: LoopObserver, error: Exception) -> None:
        self.remove(observer)
        name = type(observer).__name__
        log.error("the observer %s failed and is dropped", name, exc_info=error)
        text = f"the observer {name} failed and is dropped: {error}"
        self.event(Event("observer_failed", name, text, self._now(), "error"))

    def tick(self, record: TickRecord) -> None:
        """Tell a tick."""
        for observer in self._all:
            try:
                observer.on_tick(record)
            except Exception as error:
                self._failed(observer, error)

    def goal(self, goal: Goal, stamp: float) -> None:
        """Tell that a goal begins."""
        for observer in self._all:
            try:
                observer.on_goal(goal, stamp)
            except Exception as error:
                self._failed(observer, error)

    def plan(self, plan: Plan, stamp: float) -> None:
        """Tell what a goal that begins comes to: only those who ask for it by ``on_plan``."""
        for observer in self._all:
            tell = getattr(observer, "on_plan", None)
            if tell is None:
                continue
            try:
                tell(plan, stamp)
            except Exception as error:
                self._failed(observer, error)

    def command(self, record: CommandRecord) -> None:
        """Tell a command."""
        for observer in self._all:
            try:
                observer.on_command(record)
            except Exception as error:
                self._failed(observer, error)

    def feedback(self, feedback: Feedback) -> None:
        """Tell feedback."""
        for observer in self._all:
            try:
                observer.on_feedback(feedback)
            except Exception as error:
                self._failed(observer, error)

    def result(self, result: Result) -> None:
        """Tell a result."""
        for observer in self._all:
            try:
                observer.on_result(result)
            except Exception as error:
                self._failed(observer, error)

    def event(self, event: Event) -> None:
        """Tell an event."""
        for observer in self._all:
            try:
                observer.on_event(event)
            except Exception as error:
                self._failed(observer, error)

    def status(self, statuses: Sequence[DeviceStatus], statistics: LoopStatistics) -> None:
        """Tell how devices and clock are doing."""
        for observer in self._all:
            try:
                observer.on_status(statuses, statistics)
            except Exception as error:
                self._failed(observer, error)
