"""Features of a human hand's 21 points, such as fingertip positions in the palm's frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.retarget.layouts import Side
from rtee.sample import FloatArray

FINGERS: Final = ("thumb", "index", "middle", "ring", "little")
"""The human fingers, in the order of the points."""

PALM: Final = 0.095
"""Reference length of the palm, wrist to middle knuckle [m]: the mean of adults. All hands are
scaled to it."""

_FLEXION: Final = (0.3, 3.9)
"""Sum of a finger's three flexion angles at which it counts as straight and as closed [rad]."""

_THUMB: Final = (0.095, 0.035)
"""Distance of the tip of the open and of the closed thumb from the little finger's knuckle [m]."""

_BENT: Final = 0.2
"""Mean distance of a finger's joints behind the palm, as a share of its length, above which it
would be bent backwards: the hand is then a mirror image."""

_BONES: Final = np.array([(i, i + 1) for i in range(1, 20) if i % 4])
"""Pairs of points at the ends of the fingers' bones."""


@dataclass(frozen=True, slots=True)
class HumanPosture:
    """A human hand in its palm's frame, with axes palmar, radial (to the thumb's side) and distal.

    Left and right hands look the same in this frame. Lengths are scaled to a palm of `PALM`.

    Attributes:
        tips: Vectors from the bases of the five fingers to their tips, as shares of the fingers'
            lengths ``(5, 3)``.
        curls: Closure of the fingers, 0 to 1 ``(5,)``.
        gaps: Distances of the tips from the thumb's tip ``(5,)`` [m]; the first is 0.
    """

    tips: FloatArray
    curls: FloatArray
    gaps: FloatArray


def palm_frame(points: FloatArray, side: Side) -> FloatArray:
    """Return the palm's axes palmar, radial (to the thumb's side) and distal as rows ``(3, 3)``."""
    distal = _unit(points[9] - points[0])
    radial = points[5] - points[17]
    radial = _unit(radial - (radial @ distal) * distal)
    (a, b, c), (x, y, z) = radial.tolist(), distal.tolist()
    palmar = np.array([b * z - c * y, c * x - a * z, a * y - b * x])
    return np.array([palmar if side is Side.RIGHT else -palmar, radial, distal])


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(math.sqrt(vector @ vector), 1e-9)


def in_palm(points: FloatArray, side: Side) -> FloatArray:
    """Return points ``(21, 3)`` in the palm's frame with origin at the wrist, in the same unit."""
    local: FloatArray = (points - points[0]) @ palm_frame(points, side).T
    return local


def bones(points: FloatArray) -> FloatArray:
    """Return the lengths of each finger's three bones ``(15,)``, in the unit of the points."""
    lengths: FloatArray = np.linalg.norm(points[_BONES[:, 1]] - points[_BONES[:, 0]], axis=1)
    return lengths


def posture_of(local: FloatArray, lengths: FloatArray, palm: float) -> HumanPosture:
    """Return the posture of a hand.

    Args:
        local: Points in the palm's frame ``(21, 3)`` [m].
        lengths: The person's bones ``(15,)`` [m].
        palm: Length of the person's palm [m].
    """
    first, last = local[1::4], local[4::4]
    size = PALM / palm
    tips = (last - first) / lengths.reshape(5, 3).sum(axis=1)[:, None]
    # Angles between consecutive bones, the first of them against the palm's distal axis.
    chain = np.diff(local[1:].reshape(5, 4, 3), axis=1)
    chain /= np.maximum(np.linalg.norm(chain, axis=2, keepdims=True), 1e-9)
    into = np.clip(chain[:, 0, 2], -1.0, 1.0)
    inner = np.clip((chain[:, 1:] * chain[:, :-1]).sum(axis=2), -1.0, 1.0)
    flexion = np.arccos(into) * (chain[:, 0, 0] > 0.0) + np.arccos(inner).sum(axis=1)
    curls = (flexion - _FLEXION[0]) / (_FLEXION[1] - _FLEXION[0])
    across = size * math.dist(local[4], local[17])
    curls[0] = (_THUMB[0] - across) / (_THUMB[0] - _THUMB[1])
    gaps = size * np.linalg.norm(last - last[0], axis=1)
    return HumanPosture(tips, np.clip(curls, 0.0, 1.0), gaps)


def mirrored(local: FloatArray) -> bool:
    """Return whether fingers bend backwards, as those of the other hand would in this frame."""
    palmar = local[5:, 0].reshape(4, 4)
    long = np.linalg.norm(np.diff(local[5:].reshape(4, 4, 3), axis=1), axis=2).sum(axis=1)
    return int(((palmar[:, 1:].mean(axis=1) - palmar[:, 0]) < -_BENT * long).sum()) >= 2


class Smoother:
    """The one-euro filter (Casiez et al., 2012): smooth at rest, without lag in motion."""

    _CUTOFF: Final = 2.0
    """Cutoff frequency at rest [Hz]: a person's slow motions are below it."""

    _SPEED: Final = 25.0
    """Increase of the cutoff frequency with speed [Hz/(m/s)]: 2.5 Hz more at 0.1 m/s."""

    _OF_SPEED: Final = 4.0
    """Cutoff frequency of the speed itself [Hz]."""

    def __init__(self) -> None:
        self._at: FloatArray | None = None
        self._speed: FloatArray = np.zeros(0)

    def step(self, points: FloatArray, dt: float) -> FloatArray:
        """Return the filtered points ``(k, 3)``, given points ``dt`` [s] after the last ones."""
        if self._at is None or dt <= 0.0:
            self._at, self._speed = points, np.zeros_like(points)
            return points
        self._speed = self._speed + _share(self._OF_SPEED, dt) * (
            (points - self._at) / dt - self._speed
        )
        fast = np.sqrt((self._speed * self._speed).sum(axis=1, keepdims=True))
        share = 1.0 / (1.0 + 1.0 / (2.0 * math.pi * dt * (self._CUTOFF + self._SPEED * fast)))
        self._at = self._at + share * (points - self._at)
        return self._at

    def restart(self) -> None:
        """Forget earlier frames."""
        self._at = None


def _share(cutoff: float, dt: float) -> float:
    return 1.0 / (1.0 + 1.0 / (2.0 * math.pi * cutoff * dt))
