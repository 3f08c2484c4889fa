"""A model of the effort that an actuator needs to move freely, learned while it moves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

_FORGET: Final = 0.995
"""Forgetting factor per measurement: some 200 measurements count, so that the model follows
friction as it changes with temperature and load."""

_PRIOR: Final = 10.0
"""Variance of the parameters before anything is known; they are shares of the limits, at most 1."""

_LEAST: Final = 12
"""Measurements before the parameters are used: four for each parameter."""

_SPREADS: Final = 4.0
"""A deviation counts above this many mean deviations: about three standard deviations, which noise
exceeds once in some thousand measurements."""

_ROUGH: Final = 1.5
"""A deviation counts above this many times the largest recent one of free motion: devices that move
in steps, as with a slow reference, need effort at one moment and none at the next."""

_COUNTS: Final = 3.0
"""A deviation counts above this many least counts of the device: one more or less is its noise."""

_SPREAD_SHARE: Final = 1.0 / 16.0
"""Weight of the newest deviation in the mean deviation, which settles as fast as the model; a power
of two is exact."""

SURELY_FREE: Final = 0.5
"""Deviations above this share of what counts may be a soft contact: they are not learned from."""

_ALIKE: Final = 0.5
"""Variance of an expected effort, relative to that of one measurement, below which the model knows
what motion at such a velocity and acceleration takes: two measurements like it."""

_TAKEN: Final = 6
"""Measurements of a stretch of motion: two of them make a model known."""

_COUNTS_OF_WAY: Final = 4.0
"""Least length of a stretch in counts of the position: below, a step may be its noise."""

_MOST_TAKEN: Final = 256
"""Measurements after which a stretch ends in any case: an actuator that stands still has none."""

FREELY: Final = 0.5
"""An actuator moves freely while it covers this share of the motion of its reference or more."""

_RELATIVE: Final = 0.5
"""Without a threshold in physical units, a deviation counts above this share of the largest effort
of free motion: friction varies by less over a motion."""

_STEADY: Final = 1.0 / 64.0
"""Decay of the largest effort of free motion per measurement: it is forgotten over some 64."""


class FreeMotion:
    r"""A model of the effort of free motion: :math:`e = d\,a + v\,b + \dot{v}\,c`.

    :math:`d` is the direction of motion, so that :math:`a` is dry friction and the pull of cables
    and of gravity, :math:`b` viscous friction, :math:`c` inertia. The three are found by recursive
    least squares with exponential forgetting (Ljung, *System Identification*, 2nd edition, section
    11.2), in shares of the limits, and kept within the effort limit.

    Args:
        effort: Effort limit [N·m | N], or ``inf``.
        velocity: Velocity limit [rad/s | m/s].
        acceleration: Acceleration limit [rad/s² | m/s²].

    Attributes:
        spread: Mean size of the deviations [N·m | N].
        rough: Size of the largest recent deviation [N·m | N].
        most: Size of the largest recent effort of free motion [N·m | N].
        quantum: Smallest change of the measured effort [N·m | N]: the device's least count.
        lag: Time by which the actuator follows its reference [s]; 0: not known.
    """

    __slots__ = (
        "_count",
        "_last",
        "_limit",
        "_matrix",
        "_parameters",
        "_scale",
        "lag",
        "most",
        "quantum",
        "rough",
        "spread",
    )

    def __init__(self, effort: float, velocity: float, acceleration: float) -> None:
        self._limit = effort
        self._scale = (1.0 / velocity, 1.0 / acceleration)
        self._parameters = [0.0, 0.0, 0.0]
        self._matrix = [[_PRIOR, 0.0, 0.0], [0.0, _PRIOR, 0.0], [0.0, 0.0, _PRIOR]]
        self._count = 0
        self.spread = self.rough = self.most = self.quantum = self.lag = 0.0
        self._last = math.nan

    @property
    def known(self) -> bool:
        """Whether the model was learned from enough measurements."""
        return self._count >= _LEAST

    @property
    def dry(self) -> float:
        """Size of the effort of motion at any speed: friction and constant pull [N·m | N]."""
        return abs(self._parameters[0])

    def expected(self, velocity: float, acceleration: float) -> float:
        """Return the effort of free motion [N·m | N] at a velocity and an acceleration."""
        features = self._features(velocity, acceleration)
        # A list, not a generator: for three terms it takes half of the time.
        effort = sum([p * x for p, x in zip(self._parameters, features, strict=True)])
        return min(max(effort, -self._limit), self._limit)

    def _features(self, velocity: float, acceleration: float) -> tuple[float, float, float]:
        direction = 1.0 if velocity > 0.0 else -1.0 if velocity < 0.0 else 0.0
        return direction, velocity * self._scale[0], acceleration * self._scale[1]

    def knows(self, velocity: float, acceleration: float) -> bool:
        """Return whether the effort of such a motion was learned, not just that of others."""
        if not self.known:
            return False
        features = self._features(velocity, acceleration)
        rows = (sum([m * x for m, x in zip(r, features, strict=True)]) for r in self._matrix)
        return sum([a * x for a, x in zip(rows, features, strict=True)]) <= _ALIKE

    def excess(
        self,
        effort: float,
        velocity: float,
        acceleration: float,
        threshold: float,
        recent: float = 0.0,
    ) -> float:
        """Return the excess of an effort over that of free motion, relative to the threshold.

        Args:
            effort: Measured effort [N·m | N], or current [A].
            velocity: Velocity of the reference [rad/s | m/s], not 0.
            acceleration: Its acceleration [rad/s² | m/s²].
            threshold: Least excess [N·m | N]; 0: a share of the effort of free motion.
            recent: Size of the largest recent acceleration [rad/s² | m/s²].
        """
        expected = self.expected(velocity, acceleration)
        if not threshold > 0.0:
            # Above the largest effort, not the mean: a device that moves in steps takes all of it
            # at one moment and nothing at the next.
            threshold = (1.0 + _RELATIVE) * self.most - abs(expected)
        deviation = effort - expected
        # Servos lag behind their references, so the effort of inertia comes at another time.
        surge = max(abs(acceleration), recent)
        inertia = abs(self._parameters[2]) * surge * self._scale[1]
        noise = max(_SPREADS * self.spread, _ROUGH * self.rough, _COUNTS * self.quantum)
        least = max(threshold, noise) + inertia
        ahead = deviation if velocity > 0.0 else -deviation
        return ahead / least if least > 0.0 else math.copysign(math.inf, ahead) if ahead else 0.0

    def learn(self, effort: float, velocity: float, acceleration: float) -> None:
        """Learn from a measurement of free motion; arguments as for `excess`."""
        deviation = effort - self.expected(velocity, acceleration)
        features = self._features(velocity, acceleration)
        change, self._last = abs(effort - self._last), effort
        if change > 0.0:
            self.quantum = min(self.quantum or change, change)
        size = abs(effort)
        # It rises at once and falls slowly.
        self.most += (size - self.most) * (1.0 if size > self.most else _STEADY)
        # The update of recursive least squares: `along` is P·x, and P is symmetric.
        matrix = self._matrix
        along = [sum([m * x for m, x in zip(row, features, strict=True)]) for row in matrix]
        weight = _FORGET + sum([a * x for a, x in zip(along, features, strict=True)])
        limit = self._limit
        for k, gain in enumerate(along):
            parameter = self._parameters[k] + gain / weight * deviation
            # Clamped, so that a bad start cannot diverge.
            self._parameters[k] = min(max(parameter, -limit), limit)
        # Without excitation, forgetting would let the variance grow without bound.
        forget = _FORGET if matrix[0][0] + matrix[1][1] + matrix[2][2] < 3.0 * _PRIOR else 1.0
        for j in range(3):
            for k in range(3):
                matrix[j][k] = (matrix[j][k] - along[j] * along[k] / weight) / forget
        size = abs(deviation)
        if self._count >= 3:  # three parameters fit the first three measurements exactly
            self.spread += _SPREAD_SHARE * (size - self.spread)
            self.rough += (size - self.rough) * (1.0 if size > self.rough else _STEADY)
        self._count += 1

    def state(self) -> LearnedMotion:
        """Return the learned free motion."""
        first, second, third = map(tuple, self._matrix)
        return LearnedMotion(
            tuple(self._parameters), first + second + third,
            self._count, self.spread, self.rough, self.most, self.quantum, self.lag,
        )  # fmt: skip

    def restore(self, learned: LearnedMotion) -> None:
        """Continue from an earlier estimate."""
        limit = self._limit
        self._parameters = [min(max(p, -limit), limit) for p in learned.parameters]
        self._matrix = [list(learned.matrix[k : k + 3]) for k in (0, 3, 6)]
        self._count = learned.count
        self.spread, self.rough = learned.spread, learned.rough
        self.most, self.quantum, self.lag = learned.most, learned.quantum, learned.lag


@dataclass(frozen=True, slots=True)
class LearnedMotion:
    """The data that a `FreeMotion` has learned, as stored between runs.

    Attributes:
        parameters: Its three parameters [N·m | N].
        matrix: Their covariance by rows ``(9,)``, in shares of the limits.
        count: Number of measurements.
        spread: Mean size of the deviations [N·m | N].
        rough: Size of the largest recent deviation [N·m | N].
        most: Size of the largest recent effort [N·m | N].
        quantum: Smallest change of the measured effort [N·m | N].
        lag: Time by which the actuator follows its reference [s]; 0: not known.
    """

    parameters: tuple[float, ...]
    matrix: tuple[float, ...]
    count: int
    spread: float
    rough: float
    most: float
    quantum: float
    lag: float = 0.0

    @property
    def sound(self) -> bool:
        """Whether the model, which may come from a file, is complete and finite."""
        sizes = (self.spread, self.rough, self.most, self.quantum, self.lag)
        whole = len(self.parameters) == 3 and len(self.matrix) == 9 and min(sizes) >= 0.0
        return whole and all(map(math.isfinite, (*self.parameters, *self.matrix, *sizes)))


class Stretches:
    """Collects efforts of a moving actuator, to learn its free motion once it has kept moving.

    A single measurement does not show whether anything is in the way: servos move in steps, and
    stand still in between with the effort that friction takes. So the motion is divided into
    stretches. A stretch on which the actuator kept up with its reference, and on the next one, too,
    was free motion as a whole.
    """

    __slots__ = ("_before", "_here", "_now", "_reference", "_step", "_was")

    def __init__(self) -> None:
        self._step = math.inf
        self.restart()

    @property
    def count(self) -> float:
        """Resolution of the position [rad | m]: the device's count; 0 if not known yet."""
        return self._step if self._step < math.inf else 0.0

    def restart(self) -> None:
        """Forget the present stretch: another motion begins."""
        self._before: list[tuple[float, float, float]] = []
        self._now: list[tuple[float, float, float]] = []
        self._here = self._reference = self._was = math.nan

    def take(
        self,
        free: FreeMotion,
        here: float,
        reference: float,
        sample: tuple[float, float, float] | None,
    ) -> None:
        """Take a measurement; learn once a stretch has proved to be free.

        Args:
            free: The model.
            here: The measured position [rad | m].
            reference: The reference [rad | m].
            sample: Effort, velocity and acceleration, as for `FreeMotion.learn`; ``None``: not to
                be learned from.
        """
        if self._here != self._here:
            self._here, self._reference, self._was = here, reference, here
        step, self._was = abs(here - self._was), here
        if 0.0 < step < self._step:
            self._step = step
        self._now.append(sample or (math.nan, 0.0, 0.0))
        wanted, moved = reference - self._reference, here - self._here
        far = abs(wanted) >= _COUNTS_OF_WAY * self._step
        if not (len(self._now) >= _TAKEN and far) and len(self._now) < _MOST_TAKEN:
            return
        freely = far and moved * wanted > 0.0 and abs(moved) >= FREELY * abs(wanted)
        if freely:
            for effort, velocity, acceleration in self._before:
                if effort == effort:
                    free.learn(effort, velocity, acceleration)
        self._before = self._now if freely else []
        self._now = []
        self._here, self._reference = here, reference
