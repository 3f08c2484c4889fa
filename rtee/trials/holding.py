"""Decide whether an object is held: it keeps its place, and the hand reports no loss."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

import numpy as np

from rtee.sample import FloatArray
from rtee.types import Event, Result

SLIP: Final = 0.005
"""Largest slip in the hand of an object that is held [m], as in the experiments."""

TURN: Final = math.radians(10.0)
"""Largest rotation in the hand of an object that is held [rad]."""


def turned(shape: str, before: FloatArray, now: FloatArray) -> float:
    """Return the visible rotation of an object [rad].

    Args:
        shape: The object, as on the command line.
        before: Its orientation ``(3, 3)``, or pose, in the hand.
        now: The same later.
    """
    one, other = before[:3, :3], now[:3, :3]
    if shape.startswith("sphere"):
        return 0.0
    if shape.startswith(("cylinder", "capsule")):
        # Such an object looks the same at any angle about its axis, and upside down.
        cosine = abs(float(one[:, 2] @ other[:, 2]))
    else:
        cosine = (float(np.trace(one.T @ other)) - 1.0) / 2.0
    return math.acos(min(max(cosine, -1.0), 1.0))


def reports_loss(result: Result, events: Iterable[Event]) -> bool:
    """Return whether the hand reports a loss for every finger that held something.

    Args:
        result: How the grasp ended.
        events: Events since then.
    """
    lost = {
        finger
        for event in events
        if event.kind == "grasp_lost"
        for finger in event.source.split(", ")
    }
    return result.grasped and bool(result.grasped_fingers) and lost >= set(result.grasped_fingers)
