"""Check poses and directions from planners."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rtee.errors import ConfigError
from rtee.hand.frames import flange_with
from rtee.hand.model import Hand
from rtee.planning.result import Matrix
from rtee.sample import FloatArray

_RIGID: Final = 1e-3
"""How far a rotation's columns may be from orthonormal: single precision and a few products."""


_LEAST_LENGTH: Final = 1e-3
"""A shorter vector has no direction [m]: rounding and model errors would determine it."""


def checked_pose(pose: object, what: str) -> FloatArray:
    """Return a pose ``(4, 4)`` with an exact rotation; the identity for ``None``.

    Raises:
        ConfigError: if it is not a rigid transform of finite numbers.
    """
    if pose is None:
        return np.eye(4)
    try:
        found = np.array(pose, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (4, 4) or not np.isfinite(found).all():
        raise ConfigError(f"{what} must be a matrix of 4 by 4 finite numbers")
    turn = found[:3, :3]
    # The determinant, too: the columns of a mirror image are orthonormal as well.
    if np.abs(turn.T @ turn - np.eye(3)).max() > _RIGID or np.linalg.det(turn) < 0.0:
        raise ConfigError(f"{what} is not a rigid transform: its rotation is not orthonormal")
    if np.abs(found[3] - (0.0, 0.0, 0.0, 1.0)).max() > _RIGID:
        raise ConfigError(f"{what} is not a rigid transform: its last row is not 0 0 0 1")
    # The nearest rotation, so that errors of single precision do not add up in products.
    left, _, right = np.linalg.svd(turn)
    found[:3, :3], found[3] = left @ right, (0.0, 0.0, 0.0, 1.0)
    return found


def flange_rows(hand: Hand, base: FloatArray) -> Matrix | None:
    """Return the pose of the arm's flange for one of the hand's base; ``None``: not known."""
    return None if hand.flange is None else rows(flange_with(hand.flange, base))


def checked_direction(values: Sequence[float]) -> FloatArray:
    """Return a unit vector; raises `ConfigError` unless it is three numbers, not all of them 0."""
    try:
        found = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    length = float(np.linalg.norm(found)) if found.shape == (3,) else 0.0
    if not (np.isfinite(length) and length > 0.0):
        raise ConfigError(f"an approach must be three numbers, not all of them 0, not {values!r}")
    return found / length


def direction_of(vector: FloatArray, unknown: str) -> FloatArray:
    """Return the unit vector along a vector ``(3,)`` [m].

    Raises:
        ConfigError: with the sentence ``unknown``, if the vector is too short.
    """
    length = float(np.linalg.norm(vector))
    if length < _LEAST_LENGTH:
        raise ConfigError(unknown)
    return vector / length


def retreated(pose: FloatArray, direction: FloatArray, by: float) -> FloatArray:
    """Return a pose moved back by a length [m] along a direction.

    Raises:
        ConfigError: if the length is not finite or negative.
    """
    if not (np.isfinite(by) and by >= 0.0):
        raise ConfigError(f"a retreat must be 0 m or more, not {by:g}")
    moved = pose.copy()
    moved[:3, 3] -= by * direction / np.linalg.norm(direction)
    return moved


def rows(pose: FloatArray) -> Matrix:
    """Return a pose row by row."""
    return tuple(tuple(float(value) for value in row) for row in pose)
