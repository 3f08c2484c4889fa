"""Decide when samples are played, from estimates of the clocks' offset and the network's jitter.

A sample with the stamp s arrives at a. The least a - s over the last seconds is the offset of the
clocks plus the shortest delay (a minimum filter, as in NTP's clock filter, RFC 5905 section 10);
the rest of a - s is the delay of the sample. Mean and mean deviation of the delays follow RFC 6298.
The lag is a period, the mean and twice the deviation, as in Ramjee et al., "Adaptive Playout
Mechanisms for Packetized Audio Applications" (1994), and bounded.
"""

from __future__ import annotations

import math
from collections import deque

_SPAN = 0.5
"""Length of the spans whose least offsets are kept, instead of those of all samples [s]: the older
offsets are forgotten in steps of this length."""

_SPANS = 8
"""Spans over which the least offset is taken: 4 s, in which clocks drift by at most 0.4 ms
(100 ppm)."""

_SHARE = 1.0 / 16.0
"""Weight of a sample in the means: as in RFC 3550, fast enough for a changing network and slow
enough for a single late sample."""

_SETTLE = 0.3
"""Time in which the lag reaches a new value, about [s]: a faster change would feel like a jerk."""

_FASTEST = 0.1
"""Largest share by which the stream is played faster or slower until then: too little to be
noticed."""

_EASE = 0.05
"""Time constant of that share [s], which changes with every sample, and the path's velocity with
it. A sixth of `_SETTLE`, so that the lag settles without oscillating."""

_JUMP = 0.25
"""An error larger than this [s] means that a clock has jumped: the stream continues from there."""

LAG_PERIODS = 1.2
"""Default of the longest lag in periods, besides `LAG_MARGIN`."""

LAG_MARGIN = 3e-3
"""Default of the longest lag besides `LAG_PERIODS` [s]: two milliseconds less than what is
promised, for the tick and the transmission to the hand. Extrapolation covers samples that are
later."""


class Playout:
    """Maps the hand's time to that of a stream; pure: time is given.

    Args:
        rate: Samples per second that the client intends to send [Hz].
        tick: Period of the loop [s].
        max_lag: Longest lag [s]; ``inf``: the default.

    Attributes:
        period: Mean time between the stamps of samples [s].
        jitter: Mean deviation of the samples' delays [s].
        time: Time played at the last tick, by the client's clock [s].
        now: Due time of that tick, by the hand's clock [s].
    """

    def __init__(self, rate: float, tick: float, max_lag: float = math.inf) -> None:
        self.period = 1.0 / rate
        self.jitter = 0.0
        self.time = -math.inf
        self._tick = tick
        self._faster = 0.0
        self._max_lag = max_lag
        self._delay = 0.0
        self._offset = math.inf
        self._least: deque[float] = deque(maxlen=_SPANS)
        self._span_ends = -math.inf
        self._stamp = -math.inf
        self.now = 0.0

    @property
    def wanted_lag(self) -> float:
        """The lag aimed at [s]."""
        longest = self._max_lag
        if math.isinf(longest):
            longest = LAG_PERIODS * self.period + LAG_MARGIN
        # A sample that arrives just after a tick waits for the next one.
        return min(self.period + self._delay + 2.0 * self.jitter + self._tick, longest)

    @property
    def lag(self) -> float:
        """The lag at the last tick [s]."""
        return self.now - self._offset - self.time if math.isfinite(self.time) else 0.0

    def arrived(self, stamp: float, arrival: float) -> None:
        """Update the estimates by a sample that is newer than those before.

        Args:
            stamp: Stamp of the sample, by the client's clock [s].
            arrival: Time of its arrival, by the hand's clock [s].
        """
        offset = arrival - stamp
        if arrival >= self._span_ends:
            self._span_ends = arrival + _SPAN
            # A new span drops the oldest one, and with it the drift of the clocks since.
            self._least.append(offset)
        elif offset < self._least[-1]:
            self._least[-1] = offset
        self._offset = min(self._least)
        delay = offset - self._offset
        if math.isfinite(self._stamp):
            # A lost sample doubles the time to the next one, so the step is bounded; a client
            # slower than announced is still followed, though later.
            step = min(stamp - self._stamp, 1.5 * self.period)
            self.period += _SHARE * (step - self.period)
            self._delay += _SHARE * (delay - self._delay)
            self.jitter += _SHARE * (abs(delay - self._delay) - self.jitter)
        self._stamp = stamp

    def restart(self, now: float) -> None:
        """Begin to play, or continue after a pause, at a time by the hand's clock [s]."""
        self.now = now
        self.time = now - self._offset - self.wanted_lag
        self._faster = 0.0

    def advance(self, now: float) -> bool:
        """Advance to a tick, by its due time [s].

        Returns:
            Whether the stream's time has jumped, because the client's clock has.
        """
        passed, self.now = now - self.now, now
        aim = now - self._offset - self.wanted_lag
        error = aim - (self.time + passed)
        if abs(error) > _JUMP:
            self.time = aim
            return True
        # No step: the wanted position must move smoothly while the lag changes.
        wanted = min(max(error / _SETTLE, -_FASTEST), _FASTEST)
        self._faster += (wanted - self._faster) * min(passed / _EASE, 1.0)
        self.time += passed * (1.0 + self._faster)
        return False
