"""`rtee status`: the loop and the devices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import JsonOption, RunningOption
from rtee.cli._fleet import ConnectOptions, WatchOption, show_fleet
from rtee.cli._online import to_json, with_hand
from rtee.cli._table import Column, Row, TextTable, on_terminal
from rtee.types import Lifecycle

if TYPE_CHECKING:
    from rtee.commands import StreamStatus
    from rtee.remote.monitoring import HandStatus
    from rtee.types import DeviceStatus


def status(
    hand: RunningOption = None,
    connect: ConnectOptions = None,
    every: Annotated[
        bool, typer.Option("--all", help="Show all hands as a table, where only one runs, too.")
    ] = False,
    watch: WatchOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show the status of a hand's loop and its devices; of several hands one line each.

    Example: rtee status --connect tls/router:7447 --watch
    """
    from dataclasses import asdict

    from rtee.remote.find import hands_running

    endpoints = connect or []
    several = len(endpoints) > 1 or (not endpoints and len(hands_running()) > 1)
    if every or watch or (several and hand is None):
        show_fleet(endpoints, [hand] if hand else [], as_json=as_json, watch=watch)
        return
    endpoint = endpoints[0] if endpoints else None
    hand_status = with_hand(hand, endpoint, "status", lambda remote: remote.status())
    if as_json:
        print(to_json(asdict(hand_status)))
    else:
        _show(hand_status)


def _show(hand_status: HandStatus) -> None:
    clock = hand_status.statistics
    # The rate is measured over 1 s, so that a hand that has just started has none.
    measured = f"{clock.measured_rate:.1f} Hz of " if clock.measured_rate else ""
    print(f"{hand_status.hand}: {measured}{clock.rate:g} Hz, ", end="")
    print(f"{clock.ticks} ticks, {clock.missed} missed, {clock.dropped} log records dropped")
    print(f"lateness: {_times(clock.lateness_p50, clock.lateness_p99, clock.lateness_max)}")
    print(f"busy:     {_times(clock.busy_p50, clock.busy_p99, clock.busy_max)}")
    print(f"goal:     {hand_status.action or 'none'}")
    if hand_status.stream.stream:
        print(f"stream:   {_stream(hand_status.stream)}")
    print(f"held by:  {hand_status.holder or 'nobody'}")
    recording = (hand_status.recording, hand_status.recording_trouble)
    print(f"log:      {'; '.join(filter(None, recording)) or 'off'}")
    print(f"profile:  {hand_status.profile}\n")
    _show_devices(hand_status.devices)
    idle = [
        device.name for device in hand_status.devices if device.lifecycle is not Lifecycle.ACTIVE
    ]
    if idle:
        print(
            f"\nnot active: {', '.join(idle)}; bring them back with: "
            f"rtee recover --hand {hand_status.hand}"
        )


def _show_devices(devices: Sequence[DeviceStatus]) -> None:
    rows = []
    for device in devices:
        fault = (
            f"fault {device.fault_code} ({device.fault_name})"
            if device.fault_name
            else device.message
        )
        remarks = "; ".join(text for text in (fault, device.hint) if text)
        rows.append(
            (
                device.name,
                device.driver,
                str(device.lifecycle),
                f"{device.rate:.0f} Hz",
                f"{device.age * 1e3:.1f} ms",
                str(device.errors),
                str(device.overruns),
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
    if not on_terminal():
        TextTable(columns, tuple(Row(cells) for cells in rows)).show()
        return
    # Remarks are sentences; beside seven columns, they would be wrapped at every word.
    TextTable(columns[:-1], tuple(Row(cells[:-1]) for cells in rows)).show()
    for name, *_, remarks in rows:
        if remarks:
            print(f"{name}: {remarks}")


def _stream(stream: StreamStatus) -> str:
    dropped = {
        "duplicate": stream.duplicates,
        "out of order": stream.out_of_order,
        "outlying": stream.outliers,
        "too many": stream.thinned,
        "refused": stream.refused,
    }
    left_out = ", ".join(f"{count} {why}" for why, count in dropped.items() if count)
    text = (
        f"{stream.rate:.1f} Hz, lag {stream.lag * 1e3:.1f} ms, jitter {stream.jitter * 1e3:.1f} ms"
    )
    text += f"; {stream.samples} samples, {stream.late} late, {stream.pauses} pauses"
    return f"{text}; dropped: {left_out}" if left_out else text


def _times(median: float, high: float, worst: float) -> str:
    return f"{median * 1e6:.0f} µs median, {high * 1e6:.0f} µs p99, {worst * 1e6:.0f} µs worst"
