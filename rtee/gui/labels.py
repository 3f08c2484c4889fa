"""Short names, for where there is little room, and units."""

from __future__ import annotations

from collections.abc import Sequence

from rtee.hand.names import common_prefix


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return names without the words that all of them begin with: ``left_hand_Pinky`` is ``Pinky``.

    What begins them all is found by `common_prefix`.
    """
    prefix = common_prefix(names)
    return tuple(name.removeprefix(prefix) for name in names)


def units(quantity: str, *, slides: bool, turns: bool) -> str:
    """Return the unit of a quantity, of a hand whose actuators slide, turn or both."""
    linear, angular = {
        "position": ("m", "rad"),
        "velocity": ("m/s", "rad/s"),
        "effort": ("N", "N·m"),
        "current": ("A", "A"),
        "temperature": ("°C", "°C"),
    }[quantity]
    if linear == angular or not slides:
        return angular
    return f"{angular} | {linear}" if turns else linear
