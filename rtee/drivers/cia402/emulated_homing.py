"""The ways home of CiA 402's homing methods, as an emulated drive goes them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Method = Literal[1, 2, 17, 18, 33, 34, 35, 37]
METHODS: tuple[Method, ...] = (1, 2, 17, 18, 33, 34, 35, 37)
"""Homing methods that are known (object 6098h)."""


@dataclass(frozen=True, slots=True)
class Leg:
    """A part of the way: where it ends [counts of the axis], and its speed [counts/s]."""

    end: float
    speed: float


def way_home(
    method: int, here: float, *, negative: Leg, positive: Leg, turn: int, slow: float
) -> list[Leg]:
    """Return where a homing method leads, leg by leg; the last one ends at home.

    Args:
        method: 1, 2 (limit switch and index pulse), 17, 18 (limit switch), 33, 34 (index pulse),
            35 or 37 (where it is).
        here: Where the axis is [counts].
        negative: To the negative limit switch.
        positive: To the positive one.
        turn: Counts between two index pulses.
        slow: Speed at which index pulses are looked for [counts/s].
    """

    def pulse(start: float, direction: int) -> Leg:
        return Leg((math.floor(direction * start / turn) + 1) * turn * direction, slow)

    match method:
        case 1:
            return [negative, pulse(negative.end, 1)]
        case 2:
            return [positive, pulse(positive.end, -1)]
        case 17:
            return [negative]
        case 18:
            return [positive]
        case 33:
            return [pulse(here, -1)]
        case 34:
            return [pulse(here, 1)]
        case 35 | 37:
            return [Leg(here, slow)]
    raise ValueError(f"there is no way for homing method {method}")
