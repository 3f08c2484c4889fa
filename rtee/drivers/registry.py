"""Find a driver by name: those of rtee, entry points ``rtee.drivers``, or ``module:Class``."""

from __future__ import annotations

import importlib
from importlib.metadata import entry_points

from rtee.drivers.base import Driver
from rtee.errors import ConfigError, suggestion

BUILT_IN: dict[str, str] = {
    "kinematic": "rtee.drivers.kinematic.driver:KinematicDriver",
    "replay": "rtee.drivers.replay.driver:ReplayDriver",
    "robotiq_2f": "rtee.drivers.robotiq_2f.driver:Robotiq2FDriver",
    "robotiq_3f": "rtee.drivers.robotiq_3f.driver:Robotiq3FDriver",
    "onrobot_3fg": "rtee.drivers.onrobot_3fg.driver:OnRobot3FGDriver",
    "qb_softhand": "rtee.drivers.qb_softhand.driver:QbSoftHandDriver",
    "schunk_svh": "rtee.drivers.schunk_svh.driver:SchunkSvhDriver",
    "dynamixel": "rtee.drivers.dynamixel.driver:DynamixelDriver",
    "cia402": "rtee.drivers.cia402.driver:Cia402Driver",
    "allegro": "rtee.drivers.allegro.driver:AllegroDriver",
    "xbot2": "rtee.drivers.xbot2.driver:XBot2Driver",
    "heri_ethercat": "rtee.drivers.heri_ethercat.driver:HeriEthercatDriver",
    "mujoco": "rtee.drivers.mujoco.driver:MujocoDriver",
}
"""Name to ``module:Class``, imported only when asked for."""

GROUP = "rtee.drivers"
"""The entry point group under which other packages offer drivers."""


def driver_names() -> list[str]:
    """Return the names of all drivers that can be found, sorted."""
    return sorted({*BUILT_IN, *(point.name for point in entry_points(group=GROUP))})


def find_driver(name: str, *, source: str = "") -> type[Driver]:
    """Return the driver class of that name.

    Args:
        name: A registry name, an entry point's name, or ``module:Class``.
        source: ``file:line`` where the name stands, for the message.

    Raises:
        ConfigError: if there is none, it cannot be imported, or it is no `Driver`.
    """
    where = f"{source}: " if source else ""
    target = BUILT_IN.get(name)
    if target is None:
        points = {point.name: point.value for point in entry_points(group=GROUP)}
        target = points.get(name, name if ":" in name else None)
    if target is None:
        raise ConfigError(f"{where}unknown driver '{name}'; {suggestion(name, driver_names())}")
    module_name, _, class_name = target.partition(":")
    try:
        found = getattr(importlib.import_module(module_name), class_name)
    except Exception as error:  # whatever a module of somebody else's does when it is imported
        raise ConfigError(
            f"{where}driver '{name}' ({target}) cannot be imported: {error}"
        ) from error
    if not (isinstance(found, type) and issubclass(found, Driver)):
        raise ConfigError(f"{where}driver '{name}' ({target}) is not a subclass of Driver")
    return found
