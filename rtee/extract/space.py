"""The box of postures of a search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.hand.model import Hand
from rtee.sample import FloatArray
from rtee.types import JointKind

DECIMALS: Final = 6
"""Decimals of stored postures: a millionth of a radian or metre."""

_AT_LIMIT: Final = 1.5e-6
"""Distance of an actuator from a limit below which it is stored at the limit [rad | m]: a unit of
what is stored, and half of one for rounding."""


@dataclass(frozen=True)
class Space:
    """Postures in which some actuators vary within bounds and the others rest.

    Coordinates run from 0 to 1 between the bounds, so that angles and lengths are commensurate.

    Attributes:
        base: Posture of the actuators that do not vary ``(n,)`` [rad | m].
        index: The actuators that vary.
        lower: Their lower bounds [rad | m].
        extent: Their upper bounds minus the lower ones [rad | m].
        levers: Cache of the scene for derivatives of joints by coordinates.
    """

    base: FloatArray
    index: NDArray[np.intp]
    lower: FloatArray
    extent: FloatArray
    levers: dict[object, FloatArray] = field(default_factory=dict, compare=False)

    @property
    def size(self) -> int:
        """Number of actuators that vary."""
        return len(self.index)

    @property
    def rest(self) -> FloatArray:
        """Coordinates of the rest posture ``(k,)``."""
        return self.coordinates(self.base)

    def posture(self, y: FloatArray) -> FloatArray:
        """Return the actuator positions ``(n,)`` [rad | m] at coordinates ``(k,)``."""
        u = self.base.copy()
        u[self.index] = self.lower + y * self.extent
        return u

    def coordinates(self, u: FloatArray) -> FloatArray:
        """Return the coordinates ``(k,)`` of a posture, clamped to the box."""
        scaled = (u[self.index] - self.lower) / self.extent
        clamped: FloatArray = np.clip(scaled, 0.0, 1.0)
        return clamped


def real_limits(hand: Hand) -> tuple[FloatArray, FloatArray]:
    """Return the bounds of all actuators: their limits, or a full turn for continuous ones."""
    lower, upper = hand.lower.copy(), hand.upper.copy()
    for i, actuator in enumerate(hand.actuators):
        # Half a turn to both sides of rest reaches every angle.
        if not math.isfinite(lower[i]):
            lower[i] = actuator.rest - math.pi
        if not math.isfinite(upper[i]):
            upper[i] = actuator.rest + math.pi
    return lower, upper


def widened_limits(hand: Hand) -> tuple[FloatArray, FloatArray]:
    """Return bounds for checking whether tips could meet at all.

    Revolute actuators get ±π, prismatic ones their range once more at either end, wherever their
    zero is; never less than the real limits.
    """
    lower, upper = real_limits(hand)
    for i, actuator in enumerate(hand.actuators):
        if actuator.kind is JointKind.PRISMATIC:
            span = upper[i] - lower[i]
            lower[i], upper[i] = lower[i] - span, upper[i] + span
        else:
            lower[i], upper[i] = min(lower[i], -math.pi), max(upper[i], math.pi)
    return lower, upper


def make_space(
    hand: Hand, actuators: Sequence[int], bounds: tuple[FloatArray, FloatArray]
) -> Space:
    """Return the space in which actuators vary, without those that cannot move."""
    lower, upper = bounds
    index = np.array([i for i in sorted(actuators) if upper[i] > lower[i]], dtype=np.intp)
    return Space(hand.rest, index, lower[index], upper[index] - lower[index])


def rounded(hand: Hand, u: FloatArray, unit: float = 1.0) -> FloatArray:
    """Return a posture rounded as stored, but never beyond the limits.

    Args:
        hand: The hand.
        u: The posture ``(n,)`` [rad | m].
        unit: Length that stands for a metre in what is stored [m].
    """
    # Adding 0 turns -0.0 into 0.0.
    result = np.round(u, DECIMALS) + 0.0
    for i, spec in enumerate(hand.actuators):
        scale = unit if spec.kind is JointKind.PRISMATIC else 1.0
        if scale != 1.0:
            result[i] = round(u[i] / scale, DECIMALS) * scale + 0.0
        # An actuator at rest stays exactly there, even if its rest has more decimals.
        if u[i] == spec.rest:
            result[i] = spec.rest
        for bound in (spec.lower, spec.upper):
            # Tips that just touch at a limit would not do so a rounding error before it.
            if abs(result[i] - bound) <= _AT_LIMIT * scale:
                result[i] = bound
        result[i] = min(max(result[i], spec.lower), spec.upper)
    return result
