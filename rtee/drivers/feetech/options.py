"""Options of a line of Feetech servos in hand.yaml."""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Literal

from msgspec import Meta

from rtee.drivers import servo_lines
from rtee.drivers.feetech.table import BAUD_RATES, FAMILIES, MOST_GAIN, FamilyName
from rtee.drivers.options import Positive
from rtee.drivers.servo_lines import LineOptions, check_line
from rtee.hand.validation import Section

Share = Annotated[float, Meta(gt=0.0, le=1.0)]
Points = Annotated[tuple[tuple[float, float], ...], Meta(min_length=2)]


class ServoOptions(servo_lines.ServoOptions, frozen=True, kw_only=True):
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
    """How pairs of servos drive pairs of actuators, the same for all pairs of the device.

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
    limit: Positive = math.pi / 2.0
    flexion: Points = ((-1.0, -1.0), (1.0, 1.0))
    tilt: Points = ((-1.0, -1.0), (1.0, 1.0))
    tilt_share: Points = ((-1.0, 1.0), (1.0, 1.0))
    pairs: Annotated[dict[str, PairOptions], Meta(min_length=1)]

    def __post_init__(self) -> None:
        """Check that the options fit each other."""
        (a, b), (c, d) = self.matrix
        # Relative to its terms, since the matrix has no scale of its own.
        if abs(a * d - b * c) < 1e-6 * max(abs(a * d), abs(b * c), 1e-9):
            raise ValueError("the matrix cannot be inverted: its rows must not be alike")
        for name in ("flexion", "tilt", "tilt_share"):
            points: Points = getattr(self, name)
            steps = list(itertools.pairwise(points))
            if any(there[0] <= here[0] for here, there in steps):
                raise ValueError(f"the first numbers of the points of '{name}' must rise")
            if name != "tilt_share" and any(there[1] <= here[1] for here, there in steps):
                raise ValueError(f"the second numbers of the points of '{name}' must rise")
        # The tilt is divided by its share.
        if any(share <= 0.0 for _, share in self.tilt_share):
            raise ValueError("the shares of 'tilt_share' must be above 0")


class FeetechOptions(LineOptions, frozen=True, kw_only=True):
    """Options of a line of Feetech servos."""

    family: FamilyName
    """Family of all servos: their registers and byte order."""
    servos: dict[str, ServoOptions]
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
    """After so many exchanges one servo is asked whether it has torque and settings."""

    def __post_init__(self) -> None:
        """Check that the options fit each other."""
        check_line(self, self.servos, BAUD_RATES, MOST_GAIN)
        counts = FAMILIES[self.family].counts
        for name, servo in self.servos.items():
            if servo.zero is not None and servo.zero >= counts:
                raise ValueError(
                    f"servo '{name}': zero is a position from 0 to {counts - 1}, not {servo.zero:g}"
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
        """The actuator whose index each servo of a pair uses, by the servo's name."""
        if self.differential is None:
            return {}
        pairs = self.differential.pairs.values()
        return {
            servo: actuator
            for pair in pairs
            for servo, actuator in zip(pair.servos, pair.actuators, strict=True)
        }
