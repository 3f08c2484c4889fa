"""The box of postures in which a search varies the actuators."""

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
"""Distance of an actuator from a limit below which it is stored at the limit [rad | m]: one unit of
a stored position, and half a unit for rounding."""


@dataclass(frozen=True)
class Space:
    """Postures in which some actuators vary within bounds and the others stay at rest.

    Coordinates run from 0 to 1 between the bounds, so that angles and lengths are comparable.

    Attributes:
        base: Rest posture, which gives the positions of fixed actuators ``(n,)`` [rad | m].
        index: Indices of the varying actuators ``(k,)``.
        lower: Lower bounds of these ``(k,)`` [rad | m].
        extent: Upper minus lower bounds of these ``(k,)`` [rad | m].
        levers: The scene's cache for derivatives of joints by coordinates.
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
        return np.clip(scaled, 0.0, 1.0)


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
    """Return widened bounds, for checking whether tips could meet at all.

    Revolute actuators get at least ±π; prismatic ones get their range once more at either end. The
    bounds are never narrower than the real limits.
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
        unit: Length in this hand that represents one metre of the stored posture [m].
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
            # Tips that just touch at a limit would not touch if the posture were rounded below it.
            if abs(result[i] - bound) <= _AT_LIMIT * scale:
                result[i] = bound
        result[i] = min(max(result[i], spec.lower), spec.upper)
    return result
