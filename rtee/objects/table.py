"""The table under an object, as users write it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from rtee.errors import ConfigError

GRAVITY: Final = "gravity"
"""How a table is written that is across the weight."""

TABLE: Final = f"X,Y,Z or X,Y,Z,HEIGHT [m], its upward normal in the object's frame, or '{GRAVITY}'"
"""How a table is written."""


@dataclass(frozen=True, slots=True)
class Table:
    """The table under an object, in the object's frame.

    Attributes:
        up: Its upward normal ``(3,)``; against the weight unless given.
        height: How far along it the top is from the object's origin [m]; where the object's lowest
            point is unless given.

    Raises:
        ConfigError: if a number is not finite, or the normal is 0.
    """

    up: tuple[float, float, float] | None = None
    height: float | None = None

    def __post_init__(self) -> None:
        up, height = self.up or (0.0, 0.0, 1.0), self.height or 0.0
        if len(up) != 3 or not all(map(math.isfinite, (*up, height))) or not any(up):
            raise ConfigError("a table's normal is three finite numbers, not all of them 0")


def parse_table(text: str) -> Table:
    """Read a table: ``gravity``, ``X,Y,Z`` (its upward normal) or ``X,Y,Z,HEIGHT`` [m].

    Raises:
        ConfigError: if it is none of these.
    """
    if text == GRAVITY:
        return Table()
    try:
        x, y, z, *height = (float(part) for part in text.split(","))
    except ValueError:
        x, height = math.nan, [0.0, 0.0]
    if len(height) > 1:
        raise ConfigError(f"a table is {TABLE}, not '{text}'")
    return Table((x, y, z), height[0] if height else None)
