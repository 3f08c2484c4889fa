"""Find drivers by name: built-in ones, entry points, or ``module:Class``."""

from __future__ import annotations

from collections.abc import Mapping

from rtee.drivers.base import Driver
from rtee.drivers.lookup import find_class, known_names

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

DRIVER_GROUP = "rtee.drivers"
"""The entry point group in which other packages offer drivers."""


def driver_names() -> list[str]:
    """Return the names of all built-in and installed drivers, sorted."""
    return known_names(DRIVERS, DRIVER_GROUP)


def find_driver(name: str, *, source: str = "") -> type[Driver]:
    """Return the driver class of a name.

    Args:
        name: A name in `DRIVERS`, an entry point's name, or ``module:Class``.
        source: ``file:line`` of the name, for the message.

    Raises:
        ConfigError: if the name is unknown, or the class cannot be imported or is not a `Driver`.
    """
    where = f"{source}: " if source else ""
    unknown = f"{where}unknown driver '{name}'"
    found: type[Driver] = find_class(name, f"{where}driver", DRIVERS, DRIVER_GROUP, Driver, unknown)
    return found
