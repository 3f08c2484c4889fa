"""From a device's counts to SI units and back."""

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

    def to_raw(self, si: float) -> float:
        """Return the device's value for an SI value, neither rounded nor limited."""
        share = (si - self.si[0]) / (self.si[1] - self.si[0])
        return self.raw[0] + share * (self.raw[1] - self.raw[0])

    def to_count(self, si: float) -> int:
        """Return the accepted count nearest to an SI value, which may be infinite."""
        # Limited before rounding, since an infinite value cannot be rounded.
        low, high = sorted(self.ends or self.raw)
        return round(min(max(self.to_raw(si), low), high))
