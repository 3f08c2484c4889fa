"""The default profile: as fast as velocity, acceleration and jerk limits allow, synchronised."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from collections.abc import Set as AbstractSet
from itertools import compress
from operator import attrgetter
from typing import Any

from ruckig import (
    ControlInterface,
    InputParameter,
    Result,
    Ruckig,
    RuckigError,
    Synchronization,
    Trajectory,
)

from rtee.loop.motion import MotionLimits
from rtee.loop.profiles.base import Profile
from rtee.loop.profiles.stepwise import Step

_STATE = ("position", "velocity", "_acceleration", "target", "_top", "_braking")
_state = attrgetter(*_STATE)
_SLACK = 1e-9  # how far beyond a limit rounding may move an extremum [rad | m]


class JerkLimited(Profile):
    """Time-optimal motion under jerk limits; actuators that start together arrive together.

    The trajectories are ruckig's (Berscheid and Kröger, "Jerk-limited Real-time Trajectory
    Generation with Arbitrary Target States", 2021). A new target continues position, velocity and
    acceleration.
    """

    def __init__(self, limits: MotionLimits, period: float) -> None:
        super().__init__(limits, period)
        n = self.size
        self._ruckig = Ruckig(n)
        self._input = InputParameter(n)
        self._input.max_velocity = list(limits.velocity)
        self._input.max_acceleration = list(limits.acceleration)
        self._input.max_jerk = list(limits.jerk)
        self._input.target_velocity = [0.0] * n
        self._input.target_acceleration = [0.0] * n
        self._trajectory = Trajectory(n)
        self._acceleration = [0.0] * n
        self._duration = 0.0
        self._time = 0.0
        self._plain: Step | None = None
        self._synchronised: list[bool] = []  # `_braking` for which ruckig's input was set last
        self._begun: list[list[Any]] = []

    def _seeded(self, indices: Collection[int]) -> None:
        for index in indices:
            self._acceleration[index] = 0.0
            self._braking[index] = False
        if self.moving:
            self._plan()

    def _start(
        self, going: AbstractSet[int], brake: Collection[int], changed: AbstractSet[int]
    ) -> None:
        for index in brake:
            standing = self.velocity[index] == 0.0 and self._acceleration[index] == 0.0
            self._braking[index] = not standing
            if standing:
                self.target[index] = self.position[index]
        self._plan()

    def restored(self) -> None:
        """See `Profile.restored`: the trajectory is computed again from its initial state."""
        self._synchronised = []  # of the controller that was captured, not of this input
        if not self.moving or self._plain is not None:
            return
        present = _state(self), self._time
        self._set(self._begun)
        self._plan()
        values, self._time = present
        self._set(values)

    def _set(self, values: Iterable[list[Any]]) -> None:
        for name, value in zip(_STATE, values, strict=True):
            setattr(self, name, value)

    def _plan(self) -> None:
        self._begun = list(map(list, _state(self)))
        given = self._input
        given.current_position = self.position
        given.current_velocity = self.velocity
        given.current_acceleration = self._acceleration
        given.target_position = self.target
        given.max_velocity = self._top
        if self._synchronised != self._braking:
            self._synchronised = list(self._braking)
            given.per_dof_control_interface = [
                ControlInterface.Velocity if braking else ControlInterface.Position
                for braking in self._braking
            ]
            given.per_dof_synchronization = [
                Synchronization.No if braking else Synchronization.Time for braking in self._braking
            ]
        self._time = 0.0
        self.moving = True
        self._plain = None
        # Synchronised first; where that fails, each actuator on its own still keeps all limits.
        for together in (True, False):
            if not together:
                self._synchronised = []
                given.per_dof_synchronization = [Synchronization.No] * self.size
            try:
                result = self._ruckig.calculate(given, self._trajectory)
            # For motions longer than two hours, ruckig returns a result that its Python binding
            # cannot name, which raises a ValueError.
            except (RuckigError, ValueError):
                continue
            if result == Result.Working and self._inside():
                break
        else:
            self._without_jerk_limits()
            return
        self._duration = self._trajectory.duration
        if any(self._braking):
            end = self._trajectory.at_time(self._duration)[0]
            for i in compress(range(self.size), self._braking):
                self.target[i] = self._rest(i, end[i])

    def _inside(self) -> bool:
        """Return whether the trajectory keeps the position limits (or comes back into them).

        A motion slowed down so that all arrive together may first swing away from its target.
        """
        upper, lower, position = self.limits.upper, self.limits.lower, self.position
        for i, extremum in enumerate(self._trajectory.position_extrema):
            high, low = extremum.max, extremum.min
            if (
                (high > upper[i] + _SLACK and high > position[i] + _SLACK)
                or (low < lower[i] - _SLACK and low < position[i] - _SLACK)
            ) and not self._braking[i]:
                return False
        return True

    def _without_jerk_limits(self) -> None:
        """Continue with velocity and acceleration limits only, where ruckig cannot plan."""
        step = Step(self.limits, self.period)
        step.seed(dict(enumerate(self.position)))
        step.velocity = list(self.velocity)
        braking = [i for i, braking in enumerate(self._braking) if braking]
        going = {i: target for i, target in enumerate(self.target) if not self._braking[i]}
        step.go(going, brake=braking, velocity=dict(enumerate(self._top)))
        self._plain = step

    def advance(self) -> None:
        """See `Profile.advance`."""
        if not self.moving:
            return
        if self._plain is not None:
            self._advance_plain(self._plain)
            return
        self._time += self.period
        if self._time >= self._duration:
            self._arrive()
            return
        position, velocity, acceleration = self._trajectory.at_time(self._time)
        self.position = position
        self.velocity = velocity
        self._acceleration = acceleration

    def _arrive(self) -> None:
        # The exact target, since the trajectory ends there only up to rounding.
        self.position = list(self.target)
        self.velocity = [0.0] * self.size
        self._acceleration = [0.0] * self.size
        self._braking = [False] * self.size
        self.moving = False

    def _advance_plain(self, step: Step) -> None:
        step.advance()
        self.position = list(step.position)
        self.velocity = list(step.velocity)
        self._acceleration = [0.0] * self.size
        self.target = list(step.target)
        if not step.moving:
            self._arrive()
