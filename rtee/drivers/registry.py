"""Find drivers by name: built-in ones, entry points, or ``module:Class``."""

from __future__ import annotations

from rtee.drivers.base import Driver
from rtee.drivers.lookup import DRIVERS, find_class, known_names

DRIVER_GROUP = "rtee.drivers"
"""The entry point group in which other packages offer drivers."""


def driver_names() -> list[str]:
    """Return the names of all built-in and installed drivers, sorted."""
    return known_names(DRIVERS, DRIVER_GROUP)


def find_driver(name: str, *, source: str = "") -> type[Driver]:
    """Return the driver class with a given name.

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
