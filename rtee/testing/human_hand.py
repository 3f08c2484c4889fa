"""A person's hand by its angles, as a tracker would see it: for tests and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.sample import FloatArray

KNUCKLES: Final = np.array(
    [
        [0.012, 0.030, 0.022],
        [0.0, 0.026, 0.092],
        [0.0, 0.002, 0.095],
        [0.0, -0.020, 0.088],
        [0.0, -0.038, 0.078],
    ]
)
"""Bases of the fingers, thumb first, in the palm's frame: palmar, to the thumb, to the fingers [m].
Means of adults, as for the bones."""

BONES: Final = np.array(
    [
        [0.046, 0.034, 0.028],
        [0.042, 0.025, 0.022],
        [0.046, 0.029, 0.023],
        [0.043, 0.027, 0.023],
        [0.034, 0.020, 0.020],
    ]
)
"""Lengths of the fingers' bones from the palm on [m]."""

_CLOSED: Final = np.array([1.5, 1.75, 1.0])
"""Angles of a closed finger's joints [rad]."""

_THUMB_OPEN: Final = np.array([0.035, 0.085, 0.075])
_THUMB_CLOSED: Final = np.array([0.055, -0.010, 0.065])
"""Positions of the thumb's tip: open, and across the palm [m]."""


@dataclass(frozen=True, slots=True)
class HumanHand:
    """A right hand; the origin is the wrist, the axes are the palm's.

    Attributes:
        size: Factor of all lengths; 1 for the mean of adults.
    """

    size: float = 1.0

    def points(
        self,
        curls: Sequence[float] = (0.0,) * 5,
        *,
        spread: float = 0.0,
        pinch: tuple[int, float] | None = None,
    ) -> FloatArray:
        """Return MediaPipe's points ``(21, 3)`` [m].

        Args:
            curls: How far the fingers are closed, thumb first, 0 to 1.
            spread: Angle between neighbouring fingers [rad].
            pinch: A finger, 1 to 4, and the distance of the thumb's tip from its tip [m]. That
                finger is curled as in a pinch.
        """
        found = np.zeros((21, 3))
        for finger in range(1, 5):
            curl = curls[finger]
            angles = curl * _CLOSED
            if pinch is not None and pinch[0] == finger:
                angles = np.array([0.75, 0.85, 0.45])
            bend = np.cumsum(angles)
            aside = spread * (2 - finger)
            ways = np.stack([np.sin(bend), np.cos(bend) * np.sin(aside), np.cos(bend)], axis=1)
            ways /= np.linalg.norm(ways, axis=1, keepdims=True)
            found[1 + 4 * finger] = KNUCKLES[finger]
            found[2 + 4 * finger : 5 + 4 * finger] = KNUCKLES[finger] + np.cumsum(
                BONES[finger, :, None] * ways, axis=0
            )
        goal = _THUMB_OPEN + curls[0] * (_THUMB_CLOSED - _THUMB_OPEN)
        if pinch is not None:
            tip = found[4 + 4 * pinch[0]]
            away = _THUMB_OPEN - tip
            goal = tip + pinch[1] / self.size * away / np.linalg.norm(away)
        found[1:5] = _reached(KNUCKLES[0], BONES[0], goal)
        return found * self.size


def _reached(base: FloatArray, bones: FloatArray, goal: FloatArray) -> FloatArray:
    """Return the joints of a chain whose end is at a goal (FABRIK: Aristidou and Lasenby, 2011)."""
    way = (goal - base) / np.linalg.norm(goal - base)
    chain: FloatArray = base + np.concatenate([[0.0], np.cumsum(bones)])[:, None] * way
    chain[1:3] += [0.02, 0.01, 0.0]  # the thumb bends outwards
    for _ in range(60):
        chain[-1] = goal
        for i in (2, 1, 0):
            step = chain[i] - chain[i + 1]
            chain[i] = chain[i + 1] + bones[i] * step / np.linalg.norm(step)
        chain[0] = base
        for i in (0, 1, 2):
            step = chain[i + 1] - chain[i]
            chain[i + 1] = chain[i] + bones[i] * step / np.linalg.norm(step)
    return chain


def shown() -> list[FloatArray]:
    """Return points of a hand that closes, pinches with each finger and spreads, at 30 Hz."""
    hand, turn = HumanHand(), 0.5 - 0.5 * np.cos(np.linspace(0.0, 2.0 * np.pi, 60))
    frames = [hand.points((float(share),) * 5) for share in turn]
    for finger in range(1, 5):
        frames += [hand.points(pinch=(finger, float(0.09 - 0.075 * share))) for share in turn]
    return frames + [hand.points(spread=0.12 * float(share)) for share in turn]
