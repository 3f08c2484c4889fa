"""`rtee gains`: show and set the gains of the devices while the hand runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import ConnectOption, JsonOption, RunningOption
from rtee.cli._online import to_json, with_hand
from rtee.cli._table import Column, Row, TextTable
from rtee.errors import ConfigError, suggestion

if TYPE_CHECKING:
    from rtee.remote.client import RemoteHand
    from rtee.remote.monitoring import HandStatus

_KINDS = ("kp", "ki", "kd")


def gains(
    actuator: Annotated[
        str | None, typer.Argument(help="Only this actuator's gains; all unless given.")
    ] = None,
    kp: Annotated[
        float | None, typer.Option(min=0.0, help="Position gain [N·m/rad | N/m].")
    ] = None,
    ki: Annotated[
        float | None, typer.Option(min=0.0, help="Integral gain [N·m/(rad·s) | N/(m·s)].")
    ] = None,
    kd: Annotated[
        float | None, typer.Option(min=0.0, help="Damping gain [N·m·s/rad | N·s/m].")
    ] = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the gains of a running hand's devices, or set them at once.

    Without an actuator the values are for all. They hold until the hand ends; lasting ones are in
    hand.yaml. A device whose gains are not those of actuators has them in a unit of its own.

    Example: rtee gains index_flexion --kp 2 --kd 0.05
    """
    values = {k: v for k, v in zip(_KINDS, (kp, ki, kd), strict=True) if v is not None}

    async def execute(remote: RemoteHand) -> HandStatus:
        status = await remote.status()
        for device, own in _changes(status, actuator, values).items():
            await remote.set_gains(own, device)
        # Again after a change: what is shown are the gains that the devices report.
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
        _show(by_device)


def _changes(
    status: HandStatus, actuator: str | None, values: Mapping[str, float]
) -> dict[str, dict[str, float]]:
    """Return the gains to set, by device and by name of the gain.

    The values go by kind of gain: ``kp``, ``ki``, ``kd``; without an actuator, they are for all.
    Raises `ConfigError` if no device has such a gain, or none for this actuator.
    """
    gains = [(device.name, gain) for device in status.devices for gain in device.gains]
    if actuator is not None and not any(_of(gain, actuator) for _, gain in gains):
        owners = sorted({gain.partition(".")[2] for _, gain in gains} - {""})
        hint = suggestion(actuator, owners) if owners else "no device has gains by actuator"
        raise ConfigError(f"'{actuator}' has no gains of its own; {hint}")
    changes: dict[str, dict[str, float]] = {}
    for kind, value in values.items():
        chosen = [
            (device, gain)
            for device, gain in gains
            if gain.partition(".")[0] == kind and (actuator is None or _of(gain, actuator))
        ]
        if not chosen:
            names = ", ".join(gain for _, gain in gains) or "none"
            raise ConfigError(f"no device of '{status.hand}' has a gain {kind}; there are {names}")
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


def _show(by_device: Mapping[str, Mapping[str, float]]) -> None:
    rows = [
        Row((device, name, "unknown" if math.isnan(value) else f"{value:.6g}"))
        for device, values in by_device.items()
        for name, value in values.items()
    ]
    TextTable((Column("device"), Column("gain"), Column("value", right=True)), tuple(rows)).show()
