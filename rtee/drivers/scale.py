"""Convert a device's counts to SI units and back: linear scales, also for a gripper's fingers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LinearScale:
    """The straight line through two points, each a device's value and its SI value.

    Attributes:
        raw: The device's values at the two points [counts].
        si: The SI values at the two points.
        ends: Least and greatest value that the device accepts [counts]; by default those of
            ``raw``.
    """

    raw: tuple[float, float]
    si: tuple[float, float]
    ends: tuple[float, float] | None = None

    @property
    def gain(self) -> float:
        """SI units per count."""
        return (self.si[1] - self.si[0]) / (self.raw[1] - self.raw[0])

    def to_si(self, raw: float) -> float:
        """Return the SI value of a device's value."""
        share = (raw - self.raw[0]) / (self.raw[1] - self.raw[0])
        return self.si[0] + share * (self.si[1] - self.si[0])

    def within(self, raw: float) -> float:
        """Return the SI value of a device's value, limited to what the device accepts."""
        low, high = sorted(self.ends or self.raw)
        return self.to_si(min(max(raw, low), high))

    def to_raw(self, si: float) -> float:
        """Return the device's value for an SI value, neither rounded nor limited."""
        share = (si - self.si[0]) / (self.si[1] - self.si[0])
        return self.raw[0] + share * (self.raw[1] - self.raw[0])

    def to_count(self, si: float) -> int:
        """Return the accepted count nearest to an SI value, which may be infinite."""
        # Limited before rounding, since an infinite value cannot be rounded.
        low, high = sorted(self.ends or self.raw)
        return round(min(max(self.to_raw(si), low), high))


class FingerScale:
    """The scales of a gripper whose counts of speed and force refer to its fingertips.

    Those of the actuator follow from virtual work: force times change of width is effort times
    change of position.

    Args:
        position: Counts of the position to [rad | m].
        lever: Change of the width per change of the actuator's position [m/rad | 1].
        counts: Least and greatest count of speed and force.
        forces: Weakest and strongest grip [N].
        speeds: Slowest and fastest fingertip [m/s]; 0 if the gripper accepts no speed.

    Attributes:
        position: Counts to [rad | m].
        velocity: Counts to [rad/s | m/s].
        effort: Counts to [N·m | N].
    """

    def __init__(
        self,
        position: LinearScale,
        lever: float,
        counts: tuple[float, float],
        forces: tuple[float, float],
        speeds: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.position = position
        self.velocity = LinearScale(counts, (speeds[0] / lever, speeds[1] / lever))
        self.effort = LinearScale(counts, (forces[0] * lever, forces[1] * lever))
