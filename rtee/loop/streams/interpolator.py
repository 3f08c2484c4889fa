"""Interpolate smoothly between the samples of a stream, however late or irregular they are.

The path between two samples is a cubic Hermite polynomial. Where velocities are not given, they are
those of the parabola through the last three samples, limited so that nothing swings beyond the
samples: the shape-preserving end condition of PCHIP (Moler, "Numerical Computing with MATLAB",
section 3.6; Fritsch and Carlson 1980).

After the newest sample its velocity goes on for two periods and then falls smoothly to nothing.
Whenever that makes the way jump (the newest sample is passed, a sample comes after its turn, a
stream begins), the difference of position, velocity and acceleration is kept as an error that falls
to nothing along a polynomial of degree five, so that what is wanted never jumps. Finally each
actuator follows what is wanted within its limits on velocity, acceleration and position, by itself:
none waits for another one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rtee.loop.motion import Limits, approach, bounded
from rtee.loop.profiles.phases import cube_root

_MOST = 64
"""Samples kept ahead of time; further ones push out the oldest: an eighth of a second at 500 Hz,
more than a usual lag holds."""

_LONGEST = 0.25
"""An error falls to zero within this time [s] at most: longer would feel like a lag. Limits may
still make it take longer."""

_COAST = 2.0
"""After the newest sample its velocity goes on for so many periods: one sample may be lost, and the
next one come as late as the lag allows …"""

_BRAKED = 5.0
"""… and is zero after this many at most: a stream that falls silent must not carry the hand
away."""

_BLEND = 3.0
"""An error takes at least so many periods to fall to nothing: with jitter of 20 ms at 50 Hz, the
jerk is half of that with one period, and the way is off by 0.08 % instead of 0.07 %."""

_SHARE = 0.5
"""Share of the acceleration limit with which an actuator catches up with what it lags behind; the
rest is left for what the stream itself asks for."""

_SPIKE = 10.0
"""A sample is an outlier if it asks for this many times the velocity limit, and beyond that …"""

_SPIKE_RANGE = 0.05
"""… for more than this share of the range: faster than any hand moves on purpose."""


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
        indices: The actuators that move, in the order in which they came.
        newest: Time of the newest sample [s, the client's]; ``-inf``: none.
    """

    def __init__(self, limits: Limits, tick: float) -> None:
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
        """Move a further actuator, from its reference.

        Args:
            index: The actuator.
            position: Its reference [rad | m].
            velocity: The reference's velocity [rad/s | m/s].
        """
        if not self.indices:
            self._now = math.inf  # the first step is one of a tick
        self._fresh[len(self.indices)] = velocity
        self.indices.append(index)
        self._wanted.append(position)
        self._error.append((_STILL, 0.0, 0.0))
        for knot in self._knots:
            # As if it had been at its reference all the time.
            knot.position.append(position)
            knot.velocity.append(0.0)

    def outlying(self, positions: Mapping[int, float], time: float) -> bool:
        """Return whether a sample is too far from the newest one to be intended."""
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
        """Take a sample that is newer than all others.

        Args:
            positions: Where to, by actuator [rad | m]; those that are left out stay.
            velocities: How fast there [rad/s | m/s]; ``NaN`` or left out: not given.
            time: Its time [s, the client's].
            play: What is played now [s, the client's].
            now: The time [s, the hand's].
            period: Time between samples [s].
        """
        # A new sample changes the path even at the present, since its velocity changes the tangent.
        before = self._motions(play, period) if self._knots else [_STILL] * len(self.indices)
        for place, speed in self._fresh.items():
            before[place] = (self._wanted[place], speed, 0.0)
        self._fresh.clear()
        self._knots.append(self._knot(positions, velocities, time))
        self.newest = time
        self._forget(play)
        self._jump(before, self._motions(play, period), now, period)
        self._coasts = play >= time

    def jumped(self, play: float, to: float, now: float, period: float) -> None:
        """Keep the wanted position unchanged although the stream's time jumps."""
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
        """Return the velocity at the newest sample, from those before."""
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

    def _forget(self, play: float) -> None:
        """Forget the samples that have been played; the two before now give the velocity."""
        while len(self._knots) > 3 and self._knots[2].time <= play:
            self._knots.popleft()

    # --- the way -----------------------------------------------------------------------------

    def _base(self, play: float, period: float) -> tuple[_Knot, _Knot, tuple[_Weights, ...]]:
        """Return two samples, and how position, velocity and acceleration at a time follow."""
        knots = self._knots
        newest, first = knots[-1], knots[0]
        if play >= newest.time:
            return newest, newest, _coasting(play - newest.time, period)
        if play <= first.time:
            ahead = (1.0, 0.0, play - first.time, 0.0)
            return first, first, (ahead, (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 0.0))
        # From the newest: the lag is a period or two.
        right = len(knots) - 1
        while knots[right - 1].time > play:
            right -= 1
        left = knots[right - 1]
        return left, knots[right], _hermite(left.time, knots[right].time, play)

    def _positions(self, play: float, period: float) -> list[float]:
        """Return positions on the way between the samples, without the error."""
        left, right, (weights, _, _) = self._base(play, period)
        return _combined(left, right, weights)

    def _motions(self, play: float, period: float) -> list[Motion]:
        """Return the motions on the way between the samples, without the error."""
        left, right, rows = self._base(play, period)
        return list(zip(*(_combined(left, right, row) for row in rows), strict=True))

    def _coast(self, now: float, period: float) -> None:
        """Begin to coast: the acceleration that leads to the newest sample ends smoothly."""
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
        """Let the errors that a jump of the way makes fall to nothing, within limits if possible.

        Args:
            before: Motions of all that move, as they were.
            after: Motions as they are from now on.
            now: The time [s, the hand's].
            period: Time between samples [s].
        """
        for place, index in enumerate(self.indices):
            if before[place] == after[place]:
                continue
            left = self._error_at(place, now)
            error, slope, bend = (
                e + b - a for e, b, a in zip(left, before[place], after[place], strict=True)
            )
            limits, size, speed = self._limits, abs(error), abs(slope)
            # Peaks of the polynomials of `_error_at` over time T: 5.77·e/T² and 60·e/T³ from an
            # error e of the position, 3.94·w/T and 36·w/T² from one of the velocity w. One of the
            # acceleration is greatest where it begins, so that no time makes it less.
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
        """Return what is left of an error at a time [s, the hand's]."""
        (error, slope, bend), since, time = self._error[place]
        s = (now - since) / time if time > 0.0 else 1.0
        if s >= 1.0:
            return _STILL
        s = max(s, 0.0)
        # Degree five, from (1, 0, 0), (0, 1, 0) and (0, 0, 1) to nothing.
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
        """Move the actuators on by one period of the loop.

        Args:
            play: What is played [s, the client's].
            now: When the tick is due [s, the hand's].
            period: Time between samples [s].
            position: Positions sent last, of all actuators [rad | m].
            velocity: Their velocities [rad/s | m/s].
            into: Takes the positions to be sent, of those that move [rad | m].
        """
        limits, dt, wanted = self._limits, self._tick, self._wanted
        # After missed ticks the wanted position is further away, but not faster.
        passed, self._now = max(now - self._now, dt), now
        if play >= self.newest and not self._coasts:
            self._coast(now, period)
        base = self._positions(play, period)
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
"""Nearer than this [rad | m] to what was wanted last counts as there: rounding."""


def _combined(left: _Knot, right: _Knot, weights: _Weights) -> list[float]:
    """Return the sums of two samples' positions and velocities, each by its weight."""
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
    way = alone + span * s * (1.0 - s * s * (1.0 - 0.5 * s))
    left = 1.0 - s * s * (3.0 - 2.0 * s)
    return (1.0, 0.0, way, 0.0), (0.0, 0.0, left, 0.0), (0.0, 0.0, -6.0 * s * (1.0 - s) / span, 0.0)


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
