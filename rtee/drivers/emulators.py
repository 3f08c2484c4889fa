"""Find the emulator of a driver's device by the driver's name."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any

from rtee.buses.emulator import Emulator, EmulatorFactory
from rtee.drivers.objects import make_with_object
from rtee.errors import ConfigError, suggestion
from rtee.types import DeviceSpec

BUILT_IN: dict[str, str] = {
    "robotiq_2f": "rtee.drivers.robotiq_2f.emulator:Robotiq2FEmulator",
    "robotiq_3f": "rtee.drivers.robotiq_3f.emulator:Robotiq3FEmulator",
    "onrobot_3fg": "rtee.drivers.onrobot_3fg.emulator:OnRobot3FGEmulator",
    "qb_softhand": "rtee.drivers.qb_softhand.emulator:QbSoftHandEmulator",
    "schunk_svh": "rtee.drivers.schunk_svh.emulator:SchunkSvhEmulator",
    "dynamixel": "rtee.drivers.dynamixel.emulator:DynamixelEmulator",
    "cia402": "rtee.drivers.cia402.emulator:Cia402Emulator",
    "allegro": "rtee.drivers.allegro.emulator:AllegroEmulator",
    "xbot2": "rtee.drivers.xbot2.emulator:XBot2Emulator",
    "heri_ethercat": "rtee.drivers.heri_ethercat.emulator:HeriEmulator",
}
"""Driver's name to its emulator as ``module:Class``, imported only when asked for."""

GROUP = "rtee.emulators"
"""The entry point group under which other packages offer emulators."""


def emulator_names() -> list[str]:
    """Return the names of all emulators that can be found, sorted."""
    return sorted({*BUILT_IN, *(point.name for point in entry_points(group=GROUP))})


def find_emulator(name: str) -> type[Emulator]:
    """Return the emulator class of a driver's name, entry point or ``module:Class``.

    Raises:
        ConfigError: if there is none, it cannot be imported, or it is no `Emulator`.
    """
    target = BUILT_IN.get(name)
    if target is None:
        points = {point.name: point.value for point in entry_points(group=GROUP)}
        target = points.get(name, name if ":" in name else None)
    if target is None:
        raise ConfigError(
            f"there is no emulator for '{name}'; {suggestion(name, emulator_names())}"
        )
    module_name, _, class_name = target.partition(":")
    try:
        found = getattr(importlib.import_module(module_name), class_name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"emulator '{name}' ({target}) cannot be imported: {error}") from error
    if not (isinstance(found, type) and issubclass(found, Emulator)):
        raise ConfigError(f"emulator '{name}' ({target}) is not a subclass of Emulator")
    return found


def make_emulator(name: str, options: Mapping[str, Any]) -> Emulator:
    """Return a new emulator made from a driver's options, with an object where they name one.

    Raises:
        ConfigError: if there is none of that name, or it cannot use the options.
    """
    return make_with_object(find_emulator(name), options)


def emulator_of(
    spec: DeviceSpec, kind: type[Emulator] | None = None, /, **options: Any
) -> EmulatorFactory | None:
    """Return what a driver gives to the pool beside its address: ``None`` for a real device.

    Args:
        spec: The device.
        kind: The family's emulator; by default the one registered for ``spec.driver``.
        options: Replace options that the emulator is made from.
    """
    if not spec.emulated:
        return None
    made = kind or find_emulator(spec.driver)
    return lambda: make_with_object(made, {**spec.options, **options})


def owner_of(spec: DeviceSpec) -> str:
    """Return the name under which a device owns its bus; unique among all hands of a process."""
    return f"{spec.hand}/{spec.name}"
