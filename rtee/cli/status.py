"""`rtee status`: the loop and the devices."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import typer

from rtee.cli._common import ConnectOption, JsonOption, RunningOption, to_json, with_hand
from rtee.cli._fleet import ConnectOptions, WatchOption, show_fleet
from rtee.cli._table import Column, on_terminal, table_of
from rtee.errors import ConfigError, suggestion

if TYPE_CHECKING:
    from rtee.commands import StreamStatus
    from rtee.remote.client import RemoteHand
    from rtee.remote.hand_info import HandInfo
    from rtee.remote.monitoring import HandStatus
    from rtee.types import DeviceStatus


def status(
    *,
    hand: RunningOption = None,
    connect: ConnectOptions = None,
    every: bool = False,
    watch: WatchOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show the status of a hand's loop and its devices; of several hands one line each.

    Example: rtee status --connect tls/router:7447 --watch

    Arguments and options:
        every (--all): Show all hands as a table, even if only one runs.
    """
    from rtee.remote.directory import hands_running

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
    if idle := hand_status.inactive:
        print(
            f"\nnot active: {', '.join(device.name for device in idle)}; bring them back with: "
            f"rtee recover --hand {hand_status.hand}"
        )


def _show_devices(devices: Sequence[DeviceStatus]) -> None:
    rows = [
        (
            device.name,
            device.driver,
            str(device.lifecycle),
            f"{device.rate:.0f} Hz",
            f"{device.age * 1e3:.1f} ms",
            str(device.errors),
            str(device.overruns),
            device.remarks,
        )
        for device in devices
    ]
    columns: tuple[str | Column, ...] = (
        Column("device", whole=True),
        "driver",
        Column("state", whole=True),
        *(Column(name, right=True, whole=True) for name in ("rate", "age", "errors", "overruns")),
        "remarks",
    )
    if not on_terminal():
        table_of(columns, rows).show()
        return
    # Remarks are sentences; beside seven columns, they would be wrapped at every word.
    table_of(columns[:-1], (cells[:-1] for cells in rows)).show()
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


_KINDS = ("kp", "ki", "kd")


def gains(
    actuator: str | None = None,
    *,
    kp: float | None = None,
    ki: float | None = None,
    kd: float | None = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the gains of a running hand's devices, or set them at once.

    Without an actuator the values apply to all. They last until the hand ends; put permanent ones
    in hand.yaml. Gains of a whole device are in the device's own unit.

    Example: rtee gains index_flexion --kp 2 --kd 0.05

    Arguments and options:
        actuator: Only this actuator's gains; all unless given.
        kp (0.0..): Position gain [N·m/rad | N/m].
        ki (0.0..): Integral gain [N·m/(rad·s) | N/(m·s)].
        kd (0.0..): Damping gain [N·m·s/rad | N·s/m].
    """
    values = {k: v for k, v in zip(_KINDS, (kp, ki, kd), strict=True) if v is not None}

    async def execute(remote: RemoteHand) -> HandStatus:
        status = await remote.status()
        for device, own in _changes(status, actuator, values).items():
            await remote.set_gains(own, device)
        # Read again after a change, to show the gains that the devices report.
        return await remote.status() if values else status

    status = with_hand(hand, connect, "gains", execute)
    by_device = {
        device.name: known
        for device in status.devices
        if (known := _shown(device.gains, device.gain_values, actuator))
    }
    if as_json:
        print(to_json({"hand": status.hand, "devices": by_device}))
    elif not by_device:
        print(f"{status.hand}: no device has gains that can be set while it runs")
    else:
        _show_gains(by_device)


def _changes(
    status: HandStatus, actuator: str | None, values: Mapping[str, float]
) -> dict[str, dict[str, float]]:
    """Return the gains to set, by device and by name of the gain.

    Values are keyed by gain (``kp``, ``ki``, ``kd``); without an actuator, they apply to all.
    Raises `ConfigError` if no device has such a gain, or none for this actuator.
    """
    gains = [(device.name, gain) for device in status.devices for gain in device.gains]
    if actuator is not None and not any(_of(gain, actuator) for _, gain in gains):
        owners = sorted({gain.partition(".")[2] for _, gain in gains} - {""})
        hint = suggestion(actuator, owners) if owners else "no device has gains by actuator"
        raise ConfigError(f"'{actuator}' has no gains; {hint}")
    changes: dict[str, dict[str, float]] = {}
    for kind, value in values.items():
        chosen = [
            (device, gain)
            for device, gain in gains
            if gain.partition(".")[0] == kind and (actuator is None or _of(gain, actuator))
        ]
        if not chosen:
            names = ", ".join(gain for _, gain in gains) or "none"
            raise ConfigError(f"no device of '{status.hand}' has a gain {kind}; valid: {names}")
        for device, gain in chosen:
            changes.setdefault(device, {})[gain] = value
    return changes


def _of(gain: str, actuator: str) -> bool:
    return gain.partition(".")[2] == actuator


def _shown(names: Sequence[str], values: Sequence[float], actuator: str | None) -> dict[str, float]:
    """Return a device's gains by name; NaN where the device does not report them."""
    # A device that does not report its gains lists their names, but no values.
    known = dict(zip(names, values, strict=False))
    return {
        name: known.get(name, math.nan) for name in names if actuator is None or _of(name, actuator)
    }


def _show_gains(by_device: Mapping[str, Mapping[str, float]]) -> None:
    rows = [
        (device, name, "unknown" if math.isnan(value) else f"{value:.6g}")
        for device, values in by_device.items()
        for name, value in values.items()
    ]
    table_of(("device", "gain", Column("value", right=True)), rows).show()


def info(
    *,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    at: list[str] | None = None,
    as_json: JsonOption = False,
) -> None:
    """Describe a running hand: limits and stiffness of actuators, tips with their friction.

    With --json also tip poses, Jacobians, the transmission and the URDF.

    Arguments and options:
        at (ACTUATOR=POSITION): Posture for the poses and Jacobians [rad | m]; may be repeated;
            otherwise at rest.
    """
    posture = dict(map(_position, at or ()))
    description = with_hand(hand, connect, "info", lambda remote: remote.info(posture))
    if as_json:
        print(to_json(dataclasses.asdict(description)))
    else:
        _show_info(description)


def _position(text: str) -> tuple[str, float]:
    name, equals, value = text.rpartition("=")
    try:
        position = float(value)
    except ValueError:
        position = math.nan
    if not equals or not name or not math.isfinite(position):
        raise typer.BadParameter(f"write ACTUATOR=POSITION, such as joint_1=0.5, not '{text}'")
    return name, position


def _show_info(description: HandInfo) -> None:
    actuators, joints = len(description.actuators), len(description.joints)
    counts = f"{actuators} actuator{'s' * (actuators != 1)}, {joints} joint{'s' * (joints != 1)}"
    print(f"{description.name}: {counts}; base frame {description.base}\n")
    columns = ("actuator", "kind", "lower", "upper", "velocity", "effort", "stiffness", "fingers")
    numbers = columns[2:7]
    rows = [
        (
            each.name,
            str(each.kind),
            *(_number(getattr(each, name)) for name in numbers),
            ", ".join(each.fingers),
        )
        for each in description.actuators
    ]
    table_of((Column(name, right=name in numbers) for name in columns), rows).show()
    print("rad, rad/s, N·m, N·m/rad; prismatic ones: m, m/s, N, N/m\n")
    tips = [
        (
            each.name,
            each.tip or "-",
            _number(each.friction),
            ""
            if each.tip_pose is None
            else ", ".join(f"{1e3 * value:.1f}" for value in each.tip_pose[:3, 3]),
            ", ".join(each.actuators),
        )
        for each in description.fingers
    ]
    heads = ("finger", "tip", Column("friction", right=True), "tip at [mm]", "moved by")
    table_of(heads, tips).show()
    for sentence in description.missing:
        print(f"note: {sentence}")


def _number(value: float) -> str:
    return "unknown" if math.isnan(value) else f"{value:.4g}"
