"""Interpolate smoothly between the samples of a stream, however late or irregular they are.

The path between two samples is a cubic Hermite polynomial. Where velocities are not given, they are
those of the parabola through the last three samples, limited so that nothing swings beyond the
samples: the shape-preserving end condition of PCHIP (Moler, "Numerical Computing with MATLAB",
section 3.6; Fritsch and Carlson 1980).

After the newest sample, the path continues for two periods at the sample's velocity, which then
falls smoothly to zero. Whenever the path jumps (the newest sample is passed, a sample arrives late,
a stream begins), the difference in position, velocity and acceleration is kept as an error that
decays to zero along a polynomial of degree five, so that the wanted position never jumps. Finally,
each actuator follows its wanted position within its limits on velocity, acceleration and position,
without waiting for the others.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rtee.loop.motion import MotionLimits, approach, bounded
from rtee.loop.profiles.s_curve import cube_root

_MOST = 64
"""Samples kept ahead of time, after which the oldest are dropped: an eighth of a second at 500 Hz,
longer than any usual lag."""

_LONGEST = 0.25
"""Longest time for an error to decay [s]: more would feel like a lag. Limits may extend it."""

_COAST = 2.0
"""Periods for which the path continues at the newest sample's velocity: enough to lose one sample
and receive the next one as late as the lag allows."""

_BRAKED = 5.0
"""Periods after the newest sample at which the velocity is zero: a stream that falls silent must
not carry the hand away."""

_BLEND = 3.0
"""Least periods for an error to decay: with jitter of 20 ms at 50 Hz, the jerk is half of that with
one period, and the path is off by 0.08 % instead of 0.07 %."""

_SHARE = 0.5
"""Share of the acceleration limit with which an actuator catches up; the rest is left for the
motion of the stream itself."""

_SPIKE = 10.0
"""A sample is an outlier if it needs more than this many times the velocity limit, in addition to
`_SPIKE_RANGE`: faster than any hand moves on purpose."""

_SPIKE_RANGE = 0.05
"""Travel that a sample may need in addition, as a share of the range: between samples with nearly
the same stamp, the velocity limit alone would allow none at all."""


Motion = tuple[float, float, float]
"""Position, velocity and acceleration [rad | m, per s, per s²]."""

_STILL: Motion = (0.0, 0.0, 0.0)

_Weights = tuple[float, float, float, float]
"""Weights of two samples' positions, and of their velocities [s]."""


@dataclass(slots=True)
class _Knot:
    time: float
    position: list[float]
    velocity: list[float]


class Interpolator:
    """The path of some actuators between the samples of a stream; pure.

    Args:
        limits: Limits of all actuators of the hand.
        tick: Period of the loop [s].

    Attributes:
        indices: The actuators that move, in the order of their first samples.
        newest: Time of the newest sample [s, the client's]; ``-inf``: none.
    """

    def __init__(self, limits: MotionLimits, tick: float) -> None:
        self._limits, self._tick = limits, tick
        self.indices: list[int] = []
        self.newest = -math.inf
        self._knots: deque[_Knot] = deque(maxlen=_MOST)
        self._wanted: list[float] = []
        self._error: list[tuple[Motion, float, float]] = []
        self._coasts = False
        self._fresh: dict[int, float] = {}
        self._now = 0.0

    def clear(self) -> None:
        """Forget all samples; the actuators are no longer moved."""
        self.indices, self._wanted, self._error = [], [], []
        self._coasts = False
        self._knots.clear()
        self._fresh.clear()
        self.newest = -math.inf

    def include(self, index: int, position: float, velocity: float) -> None:
        """Add an actuator, starting from its reference.

        Args:
            index: The actuator.
            position: Its reference [rad | m].
            velocity: Velocity of the reference [rad/s | m/s].
        """
        if not self.indices:
            self._now = math.inf  # so that the first step takes one period of the loop
        self._fresh[len(self.indices)] = velocity
        self.indices.append(index)
        self._wanted.append(position)
        self._error.append((_STILL, 0.0, 0.0))
        for knot in self._knots:
            # As if it had always been at its reference.
            knot.position.append(position)
            knot.velocity.append(0.0)

    def outlying(self, positions: Mapping[int, float], time: float) -> bool:
        """Return whether a sample is too far from the newest one to be intentional."""
        if not self._knots:
            return False
        last, limits = self._knots[-1], self._limits
        passed = time - last.time
        for place, index in enumerate(self.indices):
            position = positions.get(index)
            if position is None:
                continue
            span = limits.upper[index] - limits.lower[index]
            most = _SPIKE * limits.velocity[index] * passed
            most += _SPIKE_RANGE * span if math.isfinite(span) else 0.0
            if abs(limits.clamp(index, position) - last.position[place]) > most:
                return True
        return False

    def add(
        self,
        positions: Mapping[int, float],
        velocities: Mapping[int, float],
        time: float,
        play: float,
        now: float,
        period: float,
    ) -> None:
        """Add a sample that is newer than all others.

        Args:
            positions: Positions by actuator index [rad | m]; actuators left out stay.
            velocities: Velocities at these positions [rad/s | m/s]; ``NaN`` or left out: not given.
            time: Time of the sample, by the client's clock [s].
            play: Time that is played now, by the client's clock [s].
            now: The time by the hand's clock [s].
            period: Time between samples [s].
        """
        # A new sample changes the path even at the present, through the tangent at the last one.
        before = self._motions(play, period) if self._knots else [_STILL] * len(self.indices)
        for place, speed in self._fresh.items():
            before[place] = (self._wanted[place], speed, 0.0)
        self._fresh.clear()
        self._knots.append(self._knot(positions, velocities, time))
        self.newest = time
        # Played samples are discarded, except for the two that determine the velocity.
        while len(self._knots) > 3 and self._knots[2].time <= play:
            self._knots.popleft()
        self._jump(before, self._motions(play, period), now, period)
        self._coasts = play >= time

    def jumped(self, play: float, to: float, now: float, period: float) -> None:
        """Keep the wanted position continuous when the stream's time jumps to another one."""
        if not self._knots:
            return
        self._jump(self._motions(play, period), self._motions(to, period), now, period)
        self._coasts = to >= self.newest

    def _knot(
        self, positions: Mapping[int, float], velocities: Mapping[int, float], time: float
    ) -> _Knot:
        last = self._knots[-1] if self._knots else None
        where, speed = [], []
        for place, index in enumerate(self.indices):
            position = positions.get(index)
            if position is None:
                position = self._wanted[place] if last is None else last.position[place]
            position = self._limits.clamp(index, position)
            velocity = velocities.get(index, math.nan)
            if math.isnan(velocity):
                velocity = self._estimated(place, position, time)
            top = self._limits.velocity[index]
            where.append(position)
            speed.append(min(max(velocity, -top), top))
        return _Knot(time, where, speed)

    def _estimated(self, place: int, position: float, time: float) -> float:
        """Estimate an actuator's velocity at a new sample from the samples before it."""
        if not self._knots:
            return 0.0
        last = self._knots[-1]
        step = time - last.time
        slope = (position - last.position[place]) / step
        if len(self._knots) == 1 or slope == 0.0:
            return slope
        other = self._knots[-2]
        before = last.time - other.time
        earlier = (last.position[place] - other.position[place]) / before
        velocity = slope + (slope - earlier) * step / (step + before)
        # The conditions of PCHIP at an end: no overshoot beyond the samples.
        if velocity * slope <= 0.0:
            return 0.0
        if slope * earlier < 0.0 and abs(velocity) > 3.0 * abs(slope):
            return 3.0 * slope
        return velocity

    # --- the path ----------------------------------------------------------------------------

    def _base(self, play: float, period: float) -> tuple[_Knot, _Knot, tuple[_Weights, ...]]:
        """Return two samples and their weights in position, velocity and acceleration at a time."""
        knots = self._knots
        newest, first = knots[-1], knots[0]
        if play >= newest.time:
            return newest, newest, _coasting(play - newest.time, period)
        if play <= first.time:
            ahead = (1.0, 0.0, play - first.time, 0.0)
            return first, first, (ahead, (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 0.0))
        # Searched from the newest, since the lag is a period or two.
        right = len(knots) - 1
        while knots[right - 1].time > play:
            right -= 1
        left = knots[right - 1]
        return left, knots[right], _hermite(left.time, knots[right].time, play)

    def _motions(self, play: float, period: float) -> list[Motion]:
        """Return the motions on the path between the samples, without the error."""
        left, right, rows = self._base(play, period)
        return list(zip(*(_combined(left, right, row) for row in rows), strict=True))

    def _coast(self, now: float, period: float) -> None:
        """Begin to coast: the acceleration at the newest sample decays smoothly."""
        self._coasts = True
        if len(self._knots) < 2:
            return
        left, right = self._knots[-2], self._knots[-1]
        *_, weights = _hermite(left.time, right.time, right.time)
        before = [(0.0, 0.0, a) for a in _combined(left, right, weights)]
        self._jump(before, [_STILL] * len(before), now, period)

    def _jump(
        self, before: Sequence[Motion], after: Sequence[Motion], now: float, period: float
    ) -> None:
        """Turn a jump of the path into decaying errors, within the limits if possible.

        ``now`` is by the hand's clock [s], ``period`` the time between samples [s].
        """
        for place, index in enumerate(self.indices):
            if before[place] == after[place]:
                continue
            left = self._error_at(place, now)
            error, slope, bend = (
                e + b - a for e, b, a in zip(left, before[place], after[place], strict=True)
            )
            limits, size, speed = self._limits, abs(error), abs(slope)
            # Peaks of acceleration and jerk of the polynomials in `_error_at` over a time T:
            # 5.77·e/T² and 60·e/T³ for a position error e, 3.94·w/T and 36·w/T² for a velocity
            # error w. An error of the acceleration is largest at its start, whatever the time.
            acceleration = _SHARE * limits.acceleration[index]
            jerk = limits.jerk[index]
            time = max(
                _BLEND * period,
                math.sqrt(5.77 * size / acceleration),
                cube_root(60.0 * size / jerk),
                3.94 * speed / acceleration,
                math.sqrt(36.0 * speed / jerk),
            )
            self._error[place] = ((error, slope, bend), now, min(time, _LONGEST))

    def _error_at(self, place: int, now: float) -> Motion:
        """Return the remaining error of an actuator at a time of the hand's clock [s]."""
        (error, slope, bend), since, time = self._error[place]
        s = (now - since) / time if time > 0.0 else 1.0
        if s >= 1.0:
            return _STILL
        s = max(s, 0.0)
        # Three quintics, from (1, 0, 0), (0, 1, 0) and (0, 0, 1) to zero.
        slope *= time
        bend *= time * time
        rest, s2 = 1.0 - s, s * s
        position = (
            error * (1.0 - s2 * s * (10.0 - s * (15.0 - 6.0 * s)))
            + slope * s * (1.0 - s2 * (6.0 - s * (8.0 - 3.0 * s)))
            + bend * 0.5 * s2 * rest * rest * rest
        )
        velocity = (
            error * -30.0 * s2 * rest * rest
            + slope * (1.0 - s2 * (18.0 - s * (32.0 - 15.0 * s)))
            + bend * s * rest * rest * (1.0 - 2.5 * s)
        )
        acceleration = (
            error * -60.0 * s * rest * (1.0 - 2.0 * s)
            + slope * -12.0 * s * rest * (3.0 - 5.0 * s)
            + bend * rest * (1.0 - s * (8.0 - 10.0 * s))
        )
        return position, velocity / time, acceleration / (time * time)

    def step(
        self,
        play: float,
        now: float,
        period: float,
        position: Sequence[float],
        velocity: Sequence[float],
        into: list[float],
    ) -> None:
        """Advance the actuators by one period of the loop.

        Args:
            play: Time that is played, by the client's clock [s].
            now: Due time of the tick, by the hand's clock [s].
            period: Time between samples [s].
            position: Positions sent last, of all actuators [rad | m].
            velocity: Their velocities [rad/s | m/s].
            into: Receives the positions to send, of the moving actuators [rad | m].
        """
        limits, dt, wanted = self._limits, self._tick, self._wanted
        # After missed ticks the wanted position is further away, but no faster.
        passed, self._now = max(now - self._now, dt), now
        if play >= self.newest and not self._coasts:
            self._coast(now, period)
        left, right, (weights, _, _) = self._base(play, period)
        base = _combined(left, right, weights)
        for place, index in enumerate(self.indices):
            target = base[place]
            if now < self._error[place][1] + self._error[place][2]:
                target += self._error_at(place, now)[0]
            last, wanted[place] = wanted[place], target
            here, acceleration = position[index], limits.acceleration[index]
            speed = (target - last) / passed
            behind = last - here
            if abs(behind) > _EXACT:
                speed += approach(here, last, _SHARE * acceleration, dt)
            else:
                speed += behind / dt
            allowed = bounded(
                here,
                velocity[index],
                speed,
                dt,
                limits.velocity[index],
                acceleration,
                limits.lower[index],
                limits.upper[index],
            )
            into[index] = here + allowed * dt


_EXACT = 1e-12
"""A smaller distance to the last wanted position counts as rounding [rad | m]."""


def _combined(left: _Knot, right: _Knot, weights: _Weights) -> list[float]:
    """Return the weighted sums of two samples' positions and velocities."""
    a, b, c, d = weights
    return [
        a * p0 + b * p1 + c * v0 + d * v1
        for p0, p1, v0, v1 in zip(
            left.position, right.position, left.velocity, right.velocity, strict=True
        )
    ]


def _coasting(passed: float, period: float) -> tuple[_Weights, ...]:
    """Return the weights of the newest sample at a time after it [s]."""
    alone = _COAST * period
    if passed <= alone:
        return (1.0, 0.0, passed, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 0.0)
    span = (_BRAKED - _COAST) * period
    s = min((passed - alone) / span, 1.0)
    time = alone + span * s * (1.0 - s * s * (1.0 - 0.5 * s))
    share = 1.0 - s * s * (3.0 - 2.0 * s)
    slope = -6.0 * s * (1.0 - s) / span
    return (1.0, 0.0, time, 0.0), (0.0, 0.0, share, 0.0), (0.0, 0.0, slope, 0.0)


def _hermite(begin: float, end: float, play: float) -> tuple[_Weights, ...]:
    """Return the weights of two samples on the cubic between them, by their times [s]."""
    h = end - begin
    s = (play - begin) / h
    s2 = s * s
    a, da, dda = s2 * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s) / h, 6.0 * (1.0 - 2.0 * s) / (h * h)
    return (
        (1.0 - a, a, s * (1.0 - s) * (1.0 - s) * h, s2 * (s - 1.0) * h),
        (-da, da, (1.0 - s) * (1.0 - 3.0 * s), s * (3.0 * s - 2.0)),
        (-dda, dda, (6.0 * s - 4.0) / h, (6.0 * s - 2.0) / h),
    )
