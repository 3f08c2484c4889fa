"""Variations of a trial, and the confidence interval of their share of successes.

The draws depend on the seed and the number of the variation alone, so all trials see the same ones,
in any order and on any computer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.hand.frames import rotation
from rtee.sample import FloatArray
from rtee.trials.result import CHOOSING, TrialResult

SIZE: Final = 0.1
"""Objects are up to this share larger or smaller."""

MASS: Final = 0.5
"""Objects are up to this share heavier."""

POSITION: Final = 0.01
"""Largest distance of varied objects from their place along each axis [m]."""

TURN: Final = math.radians(10.0)
"""Largest rotation of varied objects about any axis [rad]."""

FRICTION: Final = (0.5, 1.0)
"""The range of friction."""

CHOOSING_FROM: Final = 1_000_000
EXPLORING_FROM: Final = 2_000_000
"""Numbers of the first draws by which places are chosen and found. The draws that count have the
numbers from 0: a rate measured with those by which its place was chosen would be too high."""

_CONFIDENCE = 1.96
"""Standard deviations of a normal distribution to either side that hold 95 %."""


@dataclass(frozen=True, slots=True)
class Variation:
    """Differences of a trial from the one without variation.

    Attributes:
        size: Factor of all lengths of the object.
        mass: Factor of its mass.
        position: Its distance from its place, in the hand's base frame [m].
        turn: How it is turned about its own origin: axis times angle, in the base frame [rad].
        friction: Friction between hand and object.
    """

    size: float
    mass: float
    position: tuple[float, float, float]
    turn: tuple[float, float, float]
    friction: float

    def mirrored(self) -> Variation:
        """Return the mirrored variation, about the middle of each range."""
        x, y, z = self.position
        rx, ry, rz = self.turn
        return Variation(
            size=2.0 - self.size,
            # Objects only get heavier: the range is 1 to 1 + MASS.
            mass=2.0 + MASS - self.mass,
            position=(-x, -y, -z),
            turn=(-rx, -ry, -rz),
            friction=sum(FRICTION) - self.friction,
        )

    def moved(self, pose: FloatArray) -> FloatArray:
        """Return an object's varied pose ``(4, 4)`` from its nominal one in the base frame."""
        found = np.array(pose)
        found[:3, 3] += self.position
        turn = np.array(self.turn)
        angle = float(np.linalg.norm(turn))
        if angle:
            found[:3, :3] = rotation((turn / angle).tolist(), angle) @ found[:3, :3]
        return found

    def options(self, mass: float) -> dict[str, float]:
        """Return the options of a simulation that vary, for an object of a mass [kg]."""
        return {
            "object_mass": mass * self.mass,
            "object_scale": self.size,
            "friction": self.friction,
        }


def draw(seed: int, number: int) -> Variation:
    """Return the variation of a number from 0 on, of those of a seed."""
    random = np.random.default_rng([seed, number])
    x, y, z = random.uniform(-POSITION, POSITION, 3)
    # Normal numbers, since a direction made of uniform ones would prefer the diagonals.
    axis = random.normal(size=3)
    rx, ry, rz = random.uniform(0.0, TURN) * axis / np.linalg.norm(axis)
    return Variation(
        size=float(random.uniform(1.0 - SIZE, 1.0 + SIZE)),
        mass=float(random.uniform(1.0, 1.0 + MASS)),
        position=(float(x), float(y), float(z)),
        turn=(float(rx), float(ry), float(rz)),
        friction=float(random.uniform(*FRICTION)),
    )


def choosing_draw(seed: int, number: int) -> Variation:
    """Return the variation of a number from 0 on, of those of a seed for choosing places.

    Each ten draws are followed by their mirror images: ten may all lie to one side of the place,
    twenty such draws are balanced.
    """
    back, place = divmod(number, 2 * CHOOSING)
    if place < CHOOSING:
        return draw(seed, CHOOSING_FROM + back * CHOOSING + place)
    return draw(seed, CHOOSING_FROM + back * CHOOSING + place - CHOOSING).mirrored()


def interval(successes: int, tries: int) -> tuple[float, float]:
    """Return the Wilson interval that holds the rate of success with 95 % confidence.

    Args:
        successes: How often it succeeded.
        tries: How often it was tried; with 0, nothing is known: 0 to 1.

    Source: Wilson, Probable inference, the law of succession, and statistical inference, 1927.
    """
    if tries == 0:
        return 0.0, 1.0
    square = _CONFIDENCE * _CONFIDENCE
    rate = successes / tries
    middle = rate + square / (2 * tries)
    half = _CONFIDENCE * math.sqrt(rate * (1.0 - rate) / tries + square / (4 * tries * tries))
    scale = 1.0 + square / tries
    # Rounding may lead out of 0 to 1 when all tries succeed, or none.
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def interval_text(successes: int, tries: int) -> str:
    """Return that interval as text, such as ``70 to 97 %``."""
    low, high = interval(successes, tries)
    return f"{low * 100:.0f} to {high * 100:.0f} %"


def rate_text(result: TrialResult) -> str:
    """Return in how many variations an object was held; ``""`` without variations.

    Such as ``18 of 20 variations (95 % confidence: 70 to 97 %)``.
    """
    if not (tries := result.tries):
        return ""
    likely = interval_text(result.survived, tries)
    return f"{result.survived} of {tries} variations (95 % confidence: {likely})"


def decided(successes: int, tries: int, wanted: float | None) -> bool:
    """Return whether the interval of a rate lies to one side of the rate that is wanted, if any."""
    low, high = interval(successes, tries)
    return wanted is not None and not low <= wanted <= high
