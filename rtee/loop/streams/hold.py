"""Contact detection for the actuators of a stream, as for those of a goal, while it plays."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet

from rtee.hand.model import Hand
from rtee.loop.evidence import ContactMonitor
from rtee.loop.measured import Measured
from rtee.loop.streams.player import StreamPlayer

_TOLERANCE = 0.01
"""An actuator behind by less than this share of its range is not blocked: goals end as near to
their targets."""


class StreamHold:
    """Detects which actuators of a stream hold an object.

    Args:
        hand: The hand.
        contact: Detects blocked and grasping actuators.
        reference: Positions sent last, of all actuators [rad | m].
        limits: Effort limits sent last [N·m | N].
        eased: Actuators whose effort is lowered because they hold an object.
    """

    def __init__(
        self,
        hand: Hand,
        contact: ContactMonitor,
        reference: Sequence[float],
        limits: Sequence[float],
        eased: set[int],
    ) -> None:
        self._hand, self._contact = hand, contact
        self._reference, self._limits, self._eased = reference, limits, eased

    def begin(self, targets: Mapping[int, float], stamp: float) -> None:
        """Begin to watch actuators that a stream moves from now on.

        Args:
            targets: Their target positions, by index [rad | m].
            stamp: Now [s].
        """
        tolerance: dict[int, float] = {}
        for i in targets:
            actuator = self._hand.actuators[i]
            span = actuator.upper - actuator.lower
            # An actuator without limits has no range; 1 rad is a typical one.
            tolerance[i] = _TOLERANCE * (span if math.isfinite(span) else 1.0)
        self._contact.begin(targets, tolerance, stamp)

    def limits(self, stream: StreamPlayer, indices: AbstractSet[int]) -> dict[int, float]:
        """Return the effort limits of a stream for some actuators, by index [N·m | N]."""
        names = self._hand.actuator_names
        return {i: stream.effort[names[i]] for i in indices if names[i] in stream.effort}

    def aim(self, targets: Mapping[int, float]) -> None:
        """Set the target positions of a sample, by index [rad | m]."""
        for i, target in targets.items():
            self._contact.aim(i, target)

    def look(self, stream: StreamPlayer, stamp: float, measured: Measured) -> bool:
        """Evaluate a stream's actuators now [s]; restore the effort of those that hold nothing.

        Returns:
            Whether an eased actuator has reached its reference, and is eased no longer.
        """
        reference = self._reference
        # Actuators that clasp an object are not updated: the controller detects its loss.
        free = [i for i in stream.indices if not self._contact.clasped(i, reference[i])]
        self._contact.update(stamp, measured, reference, self._limits, free)
        freed = {
            i
            for i in self._eased.intersection(stream.indices)
            if abs(reference[i] - measured.position[i]) <= self._contact.tolerance(i)
        }
        self._eased -= freed
        return bool(freed)
