"""Actuators that were holding something when the driver attached, and were not asked to move since.

An actuator that holds an object has a target beyond its position: the difference is the grip. The
reference of a device that a driver attaches to begins at the measured position, and sending it
would end the grip.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence

from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, Reference

_SAME = 0.01
"""A reference this near to the measured position asks for no motion [part of the range]."""
_CHANGED = 1e-4
"""A reference that has changed by more than this since the first one asks for motion [part of the
range]."""


class Attached:
    """Which actuators are to be left alone.

    Args:
        actuators: The device's.
    """

    def __init__(self, actuators: Sequence[ActuatorSpec]) -> None:
        spans = [a.upper - a.lower for a in actuators]
        # An actuator that turns without end has no range: shares of 1 rad are used instead.
        self._spans = [span if math.isfinite(span) else 1.0 for span in spans]
        self._left: set[int] = set()
        self._first: dict[int, float] = {}

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self._left)

    def begin(self, found: Iterable[int] = ()) -> None:
        """Leave the actuators alone that were found active, and no others."""
        self._left = set(found)
        self._first.clear()

    def left(self, reference: Reference, measured: FloatArray) -> Collection[int]:
        """Return those that a reference does not ask to move; the others follow from now on.

        Args:
            reference: What is asked for.
            measured: Their positions.
        """
        for i in tuple(self._left):
            if not reference.mask[i]:
                continue
            asked, span = float(reference.position[i]), self._spans[i]
            changed = abs(asked - self._first.setdefault(i, asked))
            # Written with `not`, so that a measurement that is not a number releases the actuator.
            if not abs(asked - float(measured[i])) <= _SAME * span or changed > _CHANGED * span:
                self._left.remove(i)
        return self._left
