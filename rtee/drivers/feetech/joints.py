"""Conversion between the servos' angles and the actuators' positions, with the derivative.

A single servo turns one actuator. Two servos of a differential turn two actuators: their angles are
a linear map of two coordinates, of which one bends the finger and the other tilts it. Velocities
and efforts follow from the derivative of the same map.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence

import numpy as np

from rtee.drivers.feetech.options import DifferentialOptions, FeetechOptions
from rtee.drivers.wiring import check_names
from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, DeviceSpec

_GAVE_WAY = 0.02
"""Largest reduction of a tilt without a warning [rad], about a degree."""


class Curve:
    """A polyline through points, extended at both ends.

    Args:
        points: Two or more points, their first numbers rising.
    """

    def __init__(self, points: Sequence[tuple[float, float]]) -> None:
        self._x = [x for x, _ in points]
        self._y = [y for _, y in points]

    def at(self, x: float) -> tuple[float, float]:
        """Return the value and the slope there."""
        return _line(self._x, self._y, x)

    def inverse(self, y: float) -> float:
        """Return where a rising curve has a value."""
        return _line(self._y, self._x, y)[0]


def _line(x: Sequence[float], y: Sequence[float], at: float) -> tuple[float, float]:
    # Clamped, so that the outermost segments continue beyond the points.
    i = min(max(bisect.bisect_right(x, at), 1), len(x) - 1)
    slope = (y[i] - y[i - 1]) / (x[i] - x[i - 1])
    return y[i - 1] + slope * (at - x[i - 1]), slope


class Differential:
    """The map of one pair between the angles of two servos and the flexion and tilt of a finger.

    Args:
        options: Its parameters.

    Attributes:
        limit: Largest angle of a servo in both directions [rad].
    """

    def __init__(self, options: DifferentialOptions) -> None:
        self._matrix = np.array(options.matrix)
        self._inverse = np.linalg.inv(self._matrix)
        self.limit = options.limit
        self._flexion = Curve(options.flexion)
        self._tilt = Curve(options.tilt)
        self._share = Curve(options.tilt_share)
        self._shared = options.tilt_share[0][0], options.tilt_share[-1][0]

    def servos(self, flexion: float, tilt: float) -> tuple[float, float]:
        """Return the servos' angles [rad] for flexion and tilt [rad], which their limit reduces."""
        (a, b), (c, d) = self._matrix.tolist()
        # The flexion may use the whole range, the tilt the rest.
        most = self.limit / max(abs(a), abs(c), 1e-9)
        bent = min(max(self._flexion.inverse(flexion), -most), most)
        # The flexion changes how far a tilt moves the joint, so it is determined first.
        lean = self._tilt.inverse(tilt / self._share_at(bent)[0])
        for row, by in ((a, b), (c, d)):
            if by:
                ends = sorted(((-self.limit - row * bent) / by, (self.limit - row * bent) / by))
                lean = min(max(lean, ends[0]), ends[1])
        return a * bent + b * lean, c * bent + d * lean

    def joints(self, first: float, second: float) -> tuple[float, float]:
        """Return flexion and tilt [rad] at the servos' angles [rad]."""
        bent, lean = self._coordinates(first, second)
        return self._flexion.at(bent)[0], self._tilt.at(lean)[0] * self._share_at(bent)[0]

    def jacobian(self, first: float, second: float) -> FloatArray:
        """Return the derivative of the servos' angles by flexion and tilt ``(2, 2)``."""
        bent, lean = self._coordinates(first, second)
        (tilt, tilts), (share, shares) = self._tilt.at(lean), self._share_at(bent)
        joints = np.array([[self._flexion.at(bent)[1], 0.0], [tilt * shares, tilts * share]])
        found: FloatArray = self._matrix @ np.linalg.inv(joints)
        return found

    def _coordinates(self, first: float, second: float) -> tuple[float, float]:
        (a, b), (c, d) = self._inverse.tolist()
        return a * first + b * second, c * first + d * second

    def _share_at(self, bent: float) -> tuple[float, float]:
        low, high = self._shared
        share, slope = self._share.at(min(max(bent, low), high))
        # Constant beyond its ends: extended, it might reach 0.
        return share, slope if low < bent < high else 0.0


class Joints:
    """The map of all servos of a device to all its actuators.

    Each servo has the index of an actuator that it drives: its own, or one of its pair.

    Args:
        spec: The device.

    Attributes:
        names: The names of the servos, in the order of the actuators.

    Raises:
        ConfigError: if servos and pairs do not drive every actuator exactly once.
    """

    def __init__(self, spec: DeviceSpec, options: FeetechOptions) -> None:
        paired = options.paired
        check_names(spec, "servos", [paired.get(name, name) for name in options.servos])
        order = {actuator.name: i for i, actuator in enumerate(spec.actuators)}
        places = {name: order[paired.get(name, name)] for name in options.servos}
        self.names = tuple(sorted(places, key=places.__getitem__))
        self._actuators = [actuator.name for actuator in spec.actuators]
        self._pairs: list[tuple[int, int, Differential]] = []
        if options.differential is not None:
            differential = Differential(options.differential)
            self._pairs = [
                (order[pair.actuators[0]], order[pair.actuators[1]], differential)
                for pair in options.differential.pairs.values()
            ]

    def ends(self, actuators: Sequence[ActuatorSpec]) -> list[tuple[float, float]]:
        """Return the smallest and the largest angle of each servo [rad]."""
        ends = [(actuator.lower, actuator.upper) for actuator in actuators]
        for i, j, pair in self._pairs:
            ends[i] = ends[j] = (-pair.limit, pair.limit)
        return ends

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """The indices of the servos, and of the actuators, of each pair."""
        return [(i, j) for i, j, _ in self._pairs]

    def servos(self, positions: FloatArray) -> FloatArray:
        """Return the servos' angles [rad] for the actuators' positions [rad]."""
        angles = np.array(positions)
        for i, j, pair in self._pairs:
            angles[i], angles[j] = pair.servos(float(positions[i]), float(positions[j]))
        return angles

    def positions(self, angles: FloatArray) -> FloatArray:
        """Return the actuators' positions [rad] at the servos' angles [rad]."""
        positions = np.array(angles)
        for i, j, pair in self._pairs:
            positions[i], positions[j] = pair.joints(float(angles[i]), float(angles[j]))
        return positions

    def jacobian(self, angles: FloatArray) -> FloatArray:
        """Return the derivative of the servos' angles by the actuators' positions ``(n, n)``."""
        matrix = np.eye(len(angles))
        for i, j, pair in self._pairs:
            block = pair.jacobian(float(angles[i]), float(angles[j]))
            matrix[np.ix_((i, j), (i, j))] = block
        return matrix

    def gave_way(self, positions: FloatArray, angles: FloatArray) -> tuple[str, ...]:
        """Return a warning for each tilt that the servos' limit has reduced."""
        reached = self.positions(angles)
        return tuple(
            f"{self._actuators[j]} gives way to {self._actuators[i]}: its servos are at their limit"
            for i, j, _ in self._pairs
            if abs(float(reached[j] - positions[j])) > _GAVE_WAY
        )
