"""Make the emulator of a driver's device from the driver's options."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rtee.buses.emulator import Emulator, EmulatorFactory
from rtee.drivers.objects import make_with_object
from rtee.drivers.registry import find_emulator
from rtee.types import DeviceSpec


def make_emulator(name: str, options: Mapping[str, Any]) -> Emulator:
    """Return a new emulator made from a driver's options, with an object if they give one.

    Raises:
        ConfigError: if there is no emulator of that name, or the options do not suit it.
    """
    return make_with_object(find_emulator(name), options)


def emulator_of(
    spec: DeviceSpec, kind: str | type[Emulator] | None = None, /, **options: Any
) -> EmulatorFactory | None:
    """Return the factory that a driver passes to the pool's methods: ``None`` for a real device.

    A driver names its emulator instead of importing it, so that a real device does without the
    emulator's module.

    Args:
        spec: The device.
        kind: The emulator or its name in the registry; by default the one named as ``spec.driver``.
        options: Options that replace those of the device.

    Raises:
        ConfigError: if there is no such emulator.
    """
    if not spec.emulated:
        return None
    emulator = kind if isinstance(kind, type) else find_emulator(kind or spec.driver)
    return lambda: make_with_object(emulator, {**spec.options, **options})
