"""Where a hand sits on an arm: poses of its base as poses of the arm's flange, and back."""

from __future__ import annotations

import numpy as np

from rtee.hand.config_schema import FlangeSection
from rtee.hand.frames import origin
from rtee.sample import FloatArray


def base_in_flange(flange: FlangeSection) -> FloatArray:
    """Return the pose ``(4, 4)`` of the hand's base frame in that of the flange [m]."""
    return origin(flange.xyz, flange.rpy)


def flange_with(flange: FlangeSection, base: FloatArray) -> FloatArray:
    """Return the pose ``(4, 4)`` of the flange when the hand's base has a pose, in its frame."""
    return base @ np.linalg.inv(base_in_flange(flange))
