"""Streams of a client: set-points in quick succession, as from a glove or a planner.

async with hand.stream(rate=50) as stream:
    async for t in stream.pace():
        await stream.send({"PinchTight index thumb": 0.2 + 0.2 * math.sin(t)})
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from typing import TYPE_CHECKING

import anyio

from rtee import monotonic
from rtee.commands import STREAM_ENDED, StreamStatus, StreamTargets
from rtee.errors import NoHand, RemoteError, RequestRejected
from rtee.messages import EVENT, topics
from rtee.messages.convert import STREAM_TARGETS
from rtee.remote.goal_values import finite, numbers, share_of
from rtee.remote.link import Link
from rtee.units import TIME, quantity

if TYPE_CHECKING:
    from rtee.remote.goal import GoalClient
    from rtee.remote.monitoring import Monitoring

_NOTHING: Mapping[str, float] = {}


class Stream:
    """An open stream; made by `StreamClient.stream`.

    Args:
        link: The connection to the hand.
        monitoring: Returns the hand's status.
        number: Label under which the hand refuses its samples; see `Link.refusals`.

    Attributes:
        name: The stream's identifier.
        rate: Samples per second that will be sent [Hz].
        ended: Why the stream has ended, in words; empty while it is open.
    """

    def __init__(
        self, link: Link, monitoring: Monitoring, name: str, number: str, rate: float
    ) -> None:
        self.name, self.rate = name, rate
        self.ended = ""
        self._link, self._monitoring, self._number = link, monitoring, number
        self._refused: RemoteError | None = None

    async def send(
        self,
        targets: Mapping[str, float],
        velocity: Mapping[str, float] = _NOTHING,
        stamp: float | None = None,
    ) -> None:
        """Send a sample; returns at once.

        Does not wait for the hand's answer: the refusal of a sample is raised by a later call,
        which has sent its own by then.

        Args:
            targets: Positions by actuator or joint [rad | m], or intensities, 0 to 1, by action
                with its elements, such as ``PinchTight index thumb``. Actuators left out stay.
            velocity: Velocities at some of these targets [rad/s | m/s], for actions [1/s]; the
                others are estimated.
            stamp: Time of the sample, by a clock that never jumps [s]; now unless given.

        Raises:
            GoalRejected: if a value is not a finite number; nothing is sent.
            RequestRejected: if the hand has refused an earlier sample, or the stream has ended.
            LeaseHeld: if another client holds the lease by now.
            NoHand: if the hand has gone.
        """
        self.check_open()
        when = monotonic.now() if stamp is None else stamp
        finite(when, "stamp of a sample")
        wanted = numbers(targets, "target of a sample")
        given = numbers(velocity, "velocity of a sample")
        sample = StreamTargets(self.name, when, wanted, given, self._link.client)
        self._link.put(STREAM_TARGETS.encode(sample), self._number)
        self.check()
        # So that the hand's messages are received even by a caller that awaits nothing else.
        await anyio.lowlevel.checkpoint()

    async def pace(self) -> AsyncIterator[float]:
        """Iterate at the stream's rate, over the time since the first step [s].

        A late step is taken at once, and missed steps are skipped.

        Raises:
            RequestRejected: if the stream has ended.
        """
        for time, wait in paced(self.rate, monotonic.asked):
            await anyio.sleep(wait)
            self.check_open()
            yield time

    async def status(self) -> StreamStatus:
        """Return the status of the stream: lag, jitter, dropped samples."""
        return (await self._monitoring.status()).stream

    def refuse(self, error: RemoteError) -> None:
        """Let the next `send` raise an error."""
        self._refused = error

    def check_open(self) -> None:
        """Raise the error of a refused sample, or the reason for the end of the stream."""
        if self.ended:
            self.check()
            raise RequestRejected(self.ended)

    def check(self) -> None:
        """Raise the error of a refused sample, unless it was raised before."""
        refused, self._refused = self._refused, None
        if refused is not None:
            raise refused


def paced(rate: float, now: Callable[[], float]) -> Iterator[tuple[float, float]]:
    """Yield the times of steps at a rate [Hz], from 0, each with the time to wait for it [s]."""
    begin, step = now(), 0
    while True:
        yield step / rate, max(0.0, begin + step / rate - now())
        step = max(step + 1, math.floor((now() - begin) * rate))


class StreamClient:
    """Opens streams; the goals know the effort limits of the actuators."""

    def __init__(self, link: Link, monitoring: Monitoring, goals: GoalClient) -> None:
        self._link, self._monitoring, self._goals = link, monitoring, goals
        self._numbers = itertools.count(1)
        self._open: dict[str, Stream] = {}
        self._subscribed = False

    def _on_event(self, data: bytes) -> None:
        if self._open:
            event = EVENT.decode(data)
            if event.kind == STREAM_ENDED and event.source in self._open:
                self._open[event.source].ended = event.text

    @contextlib.asynccontextmanager
    async def stream(
        self,
        rate: float = 50.0,
        *,
        deadline: float | str | None = None,
        effort: Mapping[str, float] | float | str | None = None,
    ) -> AsyncIterator[Stream]:
        """Stream set-points for as long as the context lasts; this client holds the lease.

        Nothing moves before the first sample, which pre-empts a running goal. At the end, and when
        no sample comes within the deadline, the hand brakes smoothly and holds.

        Args:
            rate: Samples per second that will be sent [Hz].
            deadline: Longest time without a sample [s], or a string such as ``200ms``; as
                configured unless given.
            effort: Effort limit by actuator [N·m | N]; or one share of the limit of every actuator,
                above 0 up to 1, such as ``40%``. By default the hand's own limits.

        Raises:
            GoalRejected: if a value cannot be used.
            RequestRejected: if the hand refuses the stream, with its reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        link = self._link
        finite(rate, "rate of a stream")
        if (share := share_of(effort)) is not None:
            effort = await self._goals.effort_limits(share)
        limits = numbers(effort or {}, "effort limit")
        if not self._subscribed:
            # Once for all streams, since a link keeps its subscribers until it is closed.
            self._subscribed = True
            link.subscribe(topics.EVENTS, self._on_event)
        number = next(self._numbers)
        # A client's name may have 100 characters, as many as a stream's.
        name = f"{link.client[-80:].lstrip('.')}.{number}"
        fields = {
            "client": link.client,
            "stream": name,
            "rate": float(rate),
            "deadline": math.nan if deadline is None else quantity(deadline, TIME, "deadline"),
            "effort_name": tuple(limits),
            "effort": [*limits.values()],
        }
        stream = Stream(link, self._monitoring, name, f"s{number}", rate)
        self._open[name] = stream
        try:
            with link.refusals(f"s{number}", stream.refuse):
                begun = asyncio.ensure_future(link.ask("begin_stream", fields))
                try:
                    await asyncio.shield(begun)
                    yield stream
                finally:
                    # Even if cancelled before the answer arrived, since an open stream holds the
                    # lease; the answer comes first, since what has not begun cannot be ended.
                    # Shielded: a cancelled client must end its stream before its deadline.
                    with anyio.CancelScope(shield=True), contextlib.suppress(RemoteError):
                        # The answer may be lost although the stream is open.
                        with contextlib.suppress(NoHand):
                            await begun
                        if not (stream.ended or link.gone):
                            await link.ask("end_stream", {"client": link.client, "stream": name})
            stream.check()  # a refusal of the last samples
        finally:
            stream.ended = stream.ended or "this stream was closed; open another one"
            del self._open[name]
