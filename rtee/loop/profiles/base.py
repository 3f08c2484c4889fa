"""Base class of the profiles, which turn set-points into a smooth reference, period by period."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from collections.abc import Set as AbstractSet

from rtee.loop.motion import MotionLimits

_SLOWEST = 1e-9
"""Lowest velocity limit; lower ones are raised to it [rad/s | m/s]: so slow that no device resolves
the motion of a day, yet times, which divide by the limit, stay finite."""


class Profile(ABC):
    """Moves the references of all actuators of a hand; pure: time passes only in `advance`.

    Args:
        limits: Limits of the actuators.
        period: Time between ticks [s].

    Attributes:
        position: Positions of the reference [rad | m].
        velocity: Its velocities [rad/s | m/s].
        target: Target position of each actuator [rad | m].
        moving: Whether any actuator has not arrived yet.
    """

    def __init__(self, limits: MotionLimits, period: float) -> None:
        self.limits = limits
        self.period = period
        n = len(limits.lower)
        self.position = [0.0] * n
        self.velocity = [0.0] * n
        self.target = [0.0] * n
        self.moving = False
        self._top = list(limits.velocity)
        self._braking = [False] * n

    @property
    def size(self) -> int:
        """Number of actuators."""
        return len(self.position)

    def seed(self, positions: Mapping[int, float]) -> None:
        """Set some actuators to positions by index [rad | m], at rest; the others continue."""
        for index, position in positions.items():
            self.position[index] = position
            self.velocity[index] = 0.0
            self.target[index] = position
        self._seeded(positions)

    def resume(self, states: Mapping[int, tuple[float, float]]) -> None:
        """Start some actuators from a state of motion, and brake them; the others continue.

        The states are position [rad | m] and velocity [rad/s | m/s] by index.
        """
        for index, (position, velocity) in states.items():
            self.position[index] = self.target[index] = position
            self.velocity[index] = velocity
        self._seeded(states)
        # Braked, not set to rest: a jump in velocity would exceed the limits.
        self.go({}, brake=states)

    def _rest(self, index: int, end: float) -> float:
        """Return where a braked actuator rests [rad | m]: at a limit that it would pass.

        Jerk limits do not let every motion that a stream hands over stop before a limit; the
        limiter stops the reference there, so the profile must not rest beyond.

        Args:
            index: The actuator.
            end: Where its motion ends [rad | m].
        """
        here, limits = self.position[index], self.limits
        return min(max(end, min(limits.lower[index], here)), max(limits.upper[index], here))

    @abstractmethod
    def _seeded(self, indices: Collection[int]) -> None:
        """Discard the motion of some actuators, except for position and velocity."""

    def go(
        self,
        targets: Mapping[int, float],
        *,
        brake: Collection[int] = (),
        velocity: Mapping[int, float] | None = None,
    ) -> None:
        """Set new targets, which are approached from the present motion.

        Args:
            targets: Target positions by index [rad | m], clamped into the limits.
            brake: Actuators to stop as soon as the limits allow. Actuators in neither continue.
            velocity: New velocity limits by index, above 0 [rad/s | m/s], at most those of the
                hand, which apply at first. The other actuators keep theirs.
        """
        changed = set()
        for index, top in (velocity or {}).items():
            before = self._top[index]
            if top != before:  # most goals ask for the same limits as the one before
                self._top[index] = min(max(top, _SLOWEST), self.limits.velocity[index])
                if self._top[index] != before:
                    changed.add(index)
        for index, target in targets.items():
            self.target[index] = self.limits.clamp(index, target)
            self._braking[index] = False
        self._start(targets.keys(), brake, changed)

    @abstractmethod
    def _start(
        self, going: AbstractSet[int], brake: Collection[int], changed: AbstractSet[int]
    ) -> None:
        """Begin the motions of `go`, which has stored the targets and velocity limits.

        Args:
            going: Actuators with a new target.
            brake: Actuators to stop.
            changed: Actuators whose velocity limit has changed.
        """

    def restored(self) -> None:  # noqa: B027 - most profiles have all of their state in attributes
        """Recompute derived values after the attributes were set."""

    @abstractmethod
    def advance(self) -> None:
        """Advance the reference by one period."""
