"""Play a stream in the loop: accept samples, pause without them, compute each tick's positions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from rtee.commands import STREAM_ENDED, BeginStream, StreamSample, StreamStatus
from rtee.loop.motion import MotionLimits
from rtee.loop.streams.interpolator import Interpolator
from rtee.loop.streams.playout import Playout
from rtee.sample import FloatArray
from rtee.types import Event, readonly

CHANNEL = "stream/lag"
"""Channel of the state with lag and jitter of a stream [s], while it plays."""


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
        channels: Lag and jitter ``(2,)`` [s], by `CHANNEL`.
    """

    def __init__(self, begin: BeginStream, limits: MotionLimits, tick: float) -> None:
        self.name, self.deadline, self.effort = begin.stream, begin.deadline, begin.effort
        self.playing = False
        self.channels: Mapping[str, FloatArray] = {CHANNEL: readonly((0.0, 0.0))}
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
                # From where it was sent last, so that it does not jump.
                path.include(index, reference[index], speed[index])
        path.add(positions, velocities, sample.stamp, playout.time, playout.now, playout.period)
        self.channels = {CHANNEL: np.array((playout.lag, playout.jitter))}

    def overdue(self, now: float) -> bool:
        """Return whether no sample came within the deadline."""
        return self.playing and now - self._arrival > self.deadline

    def pause(self, now: float) -> Event:
        """Pause until the next sample; return the event that reports it."""
        self.playing = False
        self._pauses += 1
        self._path.clear()
        text = f"no sample for {self.deadline * 1e3:.0f} ms: braked, and holding"
        return Event("stream_paused", self.name, text, now, "warning")

    def ended(self, why: str, now: float) -> Event:
        """Return the event that reports the end of the stream; ``why``: the reason in words."""
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
