"""A hand without dynamics in place of a simulation: it follows its references exactly."""

from __future__ import annotations

import numpy as np

from rtee.hand.model import Hand
from rtee.sample import BoolArray, FloatArray


class KinematicPlay:
    """Plays a hand that follows its references at once and feels nothing."""

    def __init__(self, hand: Hand, period: float) -> None:
        """Start at rest.

        Args:
            hand: The hand.
            period: Time one `advance` takes [s].
        """
        self._hand = hand
        self.object_description = None
        self._period = period
        self._reference = np.array(hand.rest)
        self.position: FloatArray = np.array(hand.rest)
        self.velocity: FloatArray = np.zeros(len(hand.rest))

    def advance(self) -> None:
        """Go where the last references say."""
        self.velocity = (self._reference - self.position) / self._period
        # A copy, since the next command changes the references in place.
        self.position = np.array(self._reference)

    def command(self, position: FloatArray, max_effort: FloatArray, mask: BoolArray) -> None:
        """Set the references of the masked actuators; effort limits mean nothing here."""
        del max_effort
        self._reference[mask] = position[mask]

    @property
    def effort(self) -> FloatArray:
        """No efforts are known: ``NaN`` ``(n,)``."""
        return np.full(len(self.position), np.nan)

    @property
    def contact_forces(self) -> FloatArray:
        """Nothing is touched ``(fingers,)`` [N]."""
        return np.zeros(len(self._hand.fingers))

    @property
    def scene_channels(self) -> dict[str, FloatArray]:
        """There is nothing else."""
        return {}
