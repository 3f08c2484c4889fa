"""Short names, for where there is little room, and units."""

from __future__ import annotations

from collections.abc import Sequence


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return names without the words that all of them begin with: ``left_hand_Pinky`` is ``Pinky``.

    Names that would become empty, or the only one, stay whole.
    """
    if len(names) < 2:
        return tuple(names)
    first, last = min(names), max(names)
    same = next(
        (i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first)
    )
    length = max(first.rfind(mark, 0, same) for mark in "_-. ") + 1
    short = tuple(name[length:] for name in names)
    return short if all(short) else tuple(names)


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
