"""Where the links stand, for viewers: transforms from the measured positions, now and then."""

from __future__ import annotations

import numpy as np

from rtee.hand.frames import JointFrames
from rtee.hand.model import Hand
from rtee.log.settings import RecorderSettings
from rtee.messages.layout import TransformsEncoder
from rtee.types import FloatArray

_STEPS = float(2**36)
"""Transforms are told in steps of 1.5e-11 [m | 1], so that their last digits do not fill files."""


class LinkTransforms:
    """Encodes where the links of the moving joints stand.

    Args:
        hand: The hand.
        rate: Rate of its loop [Hz].
        settings: How often, among others.
    """

    def __init__(self, hand: Hand, rate: float, settings: RecorderSettings) -> None:
        self._frames = JointFrames(hand)
        self._transmission = hand.transmission
        self._last = hand.transmission.joints(hand.rest)
        parents, children = zip(*self._frames.moving, strict=True)
        self._encoder = TransformsEncoder(parents, children)
        every = rate / settings.tf_rate / settings.decimation if settings.tf_rate else 0.0
        self._turn = -1
        self._every = max(1, round(every)) * settings.decimation if settings.tf_rate else 0

    def due(self, tick: int) -> bool:
        """Whether they are to be recorded at a tick; a missed tick is made up for by the next."""
        if not self._every or tick // self._every == self._turn:
            return False
        self._turn = tick // self._every
        return True

    def encode(self, position: FloatArray, wall_ns: int) -> bytes:
        """Return the CDR bytes of a ``tf2_msgs/TFMessage``.

        A joint that is not measured stays where it was last, at rest to begin with.

        Args:
            position: Actuator positions ``(n,)`` [rad | m]; ``NaN``: not measured.
            wall_ns: The time since 1970 [ns].
        """
        q = self._transmission.joints(position)
        self._last = q = np.where(np.isfinite(q), q, self._last)
        translation, rotation = self._frames.at(q)
        return self._encoder.encode(wall_ns, _rounded(translation), _rounded(rotation))


def _rounded(values: FloatArray) -> FloatArray:
    rounded: FloatArray = np.rint(values * _STEPS) / _STEPS
    return rounded
