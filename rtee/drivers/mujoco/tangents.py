"""The couplings of a running model, kept along the curves of the transmission."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import groupby, pairwise

import mujoco
import numpy as np

from rtee.drivers.mujoco.couplings import (
    SAMPLES,
    Follower,
    coupling_name,
    distributed,
    followers,
    motor_joint,
    shares_of,
    span,
    tendons_of,
)
from rtee.hand.config_schema import ActuatorDynamics
from rtee.hand.model import Hand
from rtee.hand.transmission import Coupling
from rtee.sample import FloatArray

Cell = list[tuple[float, float, float, float, float]]
"""For each joint, in a cell of the grid: the value at the cell's beginning and its growth over the
cell, the slope at the beginning and its growth, and the slope at the end."""

_KEPT = 64  # actuators whose tables are kept: those of a few large hands


@lru_cache(maxsize=_KEPT)
def _table(couplings: tuple[Coupling, ...], lower: float, upper: float) -> list[Cell]:
    """Return the cells of a grid over the range of an actuator, for the joints that follow it.

    Cached, since each variation of a trial has its own simulation of the same hand.
    """
    grid = np.linspace(lower, upper, SAMPLES).tolist()
    points = [[coupling.dual(u) for coupling in couplings] for u in grid]
    return [
        [(v0, v1 - v0, s0, s1 - s0, s1) for (v0, s0), (v1, s1) in zip(one, next_, strict=True)]
        for one, next_ in pairwise(points)
    ]


class _Curves:
    """Tabulated couplings of joints to one actuator: cubic between the points of a fine grid."""

    def __init__(self, group: Sequence[Follower]) -> None:
        """Tabulate joints that all follow the same actuator."""
        lower, upper = span(group[0].actuator)
        self._lower = lower
        # The range of an actuator that cannot move is a single point.
        self._step = (upper - lower) / (SAMPLES - 1) or 1.0
        self._cells = _table(tuple(follower.coupling for follower in group), lower, upper)

    def add_tangents(self, u: float, offsets: list[float], slopes: list[float]) -> None:
        """Append offset and slope of each joint's tangent at an actuator position."""
        # Plain numbers: for so few, numpy takes several times as long.
        step = self._step
        at = (u - self._lower) / step
        # Beyond its range, a coupling continues along its tangent at the end.
        if at >= SAMPLES - 1:
            cell, t = SAMPLES - 2, 1.0
        elif at >= 0.0:
            cell = int(at)
            t = at - cell
        else:
            # NaN stays NaN, and MuJoCo notices it in the next step.
            cell, t = 0, 0.0 if at < 0.0 else at
        nearest = self._lower + (cell + t) * step
        # A Hermite cubic: values and slopes match at the points, so tangents do not jump there.
        grown = (3.0 - 2.0 * t) * t * t
        first = step * (t * t * t - 2.0 * t * t + t)
        last = step * (t * t * t - t * t)
        for v0, growth, s0, change, s1 in self._cells[cell]:
            slope = s0 + t * change
            value = v0 + grown * growth + (first * s0 + last * s1)
            offsets.append(value - slope * nearest)
            slopes.append(slope)


class _Tangents:
    """The tangents of joints that follow several actuators."""

    def __init__(self, model: mujoco.MjModel, hand: Hand, group: Sequence[Follower]) -> None:
        """Tabulate joints that are sorted by their actuators."""
        self._curves = []
        for name, own in groupby(group, key=lambda follower: follower.actuator.name):
            motor = int(model.joint(motor_joint(hand, name)).qposadr[0])
            self._curves.append((motor, _Curves(list(own))))

    def at(self, position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return offsets and slopes ``(k,)`` at generalised positions ``(nq,)``."""
        offsets: list[float] = []
        slopes: list[float] = []
        for motor, curves in self._curves:
            curves.add_tangents(position.item(motor), offsets, slopes)
        return np.array(offsets), np.array(slopes)


class JointCouplings:
    """Keeps the couplings of a running model along the transmission's curves."""

    def __init__(self, model: mujoco.MjModel, hand: Hand) -> None:
        # Sorted by their actuators, so that each position is looked up once.
        every = sorted(followers(hand), key=lambda f: hand.actuator_index(f.actuator.name))
        springs = [f for f in every if f.elastic]
        curved = [f for f in every if not (f.elastic or f.master or f.coupling.linear)]
        self._on_springs = _Tangents(model, hand, springs) if springs else None
        self._curved = _Tangents(model, hand, curved) if curved else None
        self._equalities = np.array(
            [model.eq(coupling_name(f.joint)).id for f in curved], dtype=int
        )
        self._springs = np.array(
            [model.tendon(coupling_name(f.joint)).id for f in springs], dtype=int
        )
        self._follows = model.tendon_adr[self._springs] + 1
        self._tendons = []
        for actuator in hand.actuators:
            known = hand.dynamics.get(actuator.name, ActuatorDynamics())
            own = [i for i, f in enumerate(springs) if f.actuator.name == actuator.name]
            for name, numbers in tendons_of(hand, actuator.name, known.joints or (), known):
                rows = np.array([own[number] for number in numbers])
                tendon, equality = model.tendon(name).id, model.eq(name).id
                first = int(model.tendon_adr[tendon])
                wraps = slice(first, first + len(rows))
                length = float(model.tendon_length0[tendon])
                self._tendons.append((equality, wraps, length, rows, shares_of(known, numbers)))
        self._steady = all(f.coupling.linear for f in springs)
        self._renewed = False
        # Views of the model's own numbers, which are written at every exchange.
        self._eq_data, self._wrap_prm = model.eq_data, model.wrap_prm
        self._lengthspring = model.tendon_lengthspring

    def renew(self, position: FloatArray) -> None:
        """Set every coupling to the tangent of its curve at generalised positions ``(nq,)``."""
        if self._curved is not None:
            offsets, slopes = self._curved.at(position)
            self._eq_data[self._equalities, 0] = offsets
            self._eq_data[self._equalities, 1] = slopes
            self._eq_data[self._equalities, 2:5] = 0.0
        # Linear couplings have one tangent; setting it once is enough.
        if self._on_springs is None or (self._steady and self._renewed):
            return
        self._renewed = True
        offsets, slopes = self._on_springs.at(position)
        self._wrap_prm[self._follows] = -slopes
        self._lengthspring[self._springs] = offsets[:, None]
        for equality, wraps, length, own, weights in self._tendons:
            shares = distributed(slopes[own], weights)
            if shares is None:  # no joint moves here: the last shares remain
                continue
            self._wrap_prm[wraps] = shares
            self._eq_data[equality, 0] = shares @ offsets[own] - length
