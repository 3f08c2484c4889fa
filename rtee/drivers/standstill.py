"""Decide where a driver may stop its actuators: never at an impossible position."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rtee import monotonic
from rtee.drivers.plausibility import Plausibility
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Event, Reference

_BESIDE = 0.05
"""Largest distance of a device from the path between its last position and its reference, as a
share of the range; it allows for overshoot, play and pushes."""

_EVERY = 0.005
"""Least time between two judged measurements [s]: within a tick of 1 ms, all of them are on the
path."""

_MOVED_BY_OTHERS = 0.5
"""Time after which positions off the path count again [s]: somebody has moved the device."""


class Standstill:
    """Judges the measurements that a stop would command.

    A driver that stops its device by commanding the measured posture would make it jump if that
    posture was invalid, implausible or frozen. The driver's caller records measurements and
    references here; the driver calls `instead` before it commands a measurement. The
    alternative, the reference sent last, moves nothing that was not about to move; so this check
    is stricter than `Plausibility`.

    Args:
        spec: The device.
    """

    def __init__(self, spec: DeviceSpec) -> None:
        self._actuators = actuators = spec.actuators
        self._mechanisms = [spec.mechanism(actuator) for actuator in actuators]
        spans = [a.upper - a.lower for a in actuators]
        self._beside = [_BESIDE * span if math.isfinite(span) else _BESIDE for span in spans]
        self.forget()

    def forget(self) -> None:
        """Forget everything, since people or the device itself may have moved it meanwhile."""
        n = len(self._actuators)
        # The loop makes its own judgement, and reports it.
        self._plausibility = Plausibility(self._actuators, _silently, self._mechanisms)
        self._asked = np.full(n, math.nan)
        self._believed = [math.nan] * n
        self._judged = -math.inf
        self._strayed = [math.inf] * n

    def measured(self, state: ActuatorState) -> None:
        """Record a measurement."""
        if not abs(state.stamp - self._judged) < _EVERY:
            self._judged = state.stamp
            self._judge(state.position.tolist(), state.stamp, state.fresh)

    def asked(self, reference: Reference) -> None:
        """Record the reference of the device."""
        np.copyto(self._asked, reference.position, where=reference.mask)

    def instead(self, position: Sequence[float]) -> dict[int, float]:
        """Return the positions of actuators that must not hold their measured position, by index.

        Each is the reference sent last or, if there was none, the last plausible position [rad |
        m]. All other actuators hold the measured position.

        Args:
            position: The posture measured just now ``(n,)`` [rad | m].
        """
        now = monotonic.now()
        self._judge(list(position), now, True)
        found: dict[int, float] = {}
        for i, here in enumerate(position):
            asked, believed = float(self._asked[i]), self._believed[i]
            if here == believed and self._plausibility.start(i, now, asked) is not None:
                self._asked[i] = here
                continue
            held = believed if math.isnan(asked) else asked
            if not math.isnan(held):
                found[i] = held
        return found

    def _judge(self, position: list[float], stamp: float, fresh: bool) -> None:
        n, wanted = len(position), self._asked.tolist()
        # Until an actuator gets a reference, it should stay at its position.
        reference = [here if w != w else w for here, w in zip(position, wanted, strict=True)]
        self._plausibility.step(stamp, position, [fresh] * n, [True] * n, reference)
        if position == self._believed:  # the only test needed for a hand at rest
            self._strayed = [math.inf] * n
            return
        for i, here in enumerate(position):
            before, asked, beside = self._believed[i], wanted[i], self._beside[i]
            # Written so that a comparison with NaN, for unknown values, decides nothing.
            low = asked if asked < before else before
            high = asked if asked > before else before
            if here < low - beside or here > high + beside or here != here:
                if stamp < self._strayed[i]:
                    self._strayed[i] = stamp
                elif stamp - self._strayed[i] >= _MOVED_BY_OTHERS and here == here:
                    self._believed[i] = here
            else:
                self._believed[i], self._strayed[i] = here, math.inf


def _silently(event: Event) -> None:
    """Report nothing."""
