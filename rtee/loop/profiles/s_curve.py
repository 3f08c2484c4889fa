"""A jerk-limited profile in pure Python: the default where ruckig is not installed."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from collections.abc import Set as AbstractSet

from rtee.loop.motion import MotionLimits
from rtee.loop.profiles.base import Profile
from rtee.loop.profiles.phases import Bounds, PhasedMotion, State, TargetMotions, velocity_change

_FINE = 0.1
"""Actuators that start together arrive within this share of a period of each other: no device
notices a tenth, and it saves steps of the search."""


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
        self.target[i] = motion.end
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
