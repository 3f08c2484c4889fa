"""Quantities as people write them: ``30mm``, ``3cm``, ``0.03``, ``10N``, ``50mm/s``, ``60%``."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Final

from rtee.errors import GoalRejected, suggestion
from rtee.values import number

LENGTH: Final[Mapping[str, float]] = MappingProxyType(
    {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "in": 0.0254}
)
"""Units of length, in metres."""

FORCE: Final[Mapping[str, float]] = MappingProxyType({"N": 1.0, "kN": 1e3, "mN": 1e-3})
"""Units of force, in newtons."""

SPEED: Final[Mapping[str, float]] = MappingProxyType(
    {f"{unit}/s": size for unit, size in LENGTH.items()}
)
"""Units of speed, in m/s."""

TIME: Final[Mapping[str, float]] = MappingProxyType({"s": 1.0, "ms": 1e-3, "min": 60.0})
"""Units of time, in seconds."""

SHARE: Final[Mapping[str, float]] = MappingProxyType({"%": 0.01})
"""Units of a share, where the whole is 1."""

# By identity, since mappings have no hash.
_KINDS: Final = {
    id(LENGTH): "a length, such as 30mm",
    id(FORCE): "a force, such as 10N",
    id(SPEED): "a speed, such as 50mm/s",
    id(TIME): "a number of seconds, such as 5s",
    id(SHARE): "a share, such as 60% or 0.6",
}

_LONGEST: Final = 1.0
"""Longest plausible length without a unit [m]: a larger number is probably in millimetres."""

_QUANTITY: Final = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S*)\s*")


def quantity(value: str | float, units: Mapping[str, float], name: str) -> float:
    """Return a quantity in its SI unit.

    Args:
        value: A number in the SI unit, or a text with or without a unit.
        units: Its units: `LENGTH`, `FORCE`, `SPEED`, `TIME` or `SHARE`.
        name: Name of the quantity, for the message.

    Raises:
        GoalRejected: if the value is not such a quantity, not finite, or negative; or a length
            above 1 m without a unit, which is probably in millimetres.
    """
    kind, unit = _KINDS[id(units)], ""
    if isinstance(value, str):
        match = None if "," in value else _QUANTITY.fullmatch(value)
        if match is None:
            point = "; write a decimal point, not a comma" if "," in value else ""
            raise GoalRejected(f"the {name} must be {kind}, not '{value}'{point}")
        unit = match[2]
        if unit and unit not in units:
            raise GoalRejected(
                f"the {name} must be {kind}, and '{unit}' is not a unit of one; "
                f"{suggestion(unit, units)}"
            )
        # A number without a unit counts as SI.
        size = float(match[1]) * units.get(unit, 1.0)
    elif (plain := number(value)) is not None:
        size = plain
    else:
        raise GoalRejected(f"the {name} must be {kind}, not {value!r:.100}")
    if units is LENGTH and not unit and _LONGEST < size < math.inf:
        raise GoalRejected(f"the {name} would be {size:g} m; write {size:g}mm")
    if not math.isfinite(size):
        raise GoalRejected(f"the {name} must be {kind}, not {size:g}")
    if size < 0.0:
        raise GoalRejected(f"the {name} must not be negative, not {value}")
    return size


def longest_wait(value: str | float, name: str) -> float:
    """Return a time to wait [s]; unlike a `quantity`, it may be infinite or negative.

    Raises:
        GoalRejected: if the value is not a time.
    """
    plain = quantity(value, TIME, name) if isinstance(value, str) else number(value)
    if plain is None or math.isnan(plain):
        raise GoalRejected(f"the {name} must be {_KINDS[id(TIME)]}, not {value!r:.100}")
    return plain


class AngleUnit(StrEnum):
    """Unit of the angles of an MJCF: the values of ``<compiler angle>``."""

    DEGREE = "degree"
    RADIAN = "radian"
