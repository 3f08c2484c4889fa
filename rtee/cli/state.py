"""`rtee state`: show the hand's state, once or live."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rtee import monotonic
from rtee.cli._common import ConnectOption, RunningOption, to_json, with_hand
from rtee.cli._table import Column, Row, TextTable, on_terminal, prefix_to_drop, table_of
from rtee.sample import COLUMNS, MEASURED

if TYPE_CHECKING:
    from rtee.messages.state import State
    from rtee.remote.client import RemoteHand
    from rtee.touch import TouchState

Touch = Mapping[str, "TouchState"]

_DIGITS = 2
"""Decimals of touch: sensors measure no better than 0.01 N."""

_KEPT = 1000
"""Most states that wait for a slow terminal or pipe: 1 s at 1 kHz. Older ones are dropped."""

_TOUCH_EVERY = 0.02
"""Least time between two requests for touch [s]: half of the 100 per second that a hand answers."""

_COLUMNS = {name: COLUMNS[name] for name in (*MEASURED, "reference_position")}
"""The quantities shown, by attribute of a state."""


def state(
    *,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    once: bool = False,
    follow: bool = False,
    rate: float = 10.0,
    as_json: bool = False,
) -> None:
    """Show the hand's state: on a terminal live until Ctrl-C; elsewhere once, unless --follow.

    Example: rtee state --json --follow --rate 50 > states.jsonl

    Arguments and options:
        once: Show it once, even on a terminal.
        follow (--follow; -f): Without --once: keep going, even if the output is not a terminal.
        rate (0.1..): States per second that are shown or printed.
        as_json (--json): Print JSON, one object per line and state.
    """

    async def execute(remote: RemoteHand) -> None:
        # In a script, the command has to end by itself.
        if once or not (follow or on_terminal()):
            _print(remote.name, await remote.state(), await remote.touch_state(), as_json)
        elif as_json or not on_terminal():
            touch = _TouchPoll(remote)
            async for newest in remote.states(rate, keep=_KEPT):
                _print(remote.name, newest, await touch.newest(), as_json)
        else:
            await _live(remote, rate)

    with_hand(hand, connect, "state", execute)


class _TouchPoll:
    """Requests the values of the touch sensors no more often than the hand answers requests."""

    def __init__(self, remote: RemoteHand) -> None:
        self._remote, self._due = remote, -math.inf
        self._known: Touch = {}

    async def newest(self) -> Touch:
        """Return values that are at most `_TOUCH_EVERY` old."""
        if monotonic.now() >= self._due:
            self._known = await self._remote.touch_state()
            self._due = monotonic.now() + _TOUCH_EVERY
        return self._known


async def _live(remote: RemoteHand, rate: float) -> None:
    from rich.console import Console, Group
    from rich.live import Live

    # Drawn only at a new state, instead of by a timer.
    poll = _TouchPoll(remote)
    with Live(console=Console(), auto_refresh=False) as live:
        async for newest in remote.states(rate):
            tables = [_table(remote.name, newest)]
            if touch := await poll.newest():
                tables.append(_touch_table(touch, newest.stamp))
            live.update(Group(*(t.drawn(live.console.width) for t in tables)), refresh=True)


def _print(name: str, newest: State, touch: Touch, as_json: bool) -> None:
    if as_json:
        print(to_json(_plain(name, newest, touch)), flush=True)
        return
    _table(name, newest).show()
    if touch:
        _touch_table(touch, newest.stamp).show()


def _touch_table(touch: Touch, now: float) -> TextTable:
    """Return a table of the touch sensors: sum, largest taxel and age of the values."""
    names = ("touch sensor", "finger", "sum", "largest", "unit", "age [ms]")
    numbers = ("sum", "largest", "age [ms]")
    columns = [Column(name, right=name in numbers, whole=True) for name in names]
    rows = []
    for state in touch.values():
        age = "stale" if state.stale else f"{max(0.0, 1e3 * (now - state.stamp)):.0f}"
        for sensor, total in zip(state.sensors, state.totals.tolist(), strict=True):
            largest = float(state.of(sensor.name).max())
            forces = (_number(total, _DIGITS), _number(largest, _DIGITS))
            cells = (sensor.name, sensor.finger or "–", *forces, sensor.unit, age)
            rows.append(Row(cells, faint=state.stale))
    return table_of(columns, rows)


def _plain_touch(touch: Touch) -> dict[str, Any]:
    return {
        sensor.name: {
            "device": state.device,
            "link": sensor.link,
            "finger": sensor.finger,
            "unit": sensor.unit,
            "total": total,
            "values": state.of(sensor.name),
            "time": state.stamp,
            "stale": state.stale,
        }
        for state in touch.values()
        for sensor, total in zip(state.sensors, state.totals.tolist(), strict=True)
    }


def _plain(name: str, newest: State, touch: Touch) -> dict[str, Any]:
    columns = (*_COLUMNS, "reference_velocity", "reference_effort", "fresh")
    return {
        "hand": name,
        "tick": newest.tick,
        "time": newest.stamp,
        "actuators": {
            actuator: {column: getattr(newest, column)[i] for column in columns}
            for i, actuator in enumerate(newest.names)
        },
        "opening": newest.opening,
        "force": newest.force,
        "force_error": newest.force_error,
        "force_source": newest.force_source,
        "joints": newest.joints,
        "touch": _plain_touch(touch),
        "channels": newest.channels,
    }


def _table(name: str, newest: State) -> TextTable:
    prefix = prefix_to_drop(newest.names)
    title = f"{name}, tick {newest.tick}"
    if prefix:
        title += f" (names of actuators begin with {prefix})"
    if newest.opening is not None:
        title += f"; opening {1e3 * newest.opening:.1f} mm"
    if newest.force is not None:
        title += f", force {newest.force:.1f} ± {newest.force_error or 0.0:.1f} N"
        title += f" by the {newest.force_source}"
    # Quantities that no actuator measures are left out.
    measured = [c for c in _COLUMNS if not all(map(math.isnan, getattr(newest, c).tolist()))]
    columns = [Column("actuator", whole=True)]
    columns += [Column(_COLUMNS[c].heading or c, right=True, whole=True) for c in measured]
    rows = []
    for i, actuator in enumerate(newest.names):
        values = [_number(float(getattr(newest, c)[i]), _COLUMNS[c].digits) for c in measured]
        rows.append((actuator.removeprefix(prefix), *values))
    return table_of(columns, rows, title)


def _number(value: float, digits: int) -> str:
    # Adding 0.0 turns -0, to which small negative numbers are rounded, into 0.
    return "–" if math.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}"
