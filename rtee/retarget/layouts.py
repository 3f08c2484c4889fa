"""Layouts of trackers' points, by name, and their conversion to MediaPipe's order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Final

import numpy as np

from rtee.errors import ConfigError
from rtee.sample import FloatArray

POINTS: Final = 21
"""Number of points of MediaPipe's hand: the wrist, then four per finger from palm to tip, in the
order thumb, index, middle, ring, little."""


class Side(StrEnum):
    """A person's left or right hand."""

    LEFT = "left"
    RIGHT = "right"


@dataclass(frozen=True)
class Layout:
    """Order and unit of a tracker's points of a hand.

    The tracker's frame does not matter, as long as it is right-handed: retargeting uses the palm's
    own frame.

    Attributes:
        name: Name of the layout.
        order: For each of MediaPipe's 21 points, the indices of the tracker's points to average.
        count: Number of points from the tracker.
        unit: The tracker's unit of length [m].
    """

    name: str
    order: tuple[tuple[int, ...], ...]
    count: int
    unit: float = 1.0

    def __post_init__(self) -> None:
        known = all(part and all(0 <= i < self.count for i in part) for part in self.order)
        if len(self.order) != POINTS or not known or not 0.0 < self.unit < np.inf:
            raise ConfigError(
                f"the layout '{self.name}' should name {POINTS} points from 0 to "
                f"{self.count - 1}, and a unit above 0 m"
            )

    @cached_property
    def _mean(self) -> FloatArray:
        mean = np.zeros((POINTS, self.count))
        for row, part in enumerate(self.order):
            mean[row, list(part)] = self.unit / len(part)
        return mean

    def points(self, given: object) -> FloatArray:
        """Return a tracker's points ``(count, 3)`` as MediaPipe's ``(21, 3)`` [m].

        Raises:
            ConfigError: if their number is wrong, or they are not finite numbers.
        """
        try:
            found = np.array(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise ConfigError(f"points must be {self.count} rows of 3 numbers") from None
        if found.shape != (self.count, 3):
            shape = " x ".join(map(str, found.shape)) or "a single number"
            raise ConfigError(f"{self.name} gives {self.count} points of 3 numbers, not {shape}")
        odd = np.flatnonzero(~np.isfinite(found).all(axis=1))
        if len(odd):
            raise ConfigError(f"point {odd[0]} must be three finite numbers")
        return self._mean @ found


def _picked(name: str, order: Sequence[int], count: int) -> Layout:
    return Layout(name, tuple((i,) for i in order), count)


_WITHOUT_METACARPALS: Final = (0, 1, 2, 3, 4, *(i for i in range(5, 25) if i % 5 != 0))
"""Indices among 25 points: wrist, four of the thumb, four of each finger without its metacarpal."""

LAYOUTS: Final[Mapping[str, Layout]] = {
    layout.name: layout
    for layout in (
        _picked("mediapipe", range(21), 21),
        # XRHand: wrist, four of the thumb, five of each finger from the metacarpal's base.
        _picked("webxr", _WITHOUT_METACARPALS, 25),
        # LeapC gives the ends of bones in millimetres: four of the thumb, whose metacarpal has no
        # length, and five of each finger. The wrist is the mean of the fingers' first points.
        Layout(
            "leap",
            (
                (4, 9, 14, 19),
                *((i,) for i in range(4)),
                *((i,) for i in range(4, 24) if (i - 4) % 5 != 0),
            ),
            24,
            0.001,
        ),
        # Manus Core's raw skeleton: wrist, four of the thumb, five of each finger.
        _picked("manus", _WITHOUT_METACARPALS, 25),
        _picked("manus21", range(21), 21),
        # MANO's joints as in SMPL-X (index, middle, little, ring, thumb), then tips, thumb first.
        _picked(
            "mano",
            (0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20),
            21,
        ),
    )
}
"""The layouts by name."""


def layout_named(name: str) -> Layout:
    """Return the layout with this name; raises `ConfigError` if there is none."""
    if name not in LAYOUTS:
        raise ConfigError(f"unknown layout '{name}'; valid: {', '.join(LAYOUTS)}")
    return LAYOUTS[name]


def side_named(name: str) -> Side:
    """Return the side with this name; raises `ConfigError` if there is none."""
    if name not in (*Side,):
        raise ConfigError(f"the person's hand must be left or right, not '{name}'")
    return Side(name)
