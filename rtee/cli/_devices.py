"""What the commands about devices share: the devices of a hand, and how to say yes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from rtee.types import DeviceSpec


def devices_of(name: str, only: str | None, *, emulated: bool = False) -> list[DeviceSpec]:
    """Return the devices of a hand, or one of them.

    Raises:
        UserError: if there is no such hand or device.
    """
    from rtee.errors import ConfigError, suggestion
    from rtee.run import RunOptions, prepare

    prepared = prepare(name, RunOptions(driver="devices", emulated=emulated))
    specs = [device.spec for device in prepared.devices]
    if only is None:
        return specs
    found = [spec for spec in specs if spec.name == only]
    if not found:
        names = [spec.name for spec in specs]
        raise ConfigError(f"hand '{name}' has no device '{only}'; {suggestion(only, names)}")
    return found


def folder_of(name: str) -> Path:
    """Return a hand's folder."""
    from rtee.hand.load import hand_folder

    return hand_folder(name)[0]


def with_options(spec: DeviceSpec, **options: Any) -> DeviceSpec:
    """Return a device with some of its options replaced; ``None`` takes one away."""
    merged = {**spec.options, **options}
    return replace(spec, options={k: v for k, v in merged.items() if v is not None})
