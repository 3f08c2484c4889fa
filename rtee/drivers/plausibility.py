"""Judge measured positions: could an actuator have reached them, may a reference start from them?

`Plausibility.start` alone decides whether a reference may start from a measurement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

from rtee.types import ActuatorSpec, Event, JointKind, Mechanism

MARGIN = 5.0
"""Plausible speed of an actuator, in multiples of its velocity limit: that limit applies to
set-points, and an actuator that is pushed, slips or catches up exceeds it."""

_SPARE = 0.1
"""Extra time at that speed, added to the time between two measurements [s], which are older than
the ticks that collect them. It covers half a second at the velocity limit; a device that is silent
for longer is lost."""

_SLACK = 0.05
"""Additional travel, as a share of the range, for a coarse sensor or an object that slips."""

_OUTSIDE = 0.5
"""A position further outside of its limits than this share of the range, and outside of what its
mechanism reaches, is implausible. Devices do come to rest outside of the limits, which are often
narrower than the mechanism."""

_CALM = 0.5
"""A position is plausible again after this time without an implausible step [s]: long enough for
several exchanges of the slowest device."""

_PERSISTENT = 5
"""This many implausible steps with less than `_CALM` between them are not a glitch. A position
outside of the limits does not count as a step: an actuator may come back from there."""

_LEAP = 0.02
"""A measured step of more than this share of the range is a leap: possible where an actuator is
measured rarely, but nearly every step between random positions is one."""

_AGREEING = 2.5
"""After a leap, an actuator counts as arrived once no other leap follows for this many intervals
between measurements: two more measurements agree, even if they are late."""


_BESIDE = 0.05
"""A leap that ends further than this beside the way to the reference, as a share of the range,
leads astray: overshoot and play are less. It may be a glitch of the encoder."""

_OLD = 0.05
"""Age above which no reference may start from a measurement [s], except for devices that are
measured less often: at 2 rad/s, an actuator moves 0.1 rad in this time."""

_OLD_INTERVALS = 2.5
"""A measurement of such a device is too old after this many usual intervals: by then one was
missed, and the next one is late."""

_LONGEST_INTERVAL = 0.25
"""A longer time between two measurements is not an interval, but a silence [s]."""

_WEIGHT = 0.125
"""Weight of the newest interval in their mean, which follows a change within 8 intervals."""

_FROZEN = 0.01
"""An encoder looks frozen if its value has not changed at all while the reference has moved by this
share of the range: friction and play hide less than that."""


@dataclass(slots=True)
class _Doubt:
    """Time of the last implausible measurement [s], and the number of implausible steps."""

    stamp: float
    steps: int = 0


class Plausibility:
    """Watches the measured positions for steps that no actuator can make.

    Every actuator has an allowance of travel, which grows with time at `MARGIN` times the velocity
    limit and is reduced by each measured step. So measurements may be sparse, late or bunched.

    Args:
        actuators: The actuators.
        report: Called with events.
        mechanisms: Where each may stand, though its limits are narrower.
    """

    def __init__(
        self,
        actuators: Sequence[ActuatorSpec],
        report: Callable[[Event], object],
        mechanisms: Sequence[Mechanism],
    ) -> None:
        self._actuators = actuators
        self._report = report
        n = len(actuators)
        spans = [a.upper - a.lower for a in actuators]
        slack = [_SLACK * span if math.isfinite(span) else _SLACK for span in spans]
        self._rate = [MARGIN * a.velocity for a in actuators]
        self._most = [_SPARE * r + s for r, s in zip(self._rate, slack, strict=True)]
        self._lowest, self._highest = [], []
        for a, span, ends in zip(actuators, spans, mechanisms, strict=True):
            self._lowest.append(min(a.lower - _OUTSIDE * span, ends.lower))
            self._highest.append(max(a.upper + _OUTSIDE * span, ends.upper))
        self._last = [math.nan] * n
        self._left = list(self._most)
        self._changed = [-math.inf] * n
        self._leap = [_LEAP * span if math.isfinite(span) else _LEAP for span in spans]
        self._beside = [_BESIDE * span if math.isfinite(span) else _BESIDE for span in spans]
        self._leaping_until = [-math.inf] * n
        self._astray_until = [-math.inf] * n
        self._seen = [-math.inf] * n
        self._unseen: set[int] = set()
        self._all_seen = -math.inf
        self._doubted: dict[int, _Doubt] = {}
        self._usual = [0.0] * n
        self._all_usual = 0.0
        self._reference = [math.nan] * n
        self._still = [_FROZEN * span if math.isfinite(span) else _FROZEN for span in spans]

    def forget(self, indices: Collection[int]) -> None:
        """Forget the positions of some actuators, which people may have moved meanwhile."""
        self._unseen.update(indices)
        for i in indices:
            self._last[i] = math.nan
            self._leaping_until[i] = self._astray_until[i] = -math.inf
            self._doubted.pop(i, None)

    def doubted(self, indices: Iterable[int]) -> bool:
        """Return whether any of the given actuators has an implausible measured position."""
        return bool(self._doubted) and any(i in self._doubted for i in indices)

    def leaping(self, indices: Iterable[int], stamp: float) -> bool:
        """Return whether the position of any of the given actuators is unsettled after a leap.

        The leap may be plausible, but too few later measurements agree with it yet.
        """
        return any(stamp < self._leaping_until[i] for i in indices)

    def broken(self, indices: Iterable[int]) -> int | None:
        """Return the first given actuator whose position is persistently implausible."""
        for i in indices if self._doubted else ():
            if i in self._doubted and self._doubted[i].steps >= _PERSISTENT:
                return i
        return None

    def start(
        self, i: int, stamp: float, reference: float, *, touching: bool = False
    ) -> float | None:
        """Return the measured position of an actuator if a reference may start from it.

        ``None``: it was not measured since `forget`, or the measurement is invalid, old or
        implausible, has just leaped beside the way to the reference, or the encoder looks frozen.
        Then the reference must brake where it is.

        Args:
            i: The actuator.
            stamp: Now [s].
            reference: The position sent to it last [rad | m].
            touching: Whether something other than the position shows that the actuator presses
                against an object, which keeps it as still as a frozen encoder.
        """
        here = self._last[i]
        # True for NaN, too.
        if not self._lowest[i] <= here <= self._highest[i] or i in self._doubted:
            return None
        if stamp < self._astray_until[i] or i in self._unseen:
            return None
        limit = self._limit(i)
        if stamp - max(self._seen[i], self._all_seen) > limit:
            return None
        away = abs(reference - self._reference[i])
        if not touching and away > self._still[i] and stamp - self._changed[i] > limit:
            return None
        return here

    def started(self, i: int, reference: float) -> None:
        """Record that the reference of an actuator was set to a position [rad | m]."""
        self._reference[i] = reference

    def words(self, i: int) -> str:
        """Describe an actuator's implausible position; return an empty string if plausible."""
        name = self._actuators[i].name
        return f"the measured position of {name} is not plausible" if i in self._doubted else ""

    def step(
        self,
        stamp: float,
        position: Sequence[float],
        fresh: Sequence[bool],
        active: Sequence[bool],
        reference: Sequence[float],
    ) -> None:
        """Check the measured positions of a tick.

        Args:
            stamp: Now [s].
            position: Measured positions [rad | m].
            fresh: Whether each is newer than at the tick before.
            active: Whether its device drives an actuator; people may move the others.
            reference: Positions sent last [rad | m].
        """
        last, unseen = self._last, self._unseen
        if position != last:  # the only test needed for a hand at rest
            for i, here in enumerate(position):
                # An old position must not make the first new one look like a leap.
                if here != last[i] and (fresh[i] or i not in unseen):
                    self._moved(i, here, stamp, active[i], reference[i])
                    last[i] = here
                    self._reference[i] = reference[i]
        if all(fresh):
            # Usually all are fresh: one time for all instead of a list of equal times.
            if stamp - self._all_seen > _OLD:
                self._heard_again(range(len(position)), stamp, reference)
            self._all_usual = _usual(self._all_usual, stamp - self._all_seen)
            self._all_seen = stamp
        else:
            for i, new in enumerate(fresh):
                if new:
                    before = max(self._seen[i], self._all_seen)
                    if stamp - before > _OLD:
                        self._heard_again((i,), stamp, reference)
                    self._usual[i] = _usual(self._usual[i], stamp - before)
                    self._seen[i] = stamp
        if self._unseen:
            self._unseen = {i for i in self._unseen if not fresh[i]}
        if self._doubted:
            self._believe(stamp, active)

    def _heard_again(
        self, indices: Iterable[int], stamp: float, reference: Sequence[float]
    ) -> None:
        """Let actuators that were not measured in time look frozen only by what follows."""
        for i in indices:
            if stamp - max(self._seen[i], self._all_seen) > self._limit(i):
                # While their device was silent, it may not have received the reference, either.
                self._reference[i] = reference[i]

    def _limit(self, i: int) -> float:
        """Return the age above which an actuator's measurement is too old to start from [s]."""
        return max(_OLD, _OLD_INTERVALS * max(self._usual[i], self._all_usual))

    def _moved(self, i: int, here: float, stamp: float, active: bool, wanted: float) -> None:
        # Called for each actuator at each tick of a motion, so min() and max() are written out.
        travel, most = abs(here - self._last[i]), self._most[i]
        if travel != travel or not active:  # the first measurement, or an undriven actuator
            self._left[i] = most
            if active and self._outside(i, here):
                self._doubt(i, stamp, f"is at {here:.3g}", "far outside of its limits", step=False)
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
            if travel > self._leap[i]:
                # A device may repeat an answer until it has a new one.
                repeated = min(stamp - self._changed[i], _SPARE)
                # After a silence, as of an unplugged cable, measurements are as frequent as before.
                interval = min(stamp - before, _LONGEST_INTERVAL)
                self._leaping_until[i] = stamp + _AGREEING * max(interval, repeated)
                low, high = sorted((self._last[i], wanted))
                beside = self._beside[i]
                # After a silence, others may have moved it: this is no glitch.
                silent = stamp - before > self._limit(i)
                if not (silent or low - beside <= here <= high + beside):
                    self._astray_until[i] = self._leaping_until[i]
            rest = left + rate * (stamp - before) - travel
            self._left[i] = most if rest > most else rest if rest > 0.0 else 0.0
            if rest < 0.0:
                late = f"within {(stamp - before) * 1e3:.3g} ms"
                self._doubt(i, stamp, f"moved {travel:.3g}", late, step=True)
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


def _usual(before: float, interval: float) -> float:
    """Return the usual interval between measurements, updated with the newest one [s]."""
    if interval > _LONGEST_INTERVAL:
        return before
    return before + _WEIGHT * (interval - before)
