"""The time base of a stream: the stamps of its samples, by one clock that never jumps.

The clock of a client may jump, its counter may restart or wrap, and its first sample may come late
out of a queue. Samples whose stamps contradict those before are refused at first. When several in a
row agree among themselves, the time base is taken from them: they are given the stamps with which
they continue the stream, so that what follows sees no jump.
"""

from __future__ import annotations

import math

from rtee.errors import GoalRejected

_AHEAD = 0.5
"""A stamp may lead the hand's clock by this much more than earlier stamps [s]: a network does not
get that much faster."""

_BEHIND = 1.0
"""A stamp this much older than the newest one is not a sample out of order but a mistake [s]:
networks reorder within milliseconds."""

_LEAK = 1e-3
"""Rise of the least offset between the clocks [s/s]: far more than clocks drift."""

_AGREEING = 4
"""Samples in a row that agree before the time base is taken from them: three steps in succession
are no coincidence, and at 50 Hz the hand has not paused yet."""

_SPREAD = 0.25
"""Largest difference of the delays of samples that agree [s]: that of a bad wireless network."""

_PROGRESS = 0.5
"""Least time between two samples that agree, on average, in periods of the stream, by either clock.
Samples of the past that a network has held back arrive all at once."""


class TimeBase:
    """Maps the stamps of a stream's samples to one time base; pure: time is given.

    Args:
        rate: Samples per second that the client intends to send [Hz].
        now: Time by the hand's clock [s].
    """

    def __init__(self, rate: float, now: float) -> None:
        self._least_span = (_AGREEING - 1) * _PROGRESS / rate
        self._shift = 0.0
        self._newest = -math.inf
        self._offset, self._offset_at = math.inf, now
        self._doubted: list[tuple[float, float]] = []

    def place(self, stamp: float, now: float) -> float:
        """Return a sample's stamp in the stream's time base [s].

        Args:
            stamp: Its stamp by the client's clock [s].
            now: Time of its arrival by the hand's clock [s].

        Raises:
            GoalRejected: if it contradicts the stamps before.
        """
        if not math.isfinite(stamp):
            raise GoalRejected(f"the stamp must be a time in seconds, not {stamp:g}")
        placed = stamp + self._shift
        wrong = self._wrong(placed, now)
        if wrong or placed <= self._newest:
            if self._agrees(stamp, now):
                # With the least delay of these samples as the least delay before.
                least = min(arrival - each for each, arrival in self._doubted)
                self._shift = least - self._least(now)
                placed, wrong = stamp + self._shift, ""
                self._doubted.clear()
        else:
            self._doubted.clear()
        if wrong:
            raise GoalRejected(f"{wrong}: stamps come from one clock that never jumps, in seconds")
        self._newest = max(self._newest, placed)
        self._offset, self._offset_at = min(now - placed, self._least(now)), now
        return placed

    def _least(self, now: float) -> float:
        """Return the least difference of arrival and stamp [s], as far as it is still believed."""
        return self._offset + _LEAK * (now - self._offset_at)

    def _wrong(self, placed: float, now: float) -> str:
        """Return in words how a stamp contradicts those before, or an empty string."""
        if placed < self._newest - _BEHIND:
            return f"the stamp is {self._newest - placed:.3g} s before the newest one"
        least = self._least(now)
        if math.isfinite(least) and now - placed < least - _AHEAD:
            return f"the stamp is {least - (now - placed):.3g} s in the future beside those before"
        return ""

    def _agrees(self, stamp: float, now: float) -> bool:
        """Note a sample that contradicts, and return whether enough of them agree."""
        doubted = self._doubted
        delays = [arrival - each for each, arrival in doubted] + [now - stamp]
        if doubted and (stamp <= doubted[-1][0] or max(delays) - min(delays) > _SPREAD):
            doubted.clear()
        doubted.append((stamp, now))
        if len(doubted) < _AGREEING:
            return False
        del doubted[:-_AGREEING]
        first, arrival = doubted[0]
        return min(stamp - first, now - arrival) >= self._least_span
