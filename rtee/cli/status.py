"""`rtee status`: the loop and the devices."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtee.cli._common import ConnectOption, JsonOption, RunningOption
from rtee.cli._online import to_json, with_hand
from rtee.cli._table import Column, Row, Table, on_terminal

if TYPE_CHECKING:
    from rtee.commands import StreamStatus
    from rtee.remote.monitoring import HandStatus


def status(
    hand: RunningOption = None, connect: ConnectOption = None, as_json: JsonOption = False
) -> None:
    """Show the status of a hand's loop and its devices."""
    from dataclasses import asdict

    found = with_hand(hand, connect, "status", lambda remote: remote.status())
    if as_json:
        print(to_json(asdict(found)))
    else:
        _show(found)


def _show(found: HandStatus) -> None:
    clock = found.statistics
    # The rate is measured over 1 s, so that a hand that has just started has none.
    measured = f"{clock.measured_rate:.1f} Hz of " if clock.measured_rate else ""
    print(f"{found.hand}: {measured}{clock.rate:g} Hz, ", end="")
    print(f"{clock.ticks} ticks, {clock.missed} missed, {clock.dropped} log records dropped")
    print(f"lateness: {_times(clock.lateness_p50, clock.lateness_p99, clock.lateness_max)}")
    print(f"busy:     {_times(clock.busy_p50, clock.busy_p99, clock.busy_max)}")
    print(f"goal:     {found.action or 'none'}")
    if found.stream.stream:
        print(f"stream:   {_stream(found.stream)}")
    print(f"held by:  {found.holder or 'nobody'}")
    recording = (found.recording, found.recording_trouble)
    print(f"log:      {'; '.join(filter(None, recording)) or 'off'}")
    print(f"profile:  {found.profile}")
    rows = []
    for one in found.devices:
        fault = f"fault {one.fault_code} ({one.fault_name})" if one.fault_name else one.message
        remarks = "; ".join(text for text in (fault, one.hint) if text)
        rows.append(
            (
                one.name,
                one.driver,
                str(one.lifecycle),
                f"{one.rate:.0f} Hz",
                f"{one.age * 1e3:.1f} ms",
                str(one.errors),
                str(one.overruns),
                remarks,
            )
        )
    columns = (
        Column("device", whole=True),
        Column("driver"),
        Column("state", whole=True),
        *(Column(name, right=True, whole=True) for name in ("rate", "age", "errors", "overruns")),
        Column("remarks"),
    )
    print()
    if not on_terminal():
        Table(columns, tuple(Row(cells) for cells in rows)).show()
        return
    # Remarks are sentences; beside seven columns, they would be wrapped at every word.
    Table(columns[:-1], tuple(Row(cells[:-1]) for cells in rows)).show()
    for name, *_, remarks in rows:
        if remarks:
            print(f"{name}: {remarks}")


def _stream(found: StreamStatus) -> str:
    dropped = {
        "duplicate": found.duplicates,
        "out of order": found.out_of_order,
        "outlying": found.outliers,
        "too many": found.thinned,
        "refused": found.refused,
    }
    left_out = ", ".join(f"{count} {why}" for why, count in dropped.items() if count)
    text = f"{found.rate:.1f} Hz, lag {found.lag * 1e3:.1f} ms, jitter {found.jitter * 1e3:.1f} ms"
    text += f"; {found.samples} samples, {found.late} late, {found.pauses} pauses"
    return f"{text}; dropped: {left_out}" if left_out else text


def _times(median: float, high: float, worst: float) -> str:
    return f"{median * 1e6:.0f} µs median, {high * 1e6:.0f} µs p99, {worst * 1e6:.0f} µs worst"
