"""Short names, for where there is little room, and units."""

from __future__ import annotations

from collections.abc import Sequence

from rtee.hand.names import common_prefix
from rtee.sample import MEASURED


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return names without the words that all of them begin with: ``left_hand_Pinky`` is ``Pinky``.

    What begins them all is found by `common_prefix`.
    """
    prefix = common_prefix(names)
    return tuple(name.removeprefix(prefix) for name in names)


def units(quantity: str, *, slides: bool, turns: bool) -> str:
    """Return the unit of a quantity, of a hand whose actuators slide, turn or both."""
    return MEASURED[quantity].unit_for(slides=slides, turns=turns)
