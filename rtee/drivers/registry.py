"""Find drivers and emulators by name: built-in ones, entry points, or ``module:Class``."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from rtee.buses.emulator import Emulator
from rtee.drivers.base import Driver
from rtee.errors import ConfigError, suggestion

DRIVERS: Mapping[str, str] = {
    "kinematic": "rtee.drivers.kinematic.driver:KinematicDriver",
    "replay": "rtee.drivers.replay.driver:ReplayDriver",
    "robotiq_2f": "rtee.drivers.robotiq_2f.driver:Robotiq2FDriver",
    "robotiq_3f": "rtee.drivers.robotiq_3f.driver:Robotiq3FDriver",
    "onrobot_3fg": "rtee.drivers.onrobot_3fg.driver:OnRobot3FGDriver",
    "onrobot_rg": "rtee.drivers.onrobot_rg.driver:OnRobotRGDriver",
    "wsg50": "rtee.drivers.wsg50.driver:Wsg50Driver",
    "qb_softhand": "rtee.drivers.qb_softhand.driver:QbSoftHandDriver",
    "schunk_svh": "rtee.drivers.schunk_svh.driver:SchunkSvhDriver",
    "schunk_egu": "rtee.drivers.schunk_egu.driver:SchunkEguDriver",
    "inspire_rh56": "rtee.drivers.inspire_rh56.driver:InspireRh56Driver",
    "ability_hand": "rtee.drivers.ability_hand.driver:AbilityHandDriver",
    "linkerhand": "rtee.drivers.linkerhand.driver:LinkerHandDriver",
    "dynamixel": "rtee.drivers.dynamixel.driver:DynamixelDriver",
    "feetech": "rtee.drivers.feetech.driver:FeetechDriver",
    "cia402": "rtee.drivers.cia402.driver:Cia402Driver",
    "allegro": "rtee.drivers.allegro.driver:AllegroDriver",
    "xbot2": "rtee.drivers.xbot2.driver:XBot2Driver",
    "heri_ethercat": "rtee.drivers.heri_ethercat.driver:HeriEthercatDriver",
    "orca_touch": "rtee.drivers.orca_touch.driver:OrcaTouchDriver",
    "mujoco": "rtee.drivers.mujoco.driver:MujocoDriver",
}
"""Built-in drivers: name to ``module:Class``, imported when first needed."""

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

DRIVER_GROUP = "rtee.drivers"
"""The entry point group in which other packages offer drivers."""

EMULATOR_GROUP = "rtee.emulators"
"""The entry point group in which other packages offer emulators."""


def driver_names() -> list[str]:
    """Return the names of all built-in and installed drivers, sorted."""
    return sorted({*DRIVERS, *_offered(DRIVER_GROUP)})


def emulator_names() -> list[str]:
    """Return the names of all built-in and installed emulators, sorted."""
    return sorted({*EMULATORS, *_offered(EMULATOR_GROUP)})


def find_driver(name: str, *, source: str = "") -> type[Driver]:
    """Return the driver class of a name.

    Args:
        name: A name in `DRIVERS`, an entry point's name, or ``module:Class``.
        source: ``file:line`` of the name, for the message.

    Raises:
        ConfigError: if the name is unknown, or the class cannot be imported or is not a `Driver`.
    """
    where = f"{source}: " if source else ""
    target = _target(name, DRIVERS, DRIVER_GROUP)
    if target is None:
        raise ConfigError(f"{where}unknown driver '{name}'; {suggestion(name, driver_names())}")
    found: type[Driver] = _imported(f"{where}driver '{name}' ({target})", target, Driver)
    return found


def find_emulator(name: str) -> type[Emulator]:
    """Return the emulator class of a driver's name, entry point or ``module:Class``.

    Raises:
        ConfigError: if there is no emulator of that name, or the class cannot be imported or is not
            an `Emulator`.
    """
    target = _target(name, EMULATORS, EMULATOR_GROUP)
    if target is None:
        raise ConfigError(
            f"there is no emulator for '{name}'; {suggestion(name, emulator_names())}"
        )
    emulator: type[Emulator] = _imported(f"emulator '{name}' ({target})", target, Emulator)
    return emulator


def _offered(group: str) -> Mapping[str, str]:
    # Imported only here: it takes 1.5 MB, and most hands have drivers of rtee's.
    from importlib.metadata import entry_points

    return {point.name: point.value for point in entry_points(group=group)}


def _target(name: str, built_in: Mapping[str, str], group: str) -> str | None:
    """Return the ``module:Class`` of a name; built-in names take precedence."""
    return built_in.get(name) or _offered(group).get(name) or (name if ":" in name else None)


def _imported(what: str, target: str, base: type) -> Any:
    module_name, _, class_name = target.partition(":")
    try:
        # Imported when first needed: a hand must not need the packages of other hands' drivers.
        imported = getattr(importlib.import_module(module_name), class_name)
    except Exception as error:  # importing a module of another package may raise anything
        raise ConfigError(f"{what} cannot be imported: {error}") from error
    if not (isinstance(imported, type) and issubclass(imported, base)):
        raise ConfigError(f"{what} is not a subclass of {base.__name__}")
    return imported
