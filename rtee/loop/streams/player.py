"""Play a stream in the loop: accept samples, pause without them, compute each tick's positions."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet

import numpy as np

from rtee.commands import STREAM_ENDED, BeginStream, StreamSample, StreamStatus
from rtee.hand.model import Hand
from rtee.loop.evidence import ContactMonitor
from rtee.loop.measured import Measured
from rtee.loop.motion import MotionLimits
from rtee.loop.streams.interpolator import Interpolator
from rtee.sample import FloatArray
from rtee.types import Event, readonly

_SPAN = 0.5
"""Length of a span [s]: the least offset of each span is kept instead of every sample's, and old
offsets are forgotten a span at a time."""

_SPANS = 8
"""Spans over which the least offset is taken: 4 s, in which clocks drift by at most 0.4 ms
(100 ppm)."""

_SHARE = 1.0 / 16.0
"""Weight of a sample in the means: as in RFC 3550, fast enough for a changing network and slow
enough for a single late sample."""

_SETTLE = 0.3
"""Approximate time in which the lag reaches a new value [s]: a faster change would be felt as a
jerk."""

_FASTEST = 0.1
"""Largest share by which the stream is played faster or slower meanwhile: too little to notice."""

_EASE = 0.05
"""Time constant that smooths this share [s]: it changes with every sample, and would otherwise make
the velocity jump. A sixth of `_SETTLE`, so that the lag settles without oscillating."""

_JUMP = 0.25
"""An error larger than this [s] means that a clock has jumped: the stream continues from there."""

LAG_PERIODS = 1.2
"""Default of the longest lag in periods, besides `LAG_MARGIN`."""

LAG_MARGIN = 3e-3
"""Default of the longest lag besides `LAG_PERIODS` [s]: two milliseconds less than promised, for
the tick and the transmission to the hand. Extrapolation covers later samples."""


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
        """The lag to settle at [s]."""
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
        """Update the estimates with a sample that is newer than all before.

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
            # A lost sample doubles the time to the next one, so the step is bounded; the estimate
            # still follows a client slower than announced, though later.
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


LAG_CHANNEL = "stream/lag"
"""The state's channel with the lag and jitter of a stream [s], while it plays."""


_SAME = 1e-6
"""Stamps closer than this are the same [s]: it is the resolution of clocks, and slopes between
samples must stay finite."""


class StreamPlayer:
    """Plays one stream; pure: the same samples and ticks give the same references.

    Args:
        begin: The stream.
        limits: Limits of all actuators of the hand.
        tick: Period of the loop [s].

    Attributes:
        name: The stream's identifier.
        deadline: Time without a sample after which the stream pauses [s].
        effort: Effort limits by actuator [N·m | N]; other actuators keep the hand's own.
        playing: Whether the stream moves actuators: from a first sample until it pauses.
        channels: Lag and jitter ``(2,)`` [s], by `LAG_CHANNEL`.
    """

    def __init__(self, begin: BeginStream, limits: MotionLimits, tick: float) -> None:
        self.name, self.deadline, self.effort = begin.stream, begin.deadline, begin.effort
        self.playing = False
        self.channels: Mapping[str, FloatArray] = {LAG_CHANNEL: readonly((0.0, 0.0))}
        self._playout = Playout(begin.rate, tick, begin.max_lag)
        self._path = Interpolator(limits, tick)
        self._arrival = -math.inf
        self._doubted = False
        self._newest = -math.inf
        self._samples = self._duplicates = self._out_of_order = 0
        self._outliers = self._late = self._pauses = 0

    @property
    def indices(self) -> Sequence[int]:
        """The actuators that the stream moves."""
        return self._path.indices

    def status(self) -> StreamStatus:
        """Return the status of the stream; samples dropped before the loop are not counted."""
        playout = self._playout
        return StreamStatus(
            stream=self.name,
            rate=1.0 / playout.period,
            lag=playout.lag,
            jitter=playout.jitter,
            samples=self._samples,
            duplicates=self._duplicates,
            out_of_order=self._out_of_order,
            outliers=self._outliers,
            late=self._late,
            pauses=self._pauses,
        )

    def taken(self, sample: StreamSample, positions: Mapping[int, float]) -> bool:
        """Return whether to take a sample; dropped samples are counted.

        A sample far from the last one is dropped; if the next one is far, too, the motion is
        intended.
        """
        if abs(sample.stamp - self._newest) < _SAME:
            self._duplicates += 1
        elif sample.stamp < self._newest:
            self._out_of_order += 1
        elif not self._doubted and self._path.outlying(positions, sample.stamp):
            self._outliers += 1
            self._doubted = True
            self._arrival = sample.arrival  # the client is alive, whatever it sent
        else:
            self._doubted = False
            return True
        return False

    def take(
        self,
        sample: StreamSample,
        positions: Mapping[int, float],
        velocities: Mapping[int, float],
        now: float,
        reference: Sequence[float],
        speed: Sequence[float],
    ) -> None:
        """Take a sample.

        Args:
            sample: The sample.
            positions: Its positions by actuator [rad | m].
            velocities: Its velocities by actuator [rad/s | m/s]; ``NaN``: not given.
            now: When the tick is due [s].
            reference: Positions sent last, of all actuators [rad | m].
            speed: Their velocities [rad/s | m/s].
        """
        playout, path = self._playout, self._path
        self._samples += 1
        self._newest = sample.stamp
        self._arrival = sample.arrival
        playout.arrived(sample.stamp, sample.arrival)
        if not self.playing:
            self.playing = True
            playout.restart(now)
        elif sample.stamp < playout.time:
            self._late += 1
        for index in positions:
            if index not in path.indices:
                # From the position sent last, so that the actuator does not jump.
                path.include(index, reference[index], speed[index])
        path.add(positions, velocities, sample.stamp, playout.time, playout.now, playout.period)
        self.channels = {LAG_CHANNEL: np.array((playout.lag, playout.jitter))}

    def overdue(self, now: float) -> bool:
        """Return whether the deadline has passed without a sample."""
        return self.playing and now - self._arrival > self.deadline

    def pause(self, now: float) -> Event:
        """Pause until the next sample; return the event that reports it."""
        self.playing = False
        self._pauses += 1
        self._path.clear()
        text = f"no sample for {self.deadline * 1e3:.0f} ms: braked, and holding"
        return Event("stream_paused", self.name, text, now, "warning")

    def ended(self, why: str, now: float) -> Event:
        """Return the event that reports the end of the stream, with the reason ``why``."""
        dropped = self._duplicates + self._out_of_order + self._outliers
        text = f"the stream ended: {why}; {self._samples} samples taken, {dropped} dropped"
        return Event(STREAM_ENDED, self.name, text, now)

    def step(
        self, now: float, position: Sequence[float], velocity: Sequence[float], into: list[float]
    ) -> None:
        """Advance the stream's actuators by one period of the loop.

        Args:
            now: When the tick is due [s].
            position: Positions sent last, of all actuators [rad | m].
            velocity: Their velocities [rad/s | m/s].
            into: Receives the positions to send, of the stream's actuators [rad | m].
        """
        playout, path = self._playout, self._path
        last, before = playout.time, playout.now
        if playout.advance(now):
            path.jumped(last, playout.time, before, playout.period)
        path.step(playout.time, now, playout.period, position, velocity, into)


_TOLERANCE = 0.01
"""An actuator that lags by less than this share of its range is not blocked: goals end as close to
their targets."""


class StreamHold:
    """Detects which actuators of a stream hold an object.

    Args:
        hand: The hand.
        contact: Detects blocked and grasping actuators.
        reference: Positions sent last, of all actuators [rad | m].
        limits: Effort limits sent last [N·m | N].
        eased: Actuators whose effort is lowered because they hold an object.
    """

    def __init__(
        self,
        hand: Hand,
        contact: ContactMonitor,
        reference: Sequence[float],
        limits: Sequence[float],
        eased: set[int],
    ) -> None:
        self._hand, self._contact = hand, contact
        self._reference, self._limits, self._eased = reference, limits, eased

    def begin(self, targets: Mapping[int, float], stamp: float) -> None:
        """Begin to watch actuators that a stream moves from now on.

        Args:
            targets: Their target positions, by index [rad | m].
            stamp: Now [s].
        """
        tolerance: dict[int, float] = {}
        for i in targets:
            actuator = self._hand.actuators[i]
            span = actuator.upper - actuator.lower
            # An actuator without limits has no range; 1 rad is a typical one.
            tolerance[i] = _TOLERANCE * (span if math.isfinite(span) else 1.0)
        self._contact.begin(targets, tolerance, stamp)

    def limits(self, stream: StreamPlayer, indices: AbstractSet[int]) -> dict[int, float]:
        """Return the effort limits of a stream for some actuators, by index [N·m | N]."""
        names = self._hand.actuator_names
        return {i: stream.effort[names[i]] for i in indices if names[i] in stream.effort}

    def aim(self, targets: Mapping[int, float]) -> None:
        """Set the target positions of a sample, by index [rad | m]."""
        for i, target in targets.items():
            self._contact.aim(i, target)

    def look(self, stream: StreamPlayer, stamp: float, measured: Measured) -> bool:
        """Evaluate a stream's actuators now [s]; restore the effort of those without an object.

        Returns:
            Whether an eased actuator has reached its reference, and is eased no longer.
        """
        reference = self._reference
        # Actuators that grasp an object are skipped: the controller detects its loss.
        free = [i for i in stream.indices if not self._contact.clasped(i, reference[i])]
        self._contact.update(stamp, measured, reference, self._limits, free)
        freed = {
            i
            for i in self._eased.intersection(stream.indices)
            if abs(reference[i] - measured.position[i]) <= self._contact.tolerance(i)
        }
        self._eased -= freed
        return bool(freed)
