"""Find emulators by name, and make the one for a device from its driver's options."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rtee.buses.emulator import Emulator, EmulatorFactory
from rtee.drivers.lookup import DRIVERS, find_class, known_names
from rtee.drivers.objects import IDEAL_STATE, WEAR, WORN_STATE, made_by
from rtee.types import DeviceSpec

_OF_NONE = ("kinematic", "replay", "mujoco")  # drivers without a device on a wire
EMULATORS: Mapping[str, str] = {
    name: place.replace(".driver:", ".emulator:").removesuffix("Driver") + "Emulator"
    for name, place in DRIVERS.items()
    if name not in _OF_NONE
}
"""Built-in emulators, each beside its driver: name of the driver to ``module:Class``."""

EMULATOR_GROUP = "rtee.emulators"
"""The entry point group in which other packages offer emulators."""


def emulator_names() -> list[str]:
    """Return the names of all built-in and installed emulators, sorted."""
    return known_names(EMULATORS, EMULATOR_GROUP)


def find_emulator(name: str) -> type[Emulator]:
    """Return the emulator class for a driver's name, an entry point or ``module:Class``.

    Raises:
        ConfigError: if there is no emulator of that name, or the class cannot be imported or is not
            an `Emulator`.
    """
    unknown = f"there is no emulator for '{name}'"
    found: type[Emulator] = find_class(
        name, "emulator", EMULATORS, EMULATOR_GROUP, Emulator, unknown
    )
    return found


def make_emulator(name: str, options: Mapping[str, Any]) -> Emulator:
    """Return a new emulator made from a driver's options, with the object and wear they give.

    Raises:
        ConfigError: if there is no emulator of that name, or the options do not suit it.
    """
    return made_by(find_emulator(name), options)


def emulator_of(
    spec: DeviceSpec, kind: str | type[Emulator] | None = None, /, **options: Any
) -> EmulatorFactory | None:
    """Return the factory that a driver passes to the pool's methods: ``None`` for a real device.

    A driver names its emulator instead of importing it, so that a real device does not load the
    emulator's module.

    Args:
        spec: The device.
        kind: The emulator or its name in the registry; by default the name is ``spec.driver``.
        options: Options that replace those of the device.

    Raises:
        ConfigError: if there is no such emulator.
    """
    if not spec.emulated:
        return None
    emulator = kind if isinstance(kind, type) else find_emulator(kind or spec.driver)
    given = {**spec.options, **options}
    state = WORN_STATE if spec.worn else IDEAL_STATE
    given["emulator"] = {WEAR: state, **(given.get("emulator") or {})}
    return lambda: made_by(emulator, given)
