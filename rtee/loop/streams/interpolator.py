"""Interpolate smoothly between the samples of a stream, however late or irregular they are.

The path between two samples is a cubic Hermite polynomial. Where velocities are not given, they are
those of the parabola through the last three samples, limited so that nothing swings beyond the
samples: the shape-preserving end condition of PCHIP (Moler, "Numerical Computing with MATLAB",
section 3.6; Fritsch and Carlson 1980).

After the newest sample its velocity continues for a period and then falls smoothly to zero.
Whenever that makes the path jump (a sample comes late, a stream begins), the difference in
position and velocity is kept as an error that falls to zero along a polynomial of degree five,
so that the wanted position never jumps. Finally each actuator follows it within its limits on
velocity, acceleration and position, independently: none waits for another one.
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

_COAST = 1.0
"""After the newest sample its velocity continues for this many periods: one sample may be lost …"""

_BRAKED = 5.0
"""… and is zero after this many at most: a stream that falls silent must not carry the hand
away."""

_SHARE = 0.5
"""Share of the acceleration limit with which an actuator catches up with what it lags behind; the
rest is left for what the stream itself asks for."""

_SPIKE = 10.0
"""A sample is an outlier if it asks for this many times the velocity limit, and beyond that …"""

_SPIKE_RANGE = 0.05
"""… for more than this share of the range: faster than any hand moves on purpose."""


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
        self._error: list[tuple[float, float, float, float]] = []
        self._fresh: dict[int, float] = {}
        self._now = 0.0

    def clear(self) -> None:
        """Forget all samples; the actuators are no longer moved."""
        self.indices, self._wanted, self._error = [], [], []
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
        self._error.append((0.0, 0.0, 0.0, 0.0))
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
        before = self._base(play, period) if self._knots else [(0.0, 0.0)] * len(self.indices)
        for place, speed in self._fresh.items():
            before[place] = (self._wanted[place], speed)
        self._fresh.clear()
        self._knots.append(self._knot(positions, velocities, time))
        self.newest = time
        self._forget(play)
        after = self._base(play, period)
        for place, index in enumerate(self.indices):
            if before[place] != after[place]:
                self._jump(place, index, before[place], after[place], now, period)

    def jumped(self, play: float, to: float, now: float, period: float) -> None:
        """Keep the wanted position unchanged although the stream's time jumps."""
        if not self._knots:
            return
        before, after = self._base(play, period), self._base(to, period)
        for place, index in enumerate(self.indices):
            self._jump(place, index, before[place], after[place], now, period)

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

    def _base(self, play: float, period: float) -> list[tuple[float, float]]:
        """Return position and velocity of the path between the samples, without the error."""
        knots = self._knots
        newest = knots[-1]
        if play >= newest.time:
            way, share = self._coasting(play - newest.time, period)
            return [
                (p + v * way, v * share)
                for p, v in zip(newest.position, newest.velocity, strict=True)
            ]
        first = knots[0]
        if play <= first.time:
            ahead = play - first.time
            return [(p + v * ahead, v) for p, v in zip(first.position, first.velocity, strict=True)]
        # From the newest: the lag is a period or two.
        right = len(knots) - 1
        while knots[right - 1].time > play:
            right -= 1
        return _hermite(knots[right - 1], knots[right], play)

    @staticmethod
    def _coasting(passed: float, period: float) -> tuple[float, float]:
        """Return how far the newest velocity leads [s], and what is left of it (0 to 1)."""
        alone = _COAST * period
        if passed <= alone:
            return passed, 1.0
        span = (_BRAKED - _COAST) * period
        s = min((passed - alone) / span, 1.0)
        return alone + span * s * (1.0 - s * s * (1.0 - 0.5 * s)), 1.0 - s * s * (3.0 - 2.0 * s)

    def _jump(
        self,
        place: int,
        index: int,
        before: tuple[float, float],
        after: tuple[float, float],
        now: float,
        period: float,
    ) -> None:
        """Let the error that a jump of the path makes fall to zero, within limits if possible."""
        error, slope = self._error_at(place, now)
        error += before[0] - after[0]
        slope += before[1] - after[1]
        limits, size, speed = self._limits, abs(error), abs(slope)
        # Peaks of the polynomials of `_error_at` over time T: 5.77·e/T² and 60·e/T³ from an error e
        # of the position, 3.94·w/T and 36·w/T² from one of the velocity w.
        acceleration = _SHARE * limits.acceleration[index]
        jerk = limits.jerk[index]
        time = max(
            period,
            math.sqrt(5.77 * size / acceleration),
            cube_root(60.0 * size / jerk),
            3.94 * speed / acceleration,
            math.sqrt(36.0 * speed / jerk),
        )
        self._error[place] = (error, slope, now, min(time, _LONGEST))

    def _error_at(self, place: int, now: float) -> tuple[float, float]:
        """Return what is left of the error of position and velocity at a time [s, the hand's]."""
        error, slope, since, time = self._error[place]
        s = (now - since) / time if time > 0.0 else 1.0
        if s >= 1.0:
            return 0.0, 0.0
        s = max(s, 0.0)
        # Degree five, from (1, 0, 0) and (0, 1, 0) to nothing: position, velocity, acceleration.
        cube = s * s * s
        fall = 1.0 - cube * (10.0 - s * (15.0 - 6.0 * s))
        falling = -30.0 * s * s * (1.0 - s) * (1.0 - s)
        swing = s - cube * (6.0 - s * (8.0 - 3.0 * s))
        swinging = 1.0 - s * s * (18.0 - s * (32.0 - 15.0 * s))
        return (
            error * fall + slope * time * swing,
            error * falling / time + slope * swinging,
        )

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
        base = self._base(play, period)
        for place, index in enumerate(self.indices):
            target = base[place][0]
            if now < self._error[place][2] + self._error[place][3]:
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


def _hermite(left: _Knot, right: _Knot, play: float) -> list[tuple[float, float]]:
    """Return position and velocity on the cubics between two samples."""
    h = right.time - left.time
    s = (play - left.time) / h
    s2 = s * s
    a = s2 * (3.0 - 2.0 * s)
    b, c = s * (1.0 - s) * (1.0 - s) * h, s2 * (s - 1.0) * h
    da = 6.0 * s * (1.0 - s) / h
    db, dc = (1.0 - s) * (1.0 - 3.0 * s), s * (3.0 * s - 2.0)
    return [
        (p0 + a * (p1 - p0) + b * v0 + c * v1, da * (p1 - p0) + db * v0 + dc * v1)
        for p0, v0, p1, v1 in zip(
            left.position, left.velocity, right.position, right.velocity, strict=True
        )
    ]
