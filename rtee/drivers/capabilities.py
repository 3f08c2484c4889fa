"""The capabilities of a device: what it measures and accepts, and forces by its data sheet."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rtee.errors import foreign
from rtee.sample import NOTHING
from rtee.touch import TouchSensor


def _nothing() -> Mapping[str, Any]:
    return NOTHING


@dataclass(frozen=True, slots=True)
class GripForce:
    """Force at the fingertips as a linear function of an effort limit, from a device's data sheet.

    Attributes:
        effort: Effort limits of the weakest and of the strongest grip [N·m | N].
        weakest: Force of the weakest grip at each position ``(k,)`` [N].
        strongest: Force of the strongest grip at each position ``(k,)`` [N].
        position: Positions of the actuator ``(k,)``, rising [rad | m]; empty: ``k`` is 1.
    """

    effort: tuple[float, float]
    weakest: tuple[float, ...]
    strongest: tuple[float, ...]
    position: tuple[float, ...] = ()

    def range_at(self, position: float) -> tuple[float, float]:
        """Return the weakest and the strongest force [N] at a position [rad | m]."""
        # A force that is the same everywhere has one point, which `interp` extends to both sides.
        at = self.position or (0.0,)
        low, high = (np.interp(position, at, force) for force in (self.weakest, self.strongest))
        return float(low), float(high)

    def effort_for(self, force: float, position: float) -> float:
        """Return the effort limit [N·m | N] for a force [N] at a position [rad | m]."""
        low, high = self.range_at(position)
        share = (force - low) / (high - low)
        return self.effort[0] + share * (self.effort[1] - self.effort[0])

    def force_for(self, effort: float, position: float) -> float:
        """Return the force [N] of an effort limit [N·m | N] at a position [rad | m]."""
        low, high = self.range_at(position)
        # Clamped to the sheet's forces, since measured efforts may exceed its limits.
        share = (effort - self.effort[0]) / (self.effort[1] - self.effort[0])
        return low + min(max(share, 0.0), 1.0) * (high - low)


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Quantities that a device measures and commands that it accepts.

    Attributes:
        measures: Measured quantities: ``position velocity effort current temperature pressure
            grasped`` or fewer.
        accepts: Accepted parts of a reference: ``position max_effort max_velocity`` or fewer.
        refuses: For parts that are not accepted, the reason in words and what to do instead.
        best_rate: Highest useful rate of exchanges [Hz]; ``inf`` if only the loop limits it.
        homing: Whether the device needs homing before it can move.
        watchdog: Whether the device stops by itself when the host falls silent; armed by the
            driver.
        recoverable: Whether ``recover()`` can clear faults.
        gains: Names of gains that can be tuned while the device runs.
        identity: Model, firmware, serial number and the like, as the device reports them.
        grip: Force at the fingertips by effort limit, from the data sheet, by actuator.
        unlimited: Actuators whose effort the device cannot limit, though it limits others.
        touch: Its touch sensors, in the order of their values in readings. Their places on the
            hand may be left to hand.yaml.
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

    def __post_init__(self) -> None:
        """Escape the device's own texts, since they reach terminals, files and pages."""
        identity = {foreign(name): foreign(value) for name, value in self.identity.items()}
        object.__setattr__(self, "identity", identity)
