"""The stream through which a hand follows set-points from topics and actions of ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import anyio

from rtee import monotonic
from rtee.errors import GoalRejected, LeaseHeld, NoHand, RequestRejected
from rtee.remote.stream import Stream
from rtee.ros2.parameters import Parameter
from rtee.ros2.served_hand import ServedHand
from rtee.ros2.trajectory import Motion, TimedPosture, movable_joints

STREAM_RATE = "stream_rate"
"""Name of the parameter for the rate of the stream."""

SETTLED = 0.3
"""Time for which the last set-point of a motion is repeated [s]: a stream plays its samples with a
lag, and brakes where it is when it ends."""

LINGER = 0.5
"""Time without set-points after which the stream ends [s], so that others may move the hand."""


@dataclass(eq=False, slots=True)
class Play:
    """A motion for the hand to follow, from a source such as a topic.

    Attributes:
        until: Time until which to send set-points [s]; after its end, the last one is repeated.
        failed: Called with the reason if the hand refuses or stops to follow the motion.
        replaced: Called with the source of another motion that replaces this one.
    """

    motion: Motion
    source: str
    until: float
    failed: Callable[[str], None]
    replaced: Callable[[str], None] | None = None


class Player:
    """Streams motions to the hand; the newest replaces any other, whatever its source.

    Attributes:
        joints: The joints that motions may move.
        last: The motion that began last, unless the hand refused to follow it.
    """

    def __init__(self, served: ServedHand) -> None:
        self.joints = movable_joints(served.model)
        self.last: Play | None = None
        self._served = served
        self._current: Play | None = None
        self._wake = anyio.Event()

    def play(self, play: Play) -> None:
        """Follow a motion from now on, instead of the present one."""
        before, self._current = self._current, play
        self.last = play
        self._wake.set()
        if before is not None and before.replaced is not None:
            before.replaced(play.source)

    def hold(self, names: Iterable[str], source: str, failed: Callable[[str], None]) -> None:
        """Hold joints at measured positions; ``failed`` gets the reason if the hand refuses."""
        now = monotonic.now()
        self.play(Play(self.here(names), source, now + SETTLED, failed))

    def here(self, names: Iterable[str]) -> TimedPosture:
        """Return the measured positions of joints, clamped to their limits, as a set-point."""
        position = {name: self.joints[name].clamped(self.where(name)) for name in names}
        return TimedPosture(position, monotonic.now())

    def where(self, name: str) -> float:
        """Return the measured position of a joint [rad | m]."""
        state = self._served.latest
        position = state.positions.get(name)
        return state.joints[name] if position is None else position

    def parameter(self) -> Parameter:
        """Return the parameter for the rate of the stream."""
        return Parameter(
            STREAM_RATE,
            100.0,
            "Set-points a second that trajectories and jogs are turned into, and the most that"
            " ~/commands may have [Hz]; it counts from the next stream on.",
            lower=20.0,
            upper=500.0,
        )

    async def run(self) -> None:
        """Stream while there are set-points, until the hand ends."""
        while True:
            await self._wake.wait()
            begun = self._current
            if begun is None:
                self._wake = anyio.Event()
                continue
            try:
                async with self._served.hand.stream(
                    rate=self._served.number(STREAM_RATE)
                ) as stream:
                    await self._follow(stream)
            except NoHand:
                # The hand has ended, and with it the node: this ends all parts.
                raise
            except (RequestRejected, GoalRejected, LeaseHeld) as error:
                # A pre-empted stream ends here, too; the rest of its motion is not sent.
                failed = self._current or self.last or begun
                self._current = self.last = None
                failed.failed(str(error))

    async def _follow(self, stream: Stream) -> None:
        """Send set-points until none have come for `LINGER`."""
        period = 1.0 / self._served.number(STREAM_RATE)
        while True:
            # A new event before anything is awaited, so that no later motion is missed.
            play, self._wake = self._current, anyio.Event()
            if play is None:
                with anyio.move_on_after(LINGER) as waiting:
                    await self._wake.wait()
                # The end of a stream at rest must not make the next motion fail.
                if waiting.cancelled_caught or stream.ended:
                    return
                continue
            now = monotonic.now()
            targets, velocity = play.motion.at(now)
            # Stamped with the set-point's time, so that a late sample keeps the motion's shape.
            await stream.send(targets, velocity, stamp=now)
            # Another motion may have replaced it while the sample was sent.
            if now >= play.until and play is self._current:
                self._current = None
                continue
            with anyio.move_on_after(period):
                await self._wake.wait()
