"""Find emulators by name, and make that of a driver's device from the driver's options."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rtee.buses.emulator import Emulator, EmulatorFactory
from rtee.drivers.lookup import find_class, known_names
from rtee.drivers.objects import IDEAL_STATE, WEAR, WORN_STATE, made_by
from rtee.types import DeviceSpec

EMULATORS: Mapping[str, str] = {
    "robotiq_2f": "rtee.drivers.robotiq_2f.emulator:Robotiq2FEmulator",
    "robotiq_3f": "rtee.drivers.robotiq_3f.emulator:Robotiq3FEmulator",
    "onrobot_3fg": "rtee.drivers.onrobot_3fg.emulator:OnRobot3FGEmulator",
    "onrobot_rg": "rtee.drivers.onrobot_rg.emulator:OnRobotRGEmulator",
    "wsg50": "rtee.drivers.wsg50.emulator:Wsg50Emulator",
    "qb_softhand": "rtee.drivers.qb_softhand.emulator:QbSoftHandEmulator",
    "schunk_svh": "rtee.drivers.schunk_svh.emulator:SchunkSvhEmulator",
    "schunk_egu": "rtee.drivers.schunk_egu.emulator:SchunkEguEmulator",
    "inspire_rh56": "rtee.drivers.inspire_rh56.emulator:InspireRh56Emulator",
    "ability_hand": "rtee.drivers.ability_hand.emulator:AbilityHandEmulator",
    "linkerhand": "rtee.drivers.linkerhand.emulator:LinkerHandEmulator",
    "dynamixel": "rtee.drivers.dynamixel.emulator:DynamixelEmulator",
    "feetech": "rtee.drivers.feetech.emulator:FeetechEmulator",
    "cia402": "rtee.drivers.cia402.emulator:Cia402Emulator",
    "allegro": "rtee.drivers.allegro.emulator:AllegroEmulator",
    "xbot2": "rtee.drivers.xbot2.emulator:XBot2Emulator",
    "heri_ethercat": "rtee.drivers.heri_ethercat.emulator:HeriEmulator",
    "orca_touch": "rtee.drivers.orca_touch.emulator:OrcaTouchEmulator",
}
"""Built-in emulators: name of the driver to ``module:Class``."""

EMULATOR_GROUP = "rtee.emulators"
"""The entry point group in which other packages offer emulators."""


def emulator_names() -> list[str]:
    """Return the names of all built-in and installed emulators, sorted."""
    return known_names(EMULATORS, EMULATOR_GROUP)


def find_emulator(name: str) -> type[Emulator]:
    """Return the emulator class of a driver's name, entry point or ``module:Class``.

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
    given = {**spec.options, **options}
    state = WORN_STATE if spec.worn else IDEAL_STATE
    given["emulator"] = {WEAR: state, **(given.get("emulator") or {})}
    return lambda: made_by(emulator, given)
