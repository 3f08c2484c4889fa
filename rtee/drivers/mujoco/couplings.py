"""The transmission as MuJoCo knows it: each coupled joint a polynomial of its actuator."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rtee.hand.model import Hand
from rtee.hand.transmission import Coupling

DEGREE = 4
"""Degree of a joint equality's polynomial in MuJoCo."""

_SAMPLES = 201
_CONTINUOUS_SPAN = math.pi


@dataclass(frozen=True, slots=True)
class Polynomial:
    """How a joint follows an actuator: ``q = Σ cᵢ uⁱ``.

    Attributes:
        joint: Name of the coupled joint.
        actuator: Name of the actuator it follows.
        coefficients: ``c₀ … c₄``.
        error: Largest deviation from the transmission within the actuator's limits [rad | m].
    """

    joint: str
    actuator: str
    coefficients: tuple[float, float, float, float, float]
    error: float


def fit(coupling: Coupling, lower: float, upper: float) -> tuple[tuple[float, ...], float]:
    """Fit a polynomial to a coupling over an actuator's range.

    Chebyshev nodes make the least-squares fit nearly minimax.

    Args:
        coupling: How the joint follows its actuator.
        lower: Lower limit of the actuator [rad | m].
        upper: Upper limit of the actuator [rad | m].

    Returns:
        Coefficients ``c₀ … c₄`` and the largest deviation [rad | m] on a dense grid.
    """
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    nodes = middle + half * np.cos(np.pi * (np.arange(_SAMPLES) + 0.5) / _SAMPLES)
    degree = 1 if coupling.linear else DEGREE
    values = np.array([coupling.value(float(u)) for u in nodes])
    polynomial = np.polynomial.Polynomial.fit(nodes, values, degree, domain=[lower, upper])
    grid = np.linspace(lower, upper, _SAMPLES)
    truth = np.array([coupling.value(float(u)) for u in grid])
    error = float(np.abs(polynomial(grid) - truth).max())
    coefficients = np.zeros(DEGREE + 1)
    found = polynomial.convert().coef
    coefficients[: len(found)] = found
    return tuple(float(c) for c in coefficients), error


def couplings(hand: Hand) -> tuple[Polynomial, ...]:
    """Return the polynomial of every coupled joint of a hand, in the order of its joints."""
    found: list[Polynomial] = []
    own = {a.name for a in hand.actuators}
    for joint, coupling in zip(hand.joints, hand.transmission.couplings, strict=True):
        if joint.name in own or coupling.actuator is None:
            continue
        actuator = hand.actuators[coupling.actuator]
        lower = actuator.lower if math.isfinite(actuator.lower) else -_CONTINUOUS_SPAN
        upper = actuator.upper if math.isfinite(actuator.upper) else _CONTINUOUS_SPAN
        c, error = fit(coupling, lower, upper)
        found.append(Polynomial(joint.name, actuator.name, (c[0], c[1], c[2], c[3], c[4]), error))
    return tuple(found)
