"""Options of a line of Feetech servos in hand.yaml, and joints that two servos drive."""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from rtee.drivers.feetech.table import BAUD_RATES, FAMILIES, MOST_GAIN, FamilyName
from rtee.drivers.options import Positive
from rtee.drivers.servo_lines import LineOptions, ServoOptions, check_line
from rtee.drivers.wiring import check_names
from rtee.hand.validation import Section
from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, DeviceSpec

Share = Annotated[float, Meta(gt=0.0, le=1.0)]
Points = Annotated[tuple[tuple[float, float], ...], Meta(min_length=2)]


class FeetechServo(ServoOptions, frozen=True, kw_only=True):
    """Options of one servo.

    Attributes:
        stall_torque: Largest torque at this supply [N·m]; by default that of the line or the model.
    """

    stall_torque: Positive | None = None


class PairOptions(Section, frozen=True):
    """Two servos that drive two actuators together.

    Attributes:
        servos: The servos, in the order of the rows of the matrix.
        actuators: The actuators, in the order of its columns: flexion, then tilt.
    """

    servos: tuple[str, str]
    actuators: tuple[str, str]


class DifferentialOptions(Section, frozen=True, kw_only=True):
    """Differential drive of two actuators by two servos; the same for all pairs of the device.

    The matrix gives the angles of the two servos from two coordinates, flexion and tilt. Two curves
    map these coordinates to the actuators' positions.

    Attributes:
        matrix: Matrix with a row for each servo and columns for flexion and tilt.
        limit: Largest angle of a servo in both directions [rad]; the tilt is reduced to keep it.
        flexion: Points of coordinate and position of the flexion, rising [rad].
        tilt: Points of coordinate and position of the tilt, at a flexion coordinate of 0 [rad].
        tilt_share: Points of the flexion's coordinate [rad] and the remaining share of the tilt.
        pairs: The pairs by name.
    """

    matrix: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 1.0), (-1.0, 1.0))
    limit: Annotated[float, Meta(gt=0, le=math.pi)] = math.pi / 2.0
    flexion: Points = ((-1.0, -1.0), (1.0, 1.0))
    tilt: Points = ((-1.0, -1.0), (1.0, 1.0))
    tilt_share: Points = ((-1.0, 1.0), (1.0, 1.0))
    pairs: Annotated[dict[str, PairOptions], Meta(min_length=1)]

    def __post_init__(self) -> None:
        """Check that the options fit each other."""
        (a, b), (c, d) = self.matrix
        # Relative to its terms, since the matrix has no scale of its own.
        if abs(a * d - b * c) < 1e-6 * max(abs(a * d), abs(b * c), 1e-9):
            raise ValueError("the matrix cannot be inverted; its rows must be independent")
        for name in ("flexion", "tilt", "tilt_share"):
            points: Points = getattr(self, name)
            steps = list(itertools.pairwise(points))
            if any(there[0] <= here[0] for here, there in steps):
                raise ValueError(f"the first numbers of the points of '{name}' must increase")
            if name != "tilt_share" and any(there[1] <= here[1] for here, there in steps):
                raise ValueError(f"the second numbers of the points of '{name}' must increase")
        # The tilt is divided by its share.
        if any(share <= 0.0 for _, share in self.tilt_share):
            raise ValueError("the shares of 'tilt_share' must be above 0")


class FeetechOptions(LineOptions, frozen=True, kw_only=True):
    """Options of a line of Feetech servos."""

    family: FamilyName
    """Family of all servos: their registers and byte order."""
    servos: dict[str, FeetechServo]
    """The servo of each actuator, by the actuator's name; those of pairs by any."""
    differential: DifferentialOptions | None = None
    """Pairs of servos that drive two actuators together."""
    torque: Share | None = None
    """Largest share of the stall torque; unless given, as the servos have it."""
    stall_torque: Positive | None = None
    """Largest torque of each servo at this supply [N·m]."""
    torque_per_ampere: Positive | None = None
    """Torque per current of each servo [N·m/A]."""
    acceleration: Annotated[int, Meta(ge=0, le=254)] | None = None
    """Acceleration of STS, SMS and HLS [100 counts/s²], 0: the largest."""
    read: Literal["auto", "sync", "single"] = "auto"
    """One request for all servos, or one for each; ``auto``: by the family."""
    check_every: Annotated[int, Meta(ge=1)] = 10
    """Number of exchanges between checks whether a servo still has its torque and settings."""

    def __post_init__(self) -> None:
        """Check that the options fit each other."""
        check_line(self, self.servos, BAUD_RATES, MOST_GAIN)
        counts = FAMILIES[self.family].counts
        for name, servo in self.servos.items():
            if servo.zero is not None and servo.zero >= counts:
                raise ValueError(
                    f"servo '{name}': zero must be a position from 0 to {counts - 1}, not "
                    f"{servo.zero:g}"
                )
        if self.differential is not None:
            self._check_pairs(self.differential)

    def _check_pairs(self, differential: DifferentialOptions) -> None:
        pairs = differential.pairs.values()
        for what, named in (
            ("servo", [name for pair in pairs for name in pair.servos]),
            ("actuator", [name for pair in pairs for name in pair.actuators]),
        ):
            twice = sorted({name for name in named if named.count(name) > 1})
            if twice:
                raise ValueError(f"{what} '{twice[0]}' is in two pairs, or twice in one")
        for pair in pairs:
            for name in pair.servos:
                if name not in self.servos:
                    raise ValueError(f"a pair has servo '{name}', which 'servos' does not name")

    @property
    def paired(self) -> dict[str, str]:
        """For each servo of a pair, by name, the actuator whose index it uses."""
        if self.differential is None:
            return {}
        pairs = self.differential.pairs.values()
        return {
            servo: actuator
            for pair in pairs
            for servo, actuator in zip(pair.servos, pair.actuators, strict=True)
        }


_GAVE_WAY = 0.02
"""Largest reduction of a tilt without a warning [rad]: about a degree."""


class Curve:
    """A polyline through points, extrapolated at both ends.

    Args:
        points: Two or more points with increasing first numbers.
    """

    def __init__(self, points: Sequence[tuple[float, float]]) -> None:
        self._x = [x for x, _ in points]
        self._y = [y for _, y in points]

    def at(self, x: float) -> tuple[float, float]:
        """Return the value and the slope at ``x``."""
        return _line(self._x, self._y, x)

    def inverse(self, y: float) -> float:
        """Return the ``x`` at which a rising curve has the value ``y``."""
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
        """Return the servos' angles [rad] for flexion and tilt [rad], reduced to their limit."""
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
        """Return the Jacobian of the servos' angles with respect to flexion and tilt ``(2, 2)``."""
        bent, lean = self._coordinates(first, second)
        (tilt, tilts), (share, shares) = self._tilt.at(lean), self._share_at(bent)
        joints = np.array([[self._flexion.at(bent)[1], 0.0], [tilt * shares, tilts * share]])
        return self._matrix @ np.linalg.inv(joints)

    def _coordinates(self, first: float, second: float) -> tuple[float, float]:
        (a, b), (c, d) = self._inverse.tolist()
        return a * first + b * second, c * first + d * second

    def _share_at(self, bent: float) -> tuple[float, float]:
        low, high = self._shared
        share, slope = self._share.at(min(max(bent, low), high))
        # Constant beyond its ends: an extrapolated share might reach 0.
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
        """The two indices of each pair, which are those of its servos and of its actuators."""
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
        """Return the Jacobian of the servos' angles with respect to the positions ``(n, n)``."""
        matrix = np.eye(len(angles))
        for i, j, pair in self._pairs:
            block = pair.jacobian(float(angles[i]), float(angles[j]))
            matrix[np.ix_((i, j), (i, j))] = block
        return matrix

    def limit_warnings(self, positions: FloatArray, angles: FloatArray) -> tuple[str, ...]:
        """Return a warning for each tilt that the servos' limit has reduced."""
        reached = self.positions(angles)
        return tuple(
            f"{self._actuators[j]} gives way to {self._actuators[i]}: its servos are at their limit"
            for i, j, _ in self._pairs
            if abs(float(reached[j] - positions[j])) > _GAVE_WAY
        )
