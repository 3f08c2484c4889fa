"""Accept samples for the loop: checked in the thread in which they arrive, and rate-limited."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from rtee.commands import BeginStream, Command, EndStream, StreamSample, StreamStatus, StreamTargets
from rtee.errors import GoalRejected
from rtee.hand.config_schema import LONGEST_DEADLINE
from rtee.loop.forces import effort_limits
from rtee.loop.streams.targets import Targets

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.loop.controller import Controller
    from rtee.loop.devices import Devices


_AHEAD = 0.5
"""A stamp may be ahead of the hand's clock by this much more than earlier stamps [s]: no network
becomes that much faster."""

_BEHIND = 1.0
"""A stamp this much older than the newest one is a mistake, not a reordered sample [s]: networks
reorder within milliseconds."""

_LEAK = 1e-3
"""Rate at which the least offset between the clocks may rise [s/s]: far above any clock drift."""

_AGREEING = 4
"""Samples in a row that must agree before the time base is taken from them: three are no
coincidence, and at 50 Hz the hand has not paused yet."""

_SPREAD = 0.25
"""Largest difference between the delays of agreeing samples [s]: that of a bad wireless network."""

_PROGRESS = 0.5
"""Least mean time between agreeing samples, in periods of the stream, by either clock. Old samples
that a network has held back arrive all at once."""


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
                # The least delay of these samples replaces the earlier one.
                least = min(arrival - each for each, arrival in self._doubted)
                self._shift = least - self._least(now)
                placed, wrong = stamp + self._shift, ""
                self._doubted.clear()
        else:
            self._doubted.clear()
        if wrong:
            raise GoalRejected(
                f"{wrong}: take all stamps from one clock that never jumps, in seconds"
            )
        self._newest = max(self._newest, placed)
        self._offset, self._offset_at = min(now - placed, self._least(now)), now
        return placed

    def _least(self, now: float) -> float:
        """Return the least difference of arrival and stamp [s], plus the drift allowed since."""
        return self._offset + _LEAK * (now - self._offset_at)

    def _wrong(self, placed: float, now: float) -> str:
        """Describe how a stamp contradicts those before, or return an empty string."""
        if placed < self._newest - _BEHIND:
            return f"the stamp is {self._newest - placed:.3g} s before the newest one"
        least = self._least(now)
        if math.isfinite(least) and now - placed < least - _AHEAD:
            return f"the stamp is {least - (now - placed):.3g} s ahead of those before"
        return ""

    def _agrees(self, stamp: float, now: float) -> bool:
        """Record a contradicting sample; return whether enough of them agree with each other."""
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


MAX_RATE = 500.0
"""Highest rate of samples [Hz]: above that of gloves and planners, and within what a hand's
computer can decode beside its loop."""

_LEAST_PERIODS = 1.5
"""A deadline must be longer than this many periods, or each sample would end in a pause."""

_BURST = 20.0
"""Samples that may arrive at once: those of 0.4 s at 50 Hz, held back by a stalled network."""

_FASTER = 1.5
"""Factor by which samples may be faster than the stream's rate, since clocks and timers differ."""

_QUIET = 0.1
"""After a refusal, further ones are only counted for this long [s]: a wrong stream is wrong in
every sample."""

_MOST_KEPT = 32
"""Most sets of names whose resolution is cached: more than a client alternates between."""


class StreamIntake:
    """Checks the samples of a hand's stream and queues them for the next tick.

    One stream is open at a time. One thread at a time may call the methods.

    Args:
        controller: The controller of the hand, which plays the stream.
        library: The hand's actions.
        append: Queues a command for the next tick.
        devices: The hand's devices, which may be inactive or refuse effort limits.
        now: The loop's clock [s].
    """

    def __init__(
        self,
        controller: Controller,
        library: ActionLibrary,
        append: Callable[[Command], None],
        devices: Devices,
        now: Callable[[], float],
    ) -> None:
        self._controller, self._library = controller, library
        self._hand, self._settings = controller.hand, controller.settings
        self._append, self._devices, self._now = append, devices, now
        self._open = ""
        self._rate = 0.0
        self._known: dict[tuple[str, ...], Targets] = {}
        self._tokens = self._filled = 0.0
        self._time = TimeBase(1.0, 0.0)
        self._quiet_until = -math.inf
        self._thinned = self._refused = 0

    @property
    def stream(self) -> str:
        """The open stream, or an empty string."""
        return "" if self._open == self._controller.ended_stream else self._open

    def begin(
        self,
        stream: str,
        rate: float,
        deadline: float | None = None,
        effort: Mapping[str, float] | None = None,
    ) -> None:
        """Open a stream, ending an open one. Nothing moves before its first sample.

        Args:
            stream: Its identifier, without spaces.
            rate: Samples per second that the client intends to send [Hz].
            deadline: Time without a sample after which the hand brakes and holds [s]; ``None``: as
                configured.
            effort: Effort limits by actuator [N·m | N]; other actuators keep the hand's own.

        Raises:
            GoalRejected: if a number cannot be used.
        """
        settings = self._settings
        most = min(MAX_RATE, settings.rate)
        if not 0.0 < rate <= most:
            raise GoalRejected(
                f"a stream to this hand may have up to {most:g} samples a second, not {rate:g}; "
                "the loop interpolates between them"
            )
        within = settings.stream.deadline if deadline is None else deadline
        if not 0.0 < within <= LONGEST_DEADLINE:
            raise GoalRejected(
                f"the deadline must be above 0 and at most {LONGEST_DEADLINE:g} s, not {within:g}"
            )
        if within < _LEAST_PERIODS / rate:
            raise GoalRejected(
                f"a stream at {rate:g} Hz would pause after every sample with the deadline "
                f"{within:g} s; give one of at least {_LEAST_PERIODS / rate:.3g} s"
            )
        wanted = dict(effort or {})
        effort_limits(wanted, self._hand, self._devices.forces().refused)
        now = self._now()
        self._rate, self._tokens, self._filled = rate, _BURST, now
        self._time = TimeBase(rate, now)
        self._quiet_until = -math.inf
        self._thinned = self._refused = 0
        self._known.clear()  # the library may have changed
        longest = settings.stream.max_lag
        self._open = stream
        lag = math.inf if longest is None else longest
        self._append(BeginStream(stream, rate, within, lag, wanted))

    def admit(self) -> bool:
        """Return whether the rate limit permits another sample; cheap, since floods call it, too.

        Refused samples are counted (`StreamStatus.thinned`): the next ones replace them.
        """
        now = self._now()
        rate = _FASTER * self._rate
        # A token bucket: the rate in the long run, bursts up to its size.
        self._tokens = min(self._tokens + (now - self._filled) * rate, _BURST)
        self._filled = now
        if self._tokens >= 1.0:
            self._tokens -= 1.0
            return True
        self._thinned += 1
        return False

    def sample(self, sample: StreamTargets) -> None:
        """Check a sample and queue it for the next tick.

        Raises:
            GoalRejected: if it cannot be used; refusals in quick succession are only counted.
        """
        now = self._now()
        if not sample.stream or sample.stream != self.stream:
            self._refuse(now, f"there is no stream '{sample.stream[:50]}'; it may have ended")
            return
        try:
            positions, rates = self._checked(sample)
            # Last: a sample that is refused for its targets must not change the time base.
            stamp = self._time.place(sample.stamp, now)
        except GoalRejected as error:
            self._refused += 1
            self._refuse(now, str(error))
            return
        names = self._hand.actuator_names
        self._append(
            StreamSample(
                sample.stream,
                stamp,
                now,
                sample.targets,
                sample.velocity,
                {names[i]: position for i, position in positions.items()},
                {names[i]: rates.get(i, math.nan) for i in positions},
            )
        )

    def end(self, stream: str, reason: str = "") -> None:
        """Close a stream: its actuators brake and hold. Ignores a stream that is not open."""
        if stream and stream == self.stream:
            self._append(EndStream(stream, reason))
            self._open = ""

    def status(self) -> StreamStatus:
        """Return the status of the open stream."""
        # Read once: the loop may end the stream at any time.
        player = self._controller.stream
        if player is None or player.name != self._open:
            return StreamStatus()
        return replace(player.status(), thinned=self._thinned, refused=self._refused)

    def _refuse(self, now: float, text: str) -> None:
        """Raise `GoalRejected`, unless a refusal was raised a moment ago."""
        if now >= self._quiet_until:
            self._quiet_until = now + _QUIET
            raise GoalRejected(text)

    def _checked(self, sample: StreamTargets) -> tuple[Mapping[int, float], Mapping[int, float]]:
        """Return positions and velocities of a sample, by actuator index."""
        if not sample.targets:
            raise GoalRejected("a sample needs at least one target")
        names = tuple(sample.targets)
        targets = self._known.get(names)
        if targets is None:
            targets = Targets(names, self._hand, self._library)
            self._devices.check_movable(targets.indices)
            if len(self._known) >= _MOST_KEPT:
                self._known.clear()
            self._known[names] = targets
        return targets.resolve(sample.targets, sample.velocity)
