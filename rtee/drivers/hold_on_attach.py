"""Actuators that were active when the driver connected: they keep their grip until commanded.

The target of an actuator that holds an object lies beyond its position; the controller turns the
difference into force. The first reference after connecting is the measured position, and sending it
would release the object.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence

from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, Reference

_SAME = 0.01
"""A reference this close to the measured position commands no motion [fraction of the range]."""
_CHANGED = 1e-4
"""A reference that differs by more than this from the first one commands motion [fraction of the
range]."""


class HoldOnAttach:
    """The actuators to which no reference may be sent yet.

    Args:
        actuators: The actuators of the device.
    """

    def __init__(self, actuators: Sequence[ActuatorSpec]) -> None:
        spans = [a.upper - a.lower for a in actuators]
        # A continuous joint has no range: the thresholds are fractions of 1 rad instead.
        self._spans = [span if math.isfinite(span) else 1.0 for span in spans]
        self._holding: set[int] = set()
        self._first: dict[int, float] = {}

    def __bool__(self) -> bool:
        """Return whether there is any actuator to which no reference may be sent yet."""
        return bool(self._holding)

    def begin(self, found: Iterable[int] = ()) -> None:
        """Send no references to the actuators found active (indices); forget earlier ones."""
        self._holding = set(found)
        self._first.clear()

    def all_holding(self, reference: Reference, measured: FloatArray) -> bool:
        """Return whether all actuators are to be left alone; otherwise all follow from now on.

        For devices that take the set-points of all actuators at once. Arguments as for `holding`.
        """
        if self._holding and len(self.holding(reference, measured)) == len(self._spans):
            return True
        self._holding.clear()
        return False

    def holding(self, reference: Reference, measured: FloatArray) -> Collection[int]:
        """Return the indices of the actuators to leave alone; the others follow from now on.

        Args:
            reference: The reference; an actuator that it moves is no longer left alone.
            measured: Measured positions ``(n,)`` [rad | m].
        """
        for i in tuple(self._holding):
            if not reference.mask[i]:
                continue
            wanted, span = float(reference.position[i]), self._spans[i]
            changed = abs(wanted - self._first.setdefault(i, wanted))
            # Written with `not`, so that a NaN as measurement releases the actuator.
            if not abs(wanted - float(measured[i])) <= _SAME * span or changed > _CHANGED * span:
                self._holding.remove(i)
        return self._holding
