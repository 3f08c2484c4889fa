"""The output of a run: one line per hand at the start, the loop's statistics at the end."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence

from rtee.loop.handloop import HandLoop
from rtee.loop.observer import Observer
from rtee.types import DeviceStatus, Event, Lifecycle, LoopStatistics, Result

log = logging.getLogger(__name__)


class Tally(Observer):
    """Counts how the goals of a hand ended, and its stops.

    Attributes:
        ends: Goals by outcome.
        last: Outcome of the last goal, or an empty string.
        stops: Stops.
    """

    def __init__(self) -> None:
        self.ends: Counter[str] = Counter()
        self.last = ""
        self.stops = 0

    def on_result(self, result: Result) -> None:
        """Count a result."""
        self.last = result.outcome
        self.ends[self.last] += 1

    def on_event(self, event: Event) -> None:
        """Count a stop."""
        self.stops += event.kind == "stop"

    def text(self) -> str:
        """Return the counts in words."""
        goals = self.ends.total()
        parts = [f"{count} {outcome.replace('_', ' ')}" for outcome, count in self.ends.items()]
        return f"{goals} goal{'s' * (goals != 1)}" + (f" ({', '.join(parts)})" if parts else "")


def device_words(status: DeviceStatus) -> str:
    """Return a device's identity and lifecycle in a few words."""
    known = status.identity
    parts = [known.get("model") or status.driver]
    parts += [f"{name} {known[name]}" for name in ("firmware", "serial") if known.get(name)]
    who = f"{status.name}: {', '.join(parts)}"
    if status.lifecycle is Lifecycle.ACTIVE:
        return f"{who}, active"
    return f"{who}, {status.lifecycle}" + (f" ({status.message})" if status.message else "")


def start_line(loop: HandLoop, log: str, network: str) -> str:
    """Return the line printed when a hand starts to run.

    Args:
        loop: The hand.
        log: The recording's path, in words.
        network: The network address, in words.
    """
    hand = loop.hand
    joints, actuators = len(hand.joints), len(hand.actuators)
    devices = "; ".join(device_words(status) for status in loop.statuses())
    return (
        f"{hand.name}: {actuators} actuator{'s' * (actuators != 1)}, {joints} joints,"
        f" {len(loop.library)} actions; {loop.settings.rate:g} Hz; {devices}; log {log};"
        f" network {network}"
    )


def statistics_line(statistics: LoopStatistics, names: Sequence[str]) -> str:
    """Return a clock's statistics in one line."""

    def micro(seconds: float) -> str:
        return f"{seconds * 1e6:.0f}"

    s = statistics
    total = s.ticks + s.missed
    share = f" ({100 * s.missed / total:.3f} %)" if s.missed else ""
    dropped = f"; {s.dropped} log records dropped" if s.dropped else ""
    return (
        f"{', '.join(names)}: {s.ticks} ticks at {s.rate:g} Hz, {s.missed} missed{share};"
        f" lateness p50 {micro(s.lateness_p50)}, p99 {micro(s.lateness_p99)},"
        f" p99.9 {micro(s.lateness_p999)}, max {micro(s.lateness_max)} µs;"
        f" busy p50 {micro(s.busy_p50)}, p99 {micro(s.busy_p99)}, max {micro(s.busy_max)} µs"
        f"{dropped}"
    )


class EventLog(Observer):
    """Writes events to Python's log, so that they appear where the run was started."""

    def on_event(self, event: Event) -> None:
        """Log an event."""
        level = {"warning": logging.WARNING, "error": logging.ERROR}
        log.log(level.get(event.severity, logging.INFO), "%s", event.text)
