"""Find classes by name: built-in ones, entry points of other packages, or ``module:Class``."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

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


def known_names(built_in: Mapping[str, str], group: str) -> list[str]:
    """Return the names of all built-in classes and those in an entry point group, sorted."""
    return sorted({*built_in, *_offered(group)})


def find_class(
    name: str, what: str, built_in: Mapping[str, str], group: str, base: type, unknown: str
) -> Any:
    """Return the class with a given name.

    Args:
        name: A built-in name, an entry point's name, or ``module:Class``.
        what: The kind of class, for the message, such as ``driver``.
        built_in: The built-in ones, ``module:Class`` by name; they take precedence.
        group: The entry point group of the others.
        base: The class that it must be derived from.
        unknown: The message for an unknown name, to which a suggestion is added.

    Raises:
        ConfigError: if the name is unknown, or the class cannot be imported or is not a ``base``.
    """
    target = built_in.get(name) or _offered(group).get(name) or (name if ":" in name else None)
    if target is None:
        hint = suggestion(name, known_names(built_in, group))
        raise ConfigError(f"{unknown}; {hint}")
    module_name, _, class_name = target.partition(":")
    try:
        # Imported when first needed: a hand must not need the packages of other hands' drivers.
        imported = getattr(importlib.import_module(module_name), class_name)
    except Exception as error:  # importing a module of another package may raise anything
        raise ConfigError(f"{what} '{name}' ({target}) cannot be imported: {error}") from error
    if not (isinstance(imported, type) and issubclass(imported, base)):
        raise ConfigError(f"{what} '{name}' ({target}) is not a subclass of {base.__name__}")
    return imported


def _offered(group: str) -> Mapping[str, str]:
    # Imported only here: it takes 1.5 MB, and most hands need only built-in drivers.
    from importlib.metadata import entry_points

    return {point.name: point.value for point in entry_points(group=group)}
