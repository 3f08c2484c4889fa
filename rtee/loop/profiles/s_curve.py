"""A jerk-limited profile in pure Python: the default where ruckig is not installed."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

from rtee.loop.motion import MotionLimits
from rtee.loop.profiles.base import Profile

_SEARCH = 40
"""Largest number of steps of a search: five to ten are usual, and a bisection would need 40."""

_NOTHING = 1e-12
"""A shorter distance counts as zero [rad | m]: it is far below the resolution of any device."""

Phase = tuple[float, float]
"""Duration [s] and jerk [rad/s³ | m/s³]."""

State = tuple[float, float, float]
"""Position [rad | m], velocity [rad/s | m/s] and acceleration [rad/s² | m/s²]."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Limits of one motion.

    Attributes:
        velocity: Largest velocity [rad/s | m/s].
        acceleration: Largest acceleration [rad/s² | m/s²].
        jerk: Largest jerk [rad/s³ | m/s³].
    """

    velocity: float
    acceleration: float
    jerk: float


def moved(state: State, time: float, jerk: float) -> State:
    """Return the state after some time of constant jerk."""
    p, v, a = state
    return (
        p + time * (v + time * (a / 2.0 + time * jerk / 6.0)),
        v + time * (a + time * jerk / 2.0),
        a + time * jerk,
    )


class PhasedMotion:
    """A motion from a state through a sequence of phases.

    Attributes:
        duration: Its duration [s].
        end: Its last position [rad | m].
    """

    __slots__ = ("_ends", "_jerks", "_phase", "_starts", "duration", "end")

    def __init__(self, begin: State, phases: Iterable[Phase]) -> None:
        self._ends: list[float] = []
        self._starts: list[State] = []
        self._jerks: list[float] = []
        self._phase = 0
        time, state = 0.0, begin
        for duration, jerk in phases:
            if duration <= 0.0:
                continue
            self._starts.append(state)
            self._jerks.append(jerk)
            time += duration
            self._ends.append(time)
            state = moved(state, duration, jerk)
        self.duration = time
        self.end = state[0]

    def at(self, time: float) -> State:
        """Return the state at a time [s], which must not decrease from call to call."""
        # The phase is kept between calls: time only increases, so no search is needed.
        while time >= self._ends[self._phase] and self._phase + 1 < len(self._ends):
            self._phase += 1
        k = self._phase
        begin = self._ends[k - 1] if k else 0.0
        return moved(self._starts[k], time - begin, self._jerks[k])


def velocity_change(velocity: float, acceleration: float, to: float, bounds: Bounds) -> list[Phase]:
    """Return the fastest phases to another velocity with zero acceleration."""
    jerk, most = bounds.jerk, bounds.acceleration
    # The final velocity if the acceleration were only brought to zero.
    by_itself = velocity + acceleration * abs(acceleration) / (2.0 * jerk)
    sign = 1.0 if to >= by_itself else -1.0
    rise, begin = sign * (to - velocity), sign * acceleration
    # The velocity gained while the acceleration goes from begin to peak and back to zero.
    peak = math.sqrt(max(0.0, jerk * rise + begin * begin / 2.0))
    even = 0.0
    if peak > most:
        peak = most
        even = max(0.0, (rise - (2.0 * most * most - begin * begin) / (2.0 * jerk)) / most)
    return [
        (max(0.0, (peak - begin) / jerk), sign * jerk),
        (even, 0.0),
        (peak / jerk, -sign * jerk),
    ]


def stopping_time(velocity: float, bounds: Bounds) -> float:
    """Return the time to stop from a constant velocity [s]; the distance is v·t / 2."""
    speed, most, jerk = abs(velocity), bounds.acceleration, bounds.jerk
    if speed * jerk >= most * most:
        return speed / most + most / jerk
    return 2.0 * math.sqrt(speed / jerk)


class TargetMotions:
    """All motions from a state to a target that reach one velocity, keep it, and then stop.

    The higher that velocity, the shorter the motion, up to the velocity that is reached but not
    kept: that motion is the fastest.

    Args:
        state: The initial state.
        target: The final position [rad | m].
        bounds: Limits.
        fine: Error of the duration at which a search may stop [s].

    Attributes:
        velocity: The velocity reached in the fastest motion [rad/s | m/s]; 0: it only stops.
        duration: Duration of the fastest motion [s].
    """

    def __init__(self, state: State, target: float, bounds: Bounds, fine: float) -> None:
        self._state = state
        self._target = target
        self._bounds = bounds
        self._fine = fine
        left, stop = self._left(0.0)
        self._sign = 1.0 if left >= 0.0 else -1.0
        self._rest = state[1] == 0.0 and state[2] == 0.0
        if abs(left) <= _NOTHING:
            self.velocity, self.duration = 0.0, stop
            return
        speed = self._fastest_from_rest(abs(left)) if self._rest else self._fastest(abs(left))
        self.velocity = self._sign * speed
        self.duration = self._duration(speed)

    def motion(self, duration: float | None = None) -> PhasedMotion:
        """Return the motion that takes a given time.

        Args:
            duration: The time [s]; ``None``, or less than the fastest motion takes: the fastest.
                The fastest is also returned close to the target at high speed, where a slower
                motion would pass the target.
        """
        if duration is None or duration <= self.duration + self._fine or self.velocity == 0.0:
            return PhasedMotion(self._state, self._phases(self.velocity))
        if self._rest:  # the same motion, stretched in time, keeps all limits
            # Stretched by s, velocity falls by s, acceleration by s² and jerk by s³.
            slower = self.duration / duration
            phases = self._phases(self.velocity)
            return PhasedMotion(
                self._state, ((t / slower, j * slower * slower * slower) for t, j in phases)
            )
        velocity = self._sign * self._speed_for(duration)
        passes = self._sign * self._left(velocity)[0] < 0.0
        return PhasedMotion(self._state, self._phases(self.velocity if passes else velocity))

    def _phases(self, velocity: float) -> list[Phase]:
        _, speed, acceleration = self._state
        phases = velocity_change(speed, acceleration, velocity, self._bounds)
        if velocity != 0.0:
            left = self._sign * self._left(velocity)[0]
            phases.append((max(0.0, left / abs(velocity)), 0.0))
            phases += velocity_change(velocity, 0.0, 0.0, self._bounds)
        return phases

    def _left(self, velocity: float) -> tuple[float, float]:
        """Return the distance left after reaching a velocity without keeping it, and the time."""
        # Repeats `velocity_change` and `moved` instead of calling them: the searches call this.
        p, v, a = self._state
        bounds = self._bounds
        most, jerk = bounds.acceleration, bounds.jerk
        sign = 1.0 if velocity >= v + a * abs(a) / (2.0 * jerk) else -1.0
        rise, begin = sign * (velocity - v), sign * a
        squared = jerk * rise + begin * begin / 2.0
        if squared > most * most:
            peak = most
            even = max(0.0, (rise - (2.0 * most * most - begin * begin) / (2.0 * jerk)) / most)
        else:
            peak = math.sqrt(squared) if squared > 0.0 else 0.0
            even = 0.0
        first, last = max(0.0, (peak - begin) / jerk), peak / jerk
        jerk *= sign
        p += first * (v + first * (a / 2.0 + first * jerk / 6.0))
        v += first * (a + first * jerk / 2.0)
        a += first * jerk
        p += even * (v + even * a / 2.0)
        v += even * a
        p += last * (v + last * (a / 2.0 - last * jerk / 6.0))
        stop = stopping_time(velocity, bounds)
        return self._target - p - velocity * stop / 2.0, first + even + last + stop

    def _duration(self, speed: float) -> float:
        left, time = self._left(self._sign * speed)
        return time + max(0.0, self._sign * left / speed)

    def _fastest_from_rest(self, distance: float) -> float:
        bounds = self._bounds
        most, jerk = bounds.acceleration, bounds.jerk
        if distance * jerk * jerk <= 2.0 * most * most * most:  # never at full acceleration
            speed = cube_root(distance * distance * jerk / 4.0)
        else:
            delay = most / jerk
            speed = (math.sqrt(delay * delay + 4.0 * distance / most) - delay) * most / 2.0
        return min(speed, bounds.velocity)

    def _fastest(self, distance: float) -> float:
        """Return the highest speed that does not pass the target, ``distance`` beyond a stop."""
        high = self._bounds.velocity
        left_high = self._sign * self._left(self._sign * high)[0]
        if left_high >= 0.0:
            return high
        low, left_low = 0.0, distance
        _, velocity, acceleration = self._state
        by_itself = velocity + acceleration * abs(acceleration) / (2.0 * self._bounds.jerk)
        # Split the search at the velocity left once the acceleration is zero, a kink.
        if 0.0 < self._sign * by_itself < high:
            left = self._sign * self._left(by_itself)[0]
            if left >= 0.0:
                low, left_low = self._sign * by_itself, left
            else:
                high, left_high = self._sign * by_itself, left
        side = 0
        for _ in range(_SEARCH):
            # Covering the remaining distance at this speed takes no longer than `fine`.
            if left_low <= low * self._fine:
                break
            # The secant, weighted as in the Illinois method so that both ends move.
            middle = low + (high - low) * left_low / (left_low - left_high)
            if not low < middle < high:
                break
            left = self._sign * self._left(self._sign * middle)[0]
            if left >= 0.0:
                low, left_low = middle, left
                left_high *= 0.5 if side > 0 else 1.0
                side = 1
            else:
                high, left_high = middle, left
                left_low *= 0.5 if side < 0 else 1.0
                side = -1
        if low == 0.0:  # rounding does not distinguish the target from the nearest stop
            low = high
        return low

    def _speed_for(self, duration: float) -> float:
        """Return the speed of the motion that takes a given time [rad/s | m/s]."""
        fast = abs(self.velocity)
        # Searched over 1 / speed, on which the duration depends almost linearly: about c + d / v.
        low, late_low = 1.0 / fast, self.duration - duration
        high = 2.0 * low
        for _ in range(_SEARCH):
            late_high = self._duration(1.0 / high) - duration
            if late_high >= 0.0:
                break
            low, late_low, high = high, late_high, 4.0 * high
        else:
            return 1.0 / high
        side = 0
        for _ in range(_SEARCH):
            if -late_low <= self._fine:
                break
            middle = low + (high - low) * late_low / (late_low - late_high)
            if not low < middle < high:
                break
            late = self._duration(1.0 / middle) - duration
            if late <= 0.0:
                low, late_low = middle, late
                late_high *= 0.5 if side > 0 else 1.0
                side = 1
            else:
                high, late_high = middle, late
                late_low *= 0.5 if side < 0 else 1.0
                side = -1
        return 1.0 / low


def cube_root(value: float) -> float:
    """Return the cube root of a non-negative number, by Newton's method.

    Unlike a power of 1/3, the result does not depend on the mathematical library.
    """
    if value == 0.0:
        return 0.0
    mantissa, exponent = math.frexp(value)
    # value = mantissa · 2^shift · 8^k, whose cube root is that of the first two, times 2^k.
    shift = exponent % 3
    root = math.ldexp(1.0, (exponent - shift) // 3)
    mantissa = math.ldexp(mantissa, shift)  # 0.5 to 4: six steps from 1 reach the last digit
    result = 1.0
    for _ in range(6):
        result = (2.0 * result + mantissa / (result * result)) / 3.0
    return result * root


_FINE = 0.1
"""Actuators that start together arrive within this share of a period of each other: no device
resolves a tenth, which saves steps of the search."""


class SCurve(Profile):
    """Motion under jerk limits in phases of constant jerk: seven from rest, hence its name.

    Actuators that start together arrive together: the slowest one takes the time it needs, the
    others are slowed down. A motion to a new target continues position, velocity and acceleration.
    The motions of actuators without a new target are not planned again.

    Position limits need no check: wherever a motion is interrupted, it can still stop before its
    target, and no motion to another target goes further out than that stop.
    """

    def __init__(self, limits: MotionLimits, period: float) -> None:
        super().__init__(limits, period)
        n = self.size
        self._acceleration = [0.0] * n
        self._time = [0.0] * n
        self._motion: list[PhasedMotion | None] = [None] * n

    def _seeded(self, indices: Collection[int]) -> None:
        for index in indices:
            self._forget(index)
        self.moving = self._under_way()

    def _forget(self, i: int) -> None:
        self._acceleration[i] = 0.0
        self._braking[i] = False
        self._motion[i] = None

    def _under_way(self) -> bool:
        return any(motion is not None for motion in self._motion)

    def _start(
        self, going: AbstractSet[int], brake: Collection[int], changed: AbstractSet[int]
    ) -> None:
        for index in brake:
            self._braking[index] = True
            self._stop(index)
        self._together(going)
        # Actuators that keep their target but get another velocity limit are planned again.
        for index in changed - going - set(brake):
            if not self._braking[index] and self._motion[index] is not None:
                self._together((index,))
        self.moving = self._under_way()

    def _state(self, i: int) -> State:
        return self.position[i], self.velocity[i], self._acceleration[i]

    def _together(self, indices: Iterable[int]) -> None:
        """Plan motions of some actuators to their targets that end at the same time."""
        fine = _FINE * self.period
        motions = {
            i: TargetMotions(self._state(i), self.target[i], self._bounds(i), fine) for i in indices
        }
        longest = max((motion.duration for motion in motions.values()), default=0.0)
        for i, motion in motions.items():
            self._begin(i, motion.motion(longest))

    def _bounds(self, i: int) -> Bounds:
        return Bounds(self._top[i], self.limits.acceleration[i], self.limits.jerk[i])

    def _stop(self, i: int) -> None:
        _, velocity, acceleration = state = self._state(i)
        motion = PhasedMotion(state, velocity_change(velocity, acceleration, 0.0, self._bounds(i)))
        self.target[i] = self._rest(i, motion.end)
        self._begin(i, motion)

    def _begin(self, i: int, motion: PhasedMotion) -> None:
        self._time[i] = 0.0
        self._motion[i] = motion

    def advance(self) -> None:
        """See `Profile.advance`."""
        if not self.moving:
            return
        for i, motion in enumerate(self._motion):
            if motion is None:
                continue
            time = self._time[i] = self._time[i] + self.period
            if time < motion.duration:
                self.position[i], self.velocity[i], self._acceleration[i] = motion.at(time)
            else:
                self._arrive(i)
        self.moving = self._under_way()

    def _arrive(self, i: int) -> None:
        # The exact target, since the motion ends there only up to rounding.
        self.position[i] = self.target[i]
        self.velocity[i] = 0.0
        self._forget(i)
