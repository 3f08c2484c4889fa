"""The stream through which a hand follows set-points from ROS 2, of topics and of actions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import anyio

from rtee.errors import GoalRejected, LeaseHeld, NoHand, RequestRejected
from rtee.remote.stream import Stream
from rtee.ros2.face import Face
from rtee.ros2.parameters import Parameter
from rtee.ros2.trajectory import Motion, Posture, movable_joints

STREAM_RATE = "stream_rate"
"""Name of the parameter with the rate of the stream."""

SETTLED = 0.3
"""The end of a motion is repeated for this long [s]: a stream plays a lag behind its samples, and
brakes where it is when it ends."""

LINGER = 0.5
"""A stream without set-points is ended after this long [s], so that others may move the hand."""


@dataclass(eq=False, slots=True)
class Play:
    """A motion that the hand is to follow.

    Attributes:
        motion: The motion.
        source: What it came by, in words.
        until: Until when its set-points are sent, those after its end being the last one [s].
        failed: Called with the reason if the hand does not follow it, or no more.
        replaced: Called with the source of another motion that takes its place.
    """

    motion: Motion
    source: str
    until: float
    failed: Callable[[str], None]
    replaced: Callable[[str], None] | None = None


class Player:
    """Has the hand follow motions; the newest counts, whatever it came by.

    Args:
        face: The hand and its node.

    Attributes:
        joints: The joints that motions may move.
        last: The motion that was begun last, unless the hand refused to follow it.
    """

    def __init__(self, face: Face) -> None:
        self.joints = movable_joints(face.model)
        self.last: Play | None = None
        self._face = face
        self._current: Play | None = None
        self._wake = anyio.Event()

    def play(self, play: Play) -> None:
        """Follow a motion from now on, in place of the one before."""
        before, self._current = self._current, play
        self.last = play
        self._wake.set()
        if before is not None and before.replaced is not None:
            before.replaced(play.source)

    def hold(self, names: Iterable[str], source: str, failed: Callable[[str], None]) -> None:
        """Hold joints where they are measured to be.

        Args:
            names: The joints.
            source: What asked for that, in words.
            failed: Called with the reason if the hand does not.
        """
        now = time.monotonic()
        self.play(Play(self.here(names), source, now + SETTLED, failed))

    def here(self, names: Iterable[str]) -> Posture:
        """Return where joints are measured to be, inside their limits, as a set-point for now."""
        position = {name: self.joints[name].clamped(self.where(name)) for name in names}
        return Posture(position, time.monotonic())

    def where(self, name: str) -> float:
        """Return where a joint is measured to be [rad | m]."""
        state = self._face.latest
        found = state.positions.get(name)
        return state.joints[name] if found is None else found

    def parameter(self) -> Parameter:
        """Return the rate of the stream."""
        return Parameter(
            STREAM_RATE,
            100.0,
            "Set-points a second that trajectories and jogs are turned into, and the most that"
            " ~/commands may have [Hz]; it counts from the next stream on.",
            lower=20.0,
            upper=500.0,
        )

    async def run(self) -> None:
        """Stream while there are set-points, until the hand goes."""
        while True:
            await self._wake.wait()
            begun = self._current
            if begun is None:
                self._wake = anyio.Event()
                continue
            try:
                async with self._face.hand.stream(rate=self._face.number(STREAM_RATE)) as stream:
                    await self._follow(stream)
            except NoHand:
                raise
            except (RequestRejected, GoalRejected, LeaseHeld) as error:
                # Also what has pre-empted the stream: it is not begun again for what is left.
                failed = self._current or self.last or begun
                self._current = self.last = None
                failed.failed(str(error))

    async def _follow(self, stream: Stream) -> None:
        """Send set-points until there have been none for a while."""
        period = 1.0 / self._face.number(STREAM_RATE)
        while True:
            # A new event before anything is awaited: no motion that comes from here on is missed.
            play, self._wake = self._current, anyio.Event()
            if play is None:
                with anyio.move_on_after(LINGER) as waiting:
                    await self._wake.wait()
                # What has ended a stream that was at rest does not count for what comes next.
                if waiting.cancelled_caught or stream.ended:
                    return
                continue
            now = time.monotonic()
            targets, velocity = play.motion.at(now)
            # Stamped with the time it is meant for: if it is sent late, the motion keeps its shape.
            await stream.send(targets, velocity, stamp=now)
            # While the sample was sent, another motion may have taken its place.
            if now >= play.until and play is self._current:
                self._current = None
                continue
            with anyio.move_on_after(period):
                await self._wake.wait()
