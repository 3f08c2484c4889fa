"""From a device's counts to SI units and back."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LinearScale:
    """The line through two points at which a device's value and its SI value are known.

    Attributes:
        raw: The device's value at both points [counts].
        si: The SI value there.
        ends: Least and greatest value that the device takes; by default those of ``raw``.
    """

    raw: tuple[float, float]
    si: tuple[float, float]
    ends: tuple[float, float] | None = None

    @property
    def gain(self) -> float:
        """SI units per count."""
        return (self.si[1] - self.si[0]) / (self.raw[1] - self.raw[0])

    def to_si(self, raw: float) -> float:
        """Return the SI value of the device's value."""
        share = (raw - self.raw[0]) / (self.raw[1] - self.raw[0])
        return self.si[0] + share * (self.si[1] - self.si[0])

    def to_raw(self, si: float) -> float:
        """Return the device's value of an SI value, unrounded and not limited."""
        share = (si - self.si[0]) / (self.si[1] - self.si[0])
        return self.raw[0] + share * (self.raw[1] - self.raw[0])

    def to_count(self, si: float) -> int:
        """Return the nearest count that the device takes for an SI value, which may be infinite."""
        # Limited before rounding, since an infinite value cannot be rounded.
        low, high = sorted(self.ends or self.raw)
        return round(min(max(self.to_raw(si), low), high))
