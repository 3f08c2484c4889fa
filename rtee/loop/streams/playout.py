"""Decide when a sample is played: the client's clock, the network's jitter, and the lag for it.

A sample with the stamp s arrives at a. The least a - s over the last seconds is the offset of the
clocks and the shortest delay together (a minimum filter, as in NTP's clock filter, RFC 5905
section 10): what a sample comes later than that is its own delay. Mean and mean deviation of the
delays follow RFC 6298; the lag is a period, the mean and twice the deviation, as in Ramjee et al.,
"Adaptive Playout Mechanisms for Packetized Audio Applications" (1994), and bounded.
"""

from __future__ import annotations

import math
from collections import deque

_SPAN = 0.5
"""The least offset is kept for spans of this length [s] …"""

_SPANS = 8
"""… and taken over this many of them: 4 s, in which clocks drift by 0.4 ms at most (100 ppm)."""

_SHARE = 1.0 / 16.0
"""Weight of a sample in the means: as in RFC 3550, fast enough for a network that changes and slow
enough for a single late sample."""

_SETTLE = 0.3
"""The lag reaches a new value within about this time [s]: faster would be felt as a jerk."""

_FASTEST = 0.1
"""Meanwhile the stream is played faster or slower by at most this share, which nobody notices."""

_JUMP = 0.25
"""With a larger error than this [s] the clocks have jumped: the stream continues from there."""

LAG_PERIODS = 1.2
"""The default for the longest lag: this many periods …"""

LAG_MARGIN = 4e-3
"""… and this [s], a millisecond less than what is promised, for the tick and the way to the hand.
What comes later than that is covered by extrapolation."""


class Playout:
    """Maps the hand's time to that of a stream; pure: time is given.

    Args:
        rate: Samples per second that the client means to send [Hz].
        tick: Period of the loop [s].
        max_lag: Longest lag [s]; ``inf``: the default.

    Attributes:
        period: Mean time between the stamps of samples [s].
        jitter: Mean deviation of the samples' delays [s].
        time: What is played at the last tick, in the client's time [s].
        now: When that tick was due [s].
    """

    def __init__(self, rate: float, tick: float, max_lag: float = math.inf) -> None:
        self.period = 1.0 / rate
        self.jitter = 0.0
        self.time = -math.inf
        self._tick = tick
        self._max_lag = max_lag
        self._delay = 0.0
        self._offset = math.inf
        self._least: deque[float] = deque(maxlen=_SPANS)
        self._span_ends = -math.inf
        self._stamp = -math.inf
        self.now = 0.0

    @property
    def wanted_lag(self) -> float:
        """The lag that is aimed at [s]."""
        longest = self._max_lag
        if math.isinf(longest):
            longest = LAG_PERIODS * self.period + LAG_MARGIN
        # A sample may arrive just after a tick and waits for the next one then.
        return min(self.period + self._delay + 2.0 * self.jitter + self._tick, longest)

    @property
    def lag(self) -> float:
        """The lag at the last tick [s]."""
        return self.now - self._offset - self.time if math.isfinite(self.time) else 0.0

    def arrived(self, stamp: float, arrival: float) -> None:
        """Learn from a sample that is newer than those before.

        Args:
            stamp: When it was meant, by the client's clock [s].
            arrival: When it arrived, by the hand's clock [s].
        """
        offset = arrival - stamp
        if arrival >= self._span_ends:
            self._span_ends = arrival + _SPAN
            # A new span: the oldest falls out, and with it what the clocks have drifted since.
            self._least.append(offset)
        elif offset < self._least[-1]:
            self._least[-1] = offset
        self._offset = min(self._least)
        delay = offset - self._offset
        if math.isfinite(self._stamp):
            # A lost sample doubles the time to the next one, which is not the period; a client that
            # is slower than it said is found out, too, if later.
            step = min(stamp - self._stamp, 1.5 * self.period)
            self.period += _SHARE * (step - self.period)
            self._delay += _SHARE * (delay - self._delay)
            self.jitter += _SHARE * (abs(delay - self._delay) - self.jitter)
        self._stamp = stamp

    def restart(self, now: float) -> None:
        """Begin to play, or go on after a pause, at a time [s]."""
        self.now = now
        self.time = now - self._offset - self.wanted_lag

    def advance(self, now: float) -> bool:
        """Go on to a tick.

        Args:
            now: When it is due [s].

        Returns:
            Whether the stream's time has jumped, since the client's clock did.
        """
        passed, self.now = now - self.now, now
        aim = now - self._offset - self.wanted_lag
        error = aim - (self.time + passed)
        if abs(error) > _JUMP:
            self.time = aim
            return True
        # Never a step: what is wanted of the hand moves on smoothly while the lag changes.
        self.time += passed * (1.0 + min(max(error / _SETTLE, -_FASTEST), _FASTEST))
        return False
