"""Homing on the user's word: the option ``home`` of the drivers that have it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rtee.drivers.registry import find_driver
from rtee.errors import ConfigError
from rtee.types import DeviceSpec


def homing_allowed(hand: str, specs: Sequence[DeviceSpec]) -> tuple[DeviceSpec, ...]:
    """Return the devices of a hand with leave to home when they are first activated.

    A device that is homed already stays where it is; the others move.

    Args:
        hand: The hand's name.
        specs: Its devices.

    Raises:
        ConfigError: if none of them is ever homed.
    """
    found = tuple(
        replace(spec, options={**spec.options, "home": "on_connect"}) if _homes(spec) else spec
        for spec in specs
    )
    if not any(spec is not given for spec, given in zip(found, specs, strict=True)):
        drivers = ", ".join(sorted({spec.driver for spec in specs}))
        hint = "; give --driver devices, too" if drivers == "kinematic" else ""
        raise ConfigError(f"no device of hand '{hand}' needs homing (driver {drivers}){hint}")
    return found


def _homes(spec: DeviceSpec) -> bool:
    options = find_driver(spec.driver, source=spec.source).Options
    return options is not None and "home" in options.model_fields
