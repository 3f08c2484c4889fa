"""Events, goals and results of hands, as JSON lines on stdout or entries in systemd's journal.

A separate thread writes both, since the reader of a pipe, or the journal, may be slow. Times are in
UTC and, as in recordings and messages, on CLOCK_MONOTONIC.
"""

from __future__ import annotations

import json
import logging
import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial

from rtee import monotonic
from rtee.errors import ConfigError
from rtee.hand.config_schema import Lines
from rtee.loop.observer import Observer
from rtee.remote.call_queue import CallQueue
from rtee.types import Event, Goal, Named, Result

log = logging.getLogger(__name__)

_JOURNAL = "/run/systemd/journal/socket"
"""Socket of the journal; see `systemd.io/JOURNAL_NATIVE_PROTOCOL`."""

_PRIORITIES = {"info": 6, "warning": 4, "error": 3}
"""Syslog priorities by severity."""

Fields = Mapping[str, str | float]


class EventLines(Observer):
    """Writes one hand's events, goals and results.

    Args:
        hand: Name of the hand.
        devices: Names of the hand's devices.
        put: Receives the fields of an entry, and returns at once.
    """

    def __init__(self, hand: str, devices: Collection[str], put: Callable[[Fields], None]) -> None:
        self._hand, self._devices, self._put = hand, devices, put
        self._goal = ""

    def on_goal(self, goal: Goal, stamp: float) -> None:
        """Write that a goal was accepted."""
        self._goal = goal.goal_id
        what = goal.what
        named = (what.action, *what.elements) if isinstance(what, Named) else what.elements
        text = f"{goal.client or 'a client'} begins {' '.join(named)}"
        self._write("goal", goal.client, text, stamp)

    def on_result(self, result: Result) -> None:
        """Write the outcome of a goal."""
        severity = "info" if result.succeeded else "warning"
        text = f"{result.action}: {result.outcome}"
        text += f" ({result.reason})" if result.reason else ""
        self._write("result", "", text, monotonic.now(), severity, result.goal_id)
        self._goal = "" if result.goal_id == self._goal else self._goal

    def on_event(self, event: Event) -> None:
        """Write an event."""
        self._write(event.kind, event.source, event.text, event.stamp, event.severity)

    def _write(
        self,
        kind: str,
        source: str,
        text: str,
        stamp: float,
        severity: str = "info",
        goal: str | None = None,
    ) -> None:
        wall = time.time() - (monotonic.now() - stamp)
        self._put(
            {
                "time": datetime.fromtimestamp(wall, UTC).isoformat(timespec="microseconds"),
                "stamp": stamp,
                "hand": self._hand,
                "kind": kind,
                "severity": severity,
                "goal": self._goal if goal is None else goal,
                "device": source if source in self._devices else "",
                "source": source,
                "text": text,
            }
        )


def line(fields: Fields) -> str:
    """Return an entry as a line of JSON."""
    return json.dumps(fields, ensure_ascii=False)


def entry(fields: Fields) -> bytes:
    """Return an entry in the journal's own protocol."""
    named: dict[str, str | float] = {
        "MESSAGE": f"{fields['hand']}: {fields['text']}",
        "PRIORITY": _PRIORITIES.get(str(fields["severity"]), 5),
        "SYSLOG_IDENTIFIER": "rtee",
        **{f"RTEE_{name.upper()}": value for name, value in fields.items()},
    }
    data = b""
    for name, value in named.items():
        text = str(value).encode()
        # Each value is preceded by its length, as it may have several lines.
        data += name.encode() + b"\n" + len(text).to_bytes(8, "little") + text + b"\n"
    return data


@contextmanager
def event_lines(where: Lines) -> Iterator[Callable[[Fields], None]]:
    """Yield a function that writes entries, for as long as the context lasts.

    Entries wait in a queue for a slow reader. Raises `ConfigError` if there is no journal.
    """
    if where is Lines.STDOUT:

        def write(fields: Fields) -> None:
            print(line(fields), flush=True)  # noqa: T201

        with _queued(write) as put:
            yield put
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
        try:
            journal.connect(_JOURNAL)
        except OSError as error:
            raise ConfigError(f"--events journald: the journal is missing: {error}") from None
        with _queued(lambda fields: journal.send(entry(fields))) as put:
            yield put


@contextmanager
def _queued(write: Callable[[Fields], object]) -> Iterator[Callable[[Fields], None]]:
    calls = CallQueue("events")

    def put(fields: Fields) -> None:
        calls.put(partial(write, fields))

    try:
        yield put
    finally:
        calls.close()
        if calls.dropped:
            log.warning("%d events were not written, because nobody read them", calls.dropped)
