"""What a device's exchanges came to."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Accounts:
    """Counters of one device since the start, and the rate of its exchanges.

    Attributes:
        exchanges: Exchanges done.
        overruns: Times it was due again before an exchange was over.
        errors: Exchanges that failed.
        in_row: Of those, the last ones without one that worked in between.
        reconnects: Times the link was re-established.
    """

    exchanges: int = 0
    overruns: int = 0
    errors: int = 0
    in_row: int = 0
    reconnects: int = 0
    _rate: float = 0.0
    _since: float = 0.0
    _counted: int = 0

    def rate(self, now: float) -> float:
        """Return the rate of exchanges [Hz] over the last second or since it was asked last."""
        passed = now - self._since
        if passed >= 0.5:
            self._rate = (self.exchanges - self._counted) / passed if self._since else 0.0
            self._since, self._counted = now, self.exchanges
        return self._rate
