"""Find the actuator positions that come nearest to a joint vector of another model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.errors import ConfigError, suggestion
from rtee.hand.model import Hand

_SAMPLES: Final = 33
"""Positions of an actuator from which the best is refined: couplings bend gently."""

_HALVINGS: Final = 40
"""Steps of the refinement, by the golden section: to a billionth of the range."""

_GOLDEN: Final = (math.sqrt(5.0) - 1.0) / 2.0
"""Share of a range that a step of the golden section keeps."""


@dataclass(frozen=True, slots=True)
class FittedJoints:
    """Actuator positions for a joint vector.

    Attributes:
        posture: Positions of the actuators that move given joints [rad | m].
        residuals: Error of each given joint there, given minus reached [rad | m].
    """

    posture: Mapping[str, float]
    residuals: Mapping[str, float]


def fit_joints(
    hand: Hand, joints: Mapping[str, float], names: Mapping[str, str] | None = None
) -> FittedJoints:
    """Return the actuator positions whose joints come nearest to given ones.

    Each joint follows one actuator, so the squares of the joints' errors are least actuator by
    actuator. Joints that no actuator moves appear only in the residuals.

    Args:
        hand: The hand.
        joints: Positions by joint [rad | m]; not all joints need be there.
        names: The hand's joint for names of the other model that differ from it.

    Raises:
        ConfigError: if a joint is unknown or a value is not finite.
    """
    wanted: dict[int, float] = {}
    called: dict[int, str] = {}
    for given, value in joints.items():
        name = (names or {}).get(given, given)
        if name not in hand.joint_names:
            raise ConfigError(f"unknown joint '{name}'; {suggestion(name, hand.joint_names)}")
        if not math.isfinite(value):
            raise ConfigError(f"the position of '{given}' must be a number, not {value:g}")
        row = hand.joint_names.index(name)
        if row in wanted:
            raise ConfigError(f"'{called[row]}' and '{given}' are the same joint '{name}'")
        wanted[row], called[row] = float(value), given
    u = np.array(hand.rest)
    rows_of: dict[int, list[int]] = {}
    for row in wanted:
        index = hand.transmission.moves(row)
        if index is not None:
            rows_of.setdefault(index, []).append(row)
    for index, rows in rows_of.items():
        u[index] = _nearest(hand, index, {row: wanted[row] for row in rows})
    reached = hand.transmission.joints(u)
    return FittedJoints(
        {hand.actuator_names[i]: float(u[i]) for i in sorted(rows_of)},
        {called[row]: value - float(reached[row]) for row, value in wanted.items()},
    )


def _nearest(hand: Hand, index: int, wanted: Mapping[int, float]) -> float:
    """Return the position of one actuator with the least squares of its joints' errors."""
    spec, couplings = hand.actuators[index], hand.transmission.couplings

    def cost(u: float) -> float:
        return sum((couplings[row].value(u) - value) ** 2 for row, value in wanted.items())

    if all(couplings[row].linear for row in wanted):
        slopes = {row: couplings[row].dual(0.0) for row in wanted}
        above = sum(s * (wanted[row] - at) for row, (at, s) in slopes.items())
        # The square error of linear couplings is a parabola: its minimum, clamped, is the best.
        best = above / sum(s * s for _, s in slopes.values())
        return min(max(best, spec.lower), spec.upper)
    # Curved couplings may give several minima, of which the golden section finds any one.
    grid = np.linspace(spec.lower, spec.upper, _SAMPLES)
    k = int(np.argmin([cost(float(u)) for u in grid]))
    low, high = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, _SAMPLES - 1)])
    for _ in range(_HALVINGS):
        left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        low, high = (low, right) if cost(left) <= cost(right) else (left, high)
    return 0.5 * (low + high)
