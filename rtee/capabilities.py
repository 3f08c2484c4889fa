"""What a device measures and accepts, and what force its sheet says it gives."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rtee.sample import NOTHING
from rtee.touch import TouchSensor


def _nothing() -> Mapping[str, Any]:
    return NOTHING


@dataclass(frozen=True, slots=True)
class GripForce:
    """Force at the fingertips by an actuator's effort limit, linear in it, from a device's sheet.

    Attributes:
        effort: Effort limits of the weakest and of the strongest grip [N·m | N].
        weakest: Force at the first of them ``(k,)`` [N].
        strongest: Force at the second ``(k,)`` [N].
        position: Positions of the actuator there ``(k,)``, rising [rad | m]; empty: ``k`` is 1.
    """

    effort: tuple[float, float]
    weakest: tuple[float, ...]
    strongest: tuple[float, ...]
    position: tuple[float, ...] = ()

    def range_at(self, position: float) -> tuple[float, float]:
        """Return the weakest and the strongest force at a position [rad | m] in newtons."""
        at = self.position or (0.0,)
        low, high = (np.interp(position, at, force) for force in (self.weakest, self.strongest))
        return float(low), float(high)

    def effort_for(self, force: float, position: float) -> float:
        """Return the effort limit that gives a force [N] at a position [rad | m]."""
        low, high = self.range_at(position)
        share = (force - low) / (high - low)
        return self.effort[0] + share * (self.effort[1] - self.effort[0])

    def force_for(self, effort: float, position: float) -> float:
        """Return the force [N] that an effort limit gives at a position [rad | m]."""
        low, high = self.range_at(position)
        share = (effort - self.effort[0]) / (self.effort[1] - self.effort[0])
        return low + min(max(share, 0.0), 1.0) * (high - low)


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a device measures and accepts.

    Attributes:
        measures: Of ``position velocity effort current temperature pressure grasped``.
        accepts: Of ``position max_effort max_velocity``.
        refuses: Of those that it does not accept, why, in words, and what to do instead.
        best_rate: Fastest useful rate of exchanges [Hz]; ``inf`` when only the loop limits it.
        homing: It needs homing before it can move.
        watchdog: It stops by itself when the host falls silent, and the driver has armed that.
        recoverable: ``recover()`` can clear faults.
        gains: Names of gains that can be tuned while it runs.
        identity: Model, firmware, serial number and the like, as the device reports them.
        grip: Force at the fingertips by effort limit from the device's sheet, by actuator.
        unlimited: Actuators whose effort it cannot limit, though it limits that of others.
        touch: Its touch sensors, in the order in which its readings have their values. Where they
            are on the hand may be left to hand.yaml.
    """

    measures: frozenset[str] = frozenset({"position"})
    accepts: frozenset[str] = frozenset({"position"})
    refuses: Mapping[str, str] = field(default_factory=_nothing)
    best_rate: float = math.inf
    homing: bool = False
    watchdog: bool = False
    recoverable: bool = False
    gains: tuple[str, ...] = ()
    identity: Mapping[str, str] = field(default_factory=_nothing)
    grip: Mapping[str, GripForce] = field(default_factory=_nothing)
    unlimited: frozenset[str] = frozenset()
    touch: tuple[TouchSensor, ...] = ()
