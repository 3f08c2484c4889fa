"""Detect measured positions that an actuator cannot have reached."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from rtee.types import ActuatorSpec, Event, JointKind

MARGIN = 5.0
"""Plausible speed of an actuator, in multiples of its velocity limit: that limit is one of
set-points, and an actuator that is pushed, slips or catches up exceeds it."""

_SPARE = 0.1
"""Extra time at that speed, added to the time between two measurements [s]: they are older than the
ticks that collect them. It covers half a second at the velocity limit; a device that is silent for
longer is lost."""

_SLACK = 0.05
"""Travel allowed in addition, as a share of the range: a coarse sensor, an object that slips."""

_OUTSIDE = 0.5
"""A position further outside of its limits than this share of the range is implausible. Devices do
come to rest outside of the limits, which are often narrower than the mechanism."""

_CALM = 0.5
"""A position is plausible again after this time without an implausible step [s]: some exchanges of
the slowest device."""

_PERSISTENT = 5
"""This many implausible steps with less than `_CALM` between them are not a glitch. A position
outside of the limits does not count as a step: an actuator may come back from there."""

_LEAP = 0.02
"""A measured step of more than this share of the range is a leap: possible where an actuator is
measured rarely, but nearly every step between random positions is one."""

_AGREEING = 2.5
"""After a leap, an actuator counts as arrived once no other leap follows for this many intervals
between measurements: two more measurements agree, even if they are late."""


@dataclass(slots=True)
class _Doubt:
    """Time of the last implausible measurement [s], and the number of implausible steps."""

    stamp: float
    steps: int = 0


class Plausibility:
    """Watches the measured positions for steps that no actuator can make.

    Every actuator has an allowance of travel, which grows with time at `MARGIN` times the velocity
    limit and is reduced by each measured step. So measurements may be sparse, late or bunched.
    """

    def __init__(
        self, actuators: Sequence[ActuatorSpec], report: Callable[[Event], object]
    ) -> None:
        self._actuators = actuators
        self._report = report
        n = len(actuators)
        spans = [a.upper - a.lower for a in actuators]
        slack = [_SLACK * span if math.isfinite(span) else _SLACK for span in spans]
        self._rate = [MARGIN * a.velocity for a in actuators]
        self._most = [_SPARE * r + s for r, s in zip(self._rate, slack, strict=True)]
        self._lowest = [a.lower - _OUTSIDE * span for a, span in zip(actuators, spans, strict=True)]
        self._highest = [
            a.upper + _OUTSIDE * span for a, span in zip(actuators, spans, strict=True)
        ]
        self._last = [math.nan] * n
        self._left = list(self._most)
        self._changed = [-math.inf] * n
        self._leap = [_LEAP * span if math.isfinite(span) else _LEAP for span in spans]
        self._leaping_until = [-math.inf] * n
        self._seen = [-math.inf] * n
        self._all_seen = -math.inf
        self._doubted: dict[int, _Doubt] = {}

    def forget(self, indices: Iterable[int]) -> None:
        """Forget the positions of some actuators, which people may have moved meanwhile."""
        for i in indices:
            self._last[i] = math.nan
            self._leaping_until[i] = -math.inf
            self._doubted.pop(i, None)

    def doubted(self, indices: Iterable[int]) -> bool:
        """Return whether any of some actuators has an implausible measured position."""
        return bool(self._doubted) and any(i in self._doubted for i in indices)

    def leaping(self, indices: Iterable[int], stamp: float) -> bool:
        """Return whether any of some actuators was measured too rarely to say where it is.

        It has leapt, even if plausibly, and too few later measurements agree.
        """
        return any(stamp < self._leaping_until[i] for i in indices)

    def broken(self, indices: Iterable[int]) -> int | None:
        """Return the first of some actuators whose position is persistently implausible."""
        for i in indices if self._doubted else ():
            if i in self._doubted and self._doubted[i].steps >= _PERSISTENT:
                return i
        return None

    def words(self, i: int) -> str:
        """Return in words that the position of an actuator is implausible, else an empty string."""
        name = self._actuators[i].name
        return f"the measured position of {name} is not plausible" if i in self._doubted else ""

    def step(
        self, stamp: float, position: Sequence[float], fresh: Sequence[bool], active: Sequence[bool]
    ) -> None:
        """Check the measured positions of a tick.

        Args:
            stamp: Now [s].
            position: Measured positions [rad | m].
            fresh: Whether each is newer than at the tick before.
            active: Whether its device drives an actuator; people may move the others.
        """
        last = self._last
        if position != last:  # this test alone for a hand at rest
            for i, here in enumerate(position):
                if here != last[i]:
                    self._moved(i, here, stamp, active[i])
                    last[i] = here
        if all(fresh):
            # Usually all are fresh: one time for all instead of a list of equal times.
            self._all_seen = stamp
        else:
            for i, new in enumerate(fresh):
                if new:
                    self._seen[i] = stamp
        if self._doubted:
            self._believe(stamp, active)

    def _moved(self, i: int, here: float, stamp: float, active: bool) -> None:
        # Called for each actuator at each tick of a motion, so min() and max() are written out.
        way, most = abs(here - self._last[i]), self._most[i]
        if way != way or not active:  # the first measurement, or an undriven actuator
            self._left[i] = most
        else:
            before, rate, left = self._seen[i], self._rate[i], self._left[i]
            if self._all_seen > before:
                before = self._all_seen
            if before > self._changed[i]:
                # At rest while other actuators were measured: that time adds to the allowance,
                # too, up to its maximum.
                left += rate * (before - self._changed[i])
            if left > most:
                left = most
            if way > self._leap[i]:
                # A device may repeat an answer until it has a new one.
                repeated = min(stamp - self._changed[i], _SPARE)
                self._leaping_until[i] = stamp + _AGREEING * max(stamp - before, repeated)
            rest = left + rate * (stamp - before) - way
            self._left[i] = most if rest > most else rest if rest > 0.0 else 0.0
            if rest < 0.0:
                late = f"within {(stamp - before) * 1e3:.3g} ms"
                self._doubt(i, stamp, f"moved {way:.3g}", late, step=True)
            elif not self._lowest[i] <= here <= self._highest[i]:
                self._doubt(i, stamp, f"is at {here:.3g}", "far outside of its limits", step=False)
        self._changed[i] = stamp

    def _outside(self, i: int, here: float) -> bool:
        return not self._lowest[i] <= here <= self._highest[i]

    def _doubt(self, i: int, stamp: float, moved: str, how: str, *, step: bool) -> None:
        new = i not in self._doubted
        known = self._doubted.setdefault(i, _Doubt(stamp))
        known.stamp = stamp
        known.steps += step
        if new:
            spec = self._actuators[i]
            unit = "m" if spec.kind is JointKind.PRISMATIC else "rad"
            text = f"{self.words(i)}: it {moved} {unit} {how}"
            self._report(Event("implausible", spec.name, text, stamp, "warning"))

    def _believe(self, stamp: float, active: Sequence[bool]) -> None:
        for i, doubt in list(self._doubted.items()):
            calm = stamp - doubt.stamp >= _CALM and not self._outside(i, self._last[i])
            if calm or not active[i]:
                del self._doubted[i]
                name = self._actuators[i].name
                text = f"the measured position of {name} is plausible again"
                self._report(Event("implausible", name, text, stamp))
