"""The effort that an actuator needs to move freely, learned while it moves."""

from __future__ import annotations

from typing import Final

_FORGET: Final = 0.995
"""Weight that a measurement keeps at the next one: some 200 of them count, so that the model
follows a friction that changes with temperature and load."""

_PRIOR: Final = 10.0
"""Variance of the parameters before anything is known; they are shares of the limits, at most 1."""

_LEAST: Final = 12
"""Measurements that the parameters are learned from before they are believed: four for each."""

_SPREADS: Final = 4.0
"""A deviation counts from this many mean deviations on: about three standard deviations, which
noise exceeds once in some thousand measurements."""

_SPREAD_SHARE: Final = 1.0 / 16.0
"""Weight of the newest deviation in the mean one: it settles while the model does, and a power of
two is exact."""

_SURELY_FREE: Final = 0.5
"""Deviations above this share of the threshold are not learned from: they may be a soft contact."""

_RELATIVE: Final = 0.5
"""Without a threshold in physical units, a deviation counts from this share of the largest effort
of free motion on: friction varies by less along the way."""

_STEADY: Final = 1.0 / 64.0
"""How fast the largest effort of free motion is forgotten, per measurement: over some 64 of
them."""


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
        most: Size of the largest effort of free motion of late [N·m | N].
    """

    __slots__ = ("_count", "_limit", "_matrix", "_parameters", "_scale", "most", "spread")

    def __init__(self, effort: float, velocity: float, acceleration: float) -> None:
        self._limit = effort
        self._scale = (1.0 / velocity, 1.0 / acceleration)
        self._parameters = [0.0, 0.0, 0.0]
        self._matrix = [[_PRIOR, 0.0, 0.0], [0.0, _PRIOR, 0.0], [0.0, 0.0, _PRIOR]]
        self._count = 0
        self.spread = self.most = 0.0

    @property
    def known(self) -> bool:
        """Whether it has been learned from enough measurements."""
        return self._count >= _LEAST

    def expected(self, velocity: float, acceleration: float) -> float:
        """Return the effort of free motion [N·m | N] at a velocity and an acceleration."""
        features = self._features(velocity, acceleration)
        # A list, not a generator: for three terms it takes half of the time.
        found = sum([p * x for p, x in zip(self._parameters, features, strict=True)])
        return min(max(found, -self._limit), self._limit)

    def _features(self, velocity: float, acceleration: float) -> tuple[float, float, float]:
        direction = 1.0 if velocity > 0.0 else -1.0 if velocity < 0.0 else 0.0
        return direction, velocity * self._scale[0], acceleration * self._scale[1]

    def exceeds(
        self, effort: float, velocity: float, acceleration: float, threshold: float
    ) -> bool:
        """Return whether an effort is above that of free motion; learn from it if it is not.

        Args:
            effort: Measured effort [N·m | N], or current [A].
            velocity: Velocity of the reference [rad/s | m/s], not 0.
            acceleration: Its acceleration [rad/s² | m/s²].
            threshold: By how much it must be above [N·m | N]; 0: in relation to what free motion
                takes.
        """
        if not threshold > 0.0:
            threshold = _RELATIVE * self.most
        deviation = effort - self.expected(velocity, acceleration)
        # Servos lag behind their references: what inertia takes comes at another time.
        inertia = abs(self._parameters[2] * acceleration) * self._scale[1]
        least = max(threshold, _SPREADS * self.spread) + inertia
        ahead = deviation if velocity > 0.0 else -deviation
        # Learning from a contact would teach the model that contacts are free motion.
        if self.known and ahead > _SURELY_FREE * least:
            return ahead > least
        self.learn(effort, velocity, acceleration)
        return False

    def learn(self, effort: float, velocity: float, acceleration: float) -> None:
        """Learn from a measurement of free motion; arguments as for `exceeds`."""
        deviation = effort - self.expected(velocity, acceleration)
        features = self._features(velocity, acceleration)
        size = abs(effort)
        # Up at once, down slowly.
        self.most += (size - self.most) * (1.0 if size > self.most else _STEADY)
        # The update of recursive least squares: `along` is P·x, and P is symmetric.
        matrix = self._matrix
        along = [sum([m * x for m, x in zip(row, features, strict=True)]) for row in matrix]
        weight = _FORGET + sum([a * x for a, x in zip(along, features, strict=True)])
        limit = self._limit
        for k, gain in enumerate(along):
            moved = self._parameters[k] + gain / weight * deviation
            # Kept within the limit, a bad start cannot run away.
            self._parameters[k] = min(max(moved, -limit), limit)
        # Without excitation, what is forgotten is not replaced: the variance is bounded.
        forget = _FORGET if matrix[0][0] + matrix[1][1] + matrix[2][2] < 3.0 * _PRIOR else 1.0
        for j in range(3):
            for k in range(3):
                matrix[j][k] = (matrix[j][k] - along[j] * along[k] / weight) / forget
        size = abs(deviation)
        if self._count >= 3:  # as many parameters fit as many measurements exactly
            self.spread += _SPREAD_SHARE * (size - self.spread)
        self._count += 1
