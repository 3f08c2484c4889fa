"""Online: the positions at which a hand answers a human posture, by least squares within limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.hand.model import Hand
from rtee.retarget.correspondence import Correspondence, Human
from rtee.retarget.human import FINGERS, Posture
from rtee.retarget.tips import Row, Tips
from rtee.sample import FloatArray

TOUCHING: Final = 0.018
"""Distance of two human tips, as trackers place them, when they touch [m]: half a finger's
thickness each."""

APART: Final = 0.095
"""Distance of the human tips at which a gripper is fully open [m]."""

_MEET: Final = (0.038, 0.075)
"""Distance of two human tips below which their gap is kept exactly, and above which it does not
matter [m]; between them the weight changes smoothly."""

_FINGER: Final = 0.085
"""Length of a human finger, from the knuckle [m]: gaps scale as the hand's fingers do to it."""

_PRIOR: Final = 0.5
"""Weight of how far the fingers are closed, where a tip's place leaves a choice [1/range]."""

_STAY: Final = 0.6
"""Weight of the last positions [1/range]."""

_SLIDE: Final = 3.0
"""Weight of the last positions of fingers whose tips meet [1/range]: their surfaces are curved, so
that tips that slide fast on one another part."""

_GAP: Final = 150.0
"""Weight of a gap between tips that meet [1/m]: ten times a tip's place, about 1/reach."""

_DRAW: Final = 0.5
"""Weight of the positions of the extracted pinch as the tips meet [1/range]."""

_DRAWN: Final = 0.03
"""Gap at which the extracted pinch has half of that weight [m]."""

_APART: Final = 1000.0
"""Weight of links of different fingers that overlap [1/m]: more than of tips that should meet."""

_CURVED: Final = 1.0
"""Curvature of a tip's path that is damped, of that of a circle around the finger's base."""

_STEPS: Final = 3
"""Steps of Gauss-Newton per frame: from the last frame's answer, two come to within noise."""


@dataclass(frozen=True, slots=True)
class _Pinch:
    pair: tuple[str, str]
    fingers: tuple[int, int]
    human: Human
    scale: float
    widest: float | None
    rows: NDArray[np.intp]
    contact: FloatArray


class Solver:
    """Solves for a hand's positions, each time from the last ones."""

    def __init__(self, hand: Hand, found: Correspondence, tips: Tips) -> None:
        self._tips = tips
        self._lower = np.where(np.isfinite(hand.lower), hand.lower, -np.pi)
        self._upper = np.where(np.isfinite(hand.upper), hand.upper, np.pi)
        self.range = np.maximum(self._upper - self._lower, 1e-6)
        self._turned = self.range**2
        self._rest, n = np.array(hand.rest), len(hand.actuators)
        names = list(found.fingers)
        maps = list(found.fingers.values())
        self._humans = [each.human for each in maps]
        self._axes = np.array([found.palm.palmar, found.palm.radial, found.palm.distal])
        self._bases = np.array([each.base for each in maps])
        self._reach = np.array([max(each.reach * each.scale, 1e-6) for each in maps])
        self._follow = np.array([each.follow for each in maps])
        self._bodies, self._points = [], []
        for name, each in found.fingers.items():
            body, placement = tips.kinematics.bodies[str(hand.finger(name).tip)]
            self._bodies.append(body)
            self._points.append(np.array(placement * np.array(each.tip)))
        # Which fingers an actuator closes: their mean says how far.
        self._closed = self._rest.copy()
        self._closes = np.zeros((n, len(names)))
        self._moves = np.array(
            [[float(a in hand.finger(f).actuators) for f in names] for a in hand.actuator_names]
        )
        for name, value in found.closed.items():
            i = hand.actuator_index(name)
            self._closed[i] = value
            for k, finger in enumerate(names):
                spec = hand.finger(finger)
                self._closes[i, k] = float(name in (spec.own or spec.actuators))
        self._closes /= np.maximum(self._closes.sum(axis=1, keepdims=True), 1.0)
        self._pinches = []
        for pinch in found.pinches:
            fingers = names.index(pinch.fingers[0]), names.index(pinch.fingers[1])
            reach = float(np.mean([self._reach[k] for k in fingers]))
            rows = np.array([hand.actuator_index(a) for a in pinch.contact], dtype=np.intp)
            contact = np.array([*pinch.contact.values()])
            human = self._humans[fingers[1]]
            self._pinches.append(
                _Pinch(pinch.fingers, fingers, human, reach / _FINGER, pinch.widest, rows, contact)
            )

    def solve(self, human: Posture, last: FloatArray) -> FloatArray:
        """Return the positions ``(n,)`` [rad | m] for a human posture, from the last ones."""
        nearest = 1 + int(np.argmin(human.gaps[1:]))
        of = [nearest if h is Human.NEAREST else FINGERS.index(h) for h in self._humans]
        curls = human.curls[of]
        targets = self._bases + self._reach[:, None] * (human.tips[of] @ self._axes)
        prior = self._rest + (self._closes @ curls) * (self._closed - self._rest)
        wanted, bound = [], np.zeros(len(of))
        draw, drawn = np.zeros(len(last)), np.zeros(len(last))
        for pinch in self._pinches:
            distance = float(human.gaps[of[pinch.fingers[1]]])
            weight, gap = self._intent(pinch, distance)
            if weight <= 0.0:
                continue
            wanted.append((pinch.pair, gap, weight))
            for k in pinch.fingers:
                bound[k] = max(bound[k], weight)
            share = (weight * _DRAWN / (_DRAWN + gap)) ** 2
            draw[pinch.rows] += share * pinch.contact
            drawn[pinch.rows] += share
        # Several pinches of one actuator share its weight.
        draw = np.divide(draw, drawn, out=prior.copy(), where=drawn > 0.0)
        drawn = _DRAW**2 * np.minimum(drawn, 1.0)
        follow = self._follow * (1.0 - 0.9 * bound) / self._reach
        stay = _STAY**2 + _SLIDE**2 * (self._moves * bound).max(axis=1)
        self._tips.go(last)
        near = self._tips.near(pair for pair, _, _ in wanted)
        u = last
        for _ in range(_STEPS):
            u = self._step(u, last, targets, follow, prior, draw, drawn, stay, wanted, near)
        return u

    def _intent(self, pinch: _Pinch, distance: float) -> tuple[float, float]:
        """Return the weight of a gap and how wide it should be [m]."""
        beyond = max(0.0, distance - TOUCHING)
        if pinch.widest is not None:
            return 1.0, pinch.widest * min(1.0, beyond / (APART - TOUCHING))
        share = min(1.0, max(0.0, (_MEET[1] - distance) / (_MEET[1] - _MEET[0])))
        return share * share * (3.0 - 2.0 * share), pinch.scale * beyond

    def _step(
        self,
        u: FloatArray,
        last: FloatArray,
        targets: FloatArray,
        follow: FloatArray,
        prior: FloatArray,
        draw: FloatArray,
        drawn: FloatArray,
        stay: FloatArray,
        wanted: list[tuple[tuple[str, str], float, float]],
        near: list[Row],
    ) -> FloatArray:
        """Return the positions after one step of Gauss-Newton."""
        tips, unit = self._tips, self.range
        tips.go(u)
        # In units of the ranges, so that radians and metres are comparable.
        weights = np.full(len(u), _PRIOR**2)
        hessian = np.diag(weights + stay + drawn)
        slope = (weights * (prior - u) + stay * (last - u) + drawn * (draw - u)) / unit
        damping = np.zeros_like(u)
        if follow.any():
            places = np.array(
                [tips.place(b, p) for b, p in zip(self._bodies, self._points, strict=True)]
            )
            rows = (tips.moves(self._bodies, places) * (follow[:, None, None] * unit)).reshape(
                -1, len(u)
            )
            off = follow[:, None] * (targets - places)
            hessian += rows.T @ rows
            slope += rows.T @ off.ravel()
            # What Gauss-Newton leaves out, by its size: else targets out of reach make it swing.
            damping += _CURVED * float(np.abs(off).max()) * self._turned
        for pair, gap, weight in wanted:
            distance, row = tips.gap(pair)
            row = _GAP * weight * row * unit
            off = _GAP * weight * (gap - distance)
            hessian += np.outer(row, row)
            slope += row * off
            damping += abs(off) * np.abs(row)
        for begun, row in near:
            # They move little in a frame, so that one look at them is enough.
            distance = begun + float(row @ (u - last))
            if distance < 0.0:
                row = _APART * row * unit
                hessian += np.outer(row, row)
                slope += row * (-_APART * distance)
        hessian[np.diag_indices_from(hessian)] += damping
        return self._within(u, hessian, slope)

    def _within(self, u: FloatArray, hessian: FloatArray, slope: FloatArray) -> FloatArray:
        """Return the minimum of a quadratic function within the limits, by freezing."""
        low, high = (self._lower - u) / self.range, (self._upper - u) / self.range
        step, free = np.zeros_like(u), np.ones(len(u), dtype=bool)
        for _ in range(len(u)):
            given = slope[free] - hessian[np.ix_(free, ~free)] @ step[~free]
            step[free] = np.linalg.solve(hessian[np.ix_(free, free)], given)
            beyond = free & ((step < low) | (step > high))
            if not beyond.any():
                break
            step[beyond] = np.clip(step[beyond], low[beyond], high[beyond])
            free &= ~beyond
            if not free.any():
                break
        found: FloatArray = np.clip(u + step * self.range, self._lower, self._upper)
        return found
