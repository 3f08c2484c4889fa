"""The server beside a hand's loop: takes requests from the network, publishes what happens."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import logging
import sys
import time
from collections.abc import Callable, Coroutine, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

import anyio
import anyio.abc
import anyio.to_thread
import zenoh

from rtee.errors import RequestRejected, RteeError
from rtee.hand.model import Hand
from rtee.loop.observer import Observer, TickRecord
from rtee.messages import (
    encode_device_status,
    encode_event,
    encode_feedback,
    encode_goal,
    encode_loop_statistics,
    encode_result,
    network_key,
    topics,
)
from rtee.messages.requests import ALIVE, ASK, CLIENTS, CONTROL, STOP
from rtee.remote.asked import Asked, Reply, numbered, read, refusal
from rtee.remote.asking import Asking
from rtee.remote.control import Control
from rtee.remote.directory import announced
from rtee.remote.publishing import Outbox, Streams, answer
from rtee.remote.session import direct, let_go_at_once, open_server
from rtee.remote.worker import Worker
from rtee.types import DeviceStatus, Event, Feedback, Goal, LoopStatistics, Result

if TYPE_CHECKING:
    from rtee.loop.handloop import HandLoop

log = logging.getLogger(__name__)

T = TypeVar("T")
Status = tuple[list[DeviceStatus], LoopStatistics, str, Goal | None]

_ANSWER_WITHIN = 2.0

_SWITCH_INTERVAL = 1e-4
"""Python's threads hand over to the loop's within this [s]; by default it would be 5 ms."""


class RemoteSettings(Protocol):
    """Where a hand is on the network."""

    @property
    def listen(self) -> Sequence[str]:
        """Zenoh endpoints to listen on, besides loopback."""

    @property
    def connect(self) -> Sequence[str]:
        """Zenoh endpoints to connect to."""

    @property
    def state_rate(self) -> float:
        """Rate of the topics that everybody gets [Hz]."""


class Recording(Protocol):
    """What the server needs of a recorder; every method returns at once, in any thread."""

    def start(self) -> None:
        """Begin a new recording."""

    def stop(self) -> None:
        """End the recording."""

    def mark(self, text: str) -> None:
        """Put a mark into the recording."""


class Configured(Protocol):
    """What the server needs of a hand's configuration."""

    @property
    def remote(self) -> RemoteSettings:
        """Where the hand is on the network."""


class Server(Observer):
    """A hand on the network, for as long as the context lasts.

    Args:
        loop: The hand's loop, which runs in the event loop of this task.
        hand: The hand.
        config: Its configuration.

    Attributes:
        loop: The hand's loop.
        hand: The hand.
        latest: What was known at the last tick.
        endpoint: Where the hand can be reached from this computer.
        recording: Returns the path of the recording under way, or an empty string.
        recording_trouble: Returns what it has lost and why, in words, or an empty string.
        recorder: Starts, stops and marks recordings, if there is one.
        profile: How the references move, in words.
    """

    def __init__(self, loop: HandLoop, hand: Hand, config: Configured) -> None:
        self.loop = loop
        self.hand = hand
        self.recording: Callable[[], str] = lambda: ""
        self.recording_trouble: Callable[[], str] = lambda: ""
        self.recorder: Recording | None = None
        self.profile = str(loop.settings.profile.kind)
        self.latest: TickRecord | None = None
        self.endpoint = ""
        self._settings = config.remote
        self._goal: Goal | None = None
        self._exit = contextlib.AsyncExitStack()
        self.now = time.monotonic

    async def __aenter__(self) -> Self:
        """Open the hand to the network.

        Raises:
            ConfigError: if the hand runs already, or an endpoint cannot be used.
        """
        self._event_loop = asyncio.get_running_loop()
        interval = sys.getswitchinterval()
        sys.setswitchinterval(min(interval, _SWITCH_INTERVAL))
        async with contextlib.AsyncExitStack() as stack:
            stack.callback(sys.setswitchinterval, interval)
            open_session = partial(
                open_server, list(self._settings.listen), list(self._settings.connect)
            )
            session, self.endpoint = await anyio.to_thread.run_sync(open_session)
            stack.push_async_callback(anyio.to_thread.run_sync, session.close)
            rate = self.loop.settings.rate
            self.streams = Streams(session, self.hand, rate, self._settings.state_rate)
            stack.push_async_callback(anyio.to_thread.run_sync, self.streams.close)
            self._outbox = Outbox(session, self.hand.name)
            stack.push_async_callback(anyio.to_thread.run_sync, self._outbox.close)
            self._control = Control(self)
            self._asking = Asking(self)
            self._worker: Worker[zenoh.Query] = Worker(f"answer {self.hand.name}", self._ask)
            stack.push_async_callback(anyio.to_thread.run_sync, self._worker.close)
            self.loop.add_observer(self)
            stack.callback(self.loop.remove_observer, self)
            self._declare(session)
            # Last: who waits for the hand asks as soon as it is announced.
            stack.enter_context(announced(self.hand.name, [self.endpoint]))
            self._tasks = await stack.enter_async_context(anyio.create_task_group())
            stack.callback(self._tasks.cancel_scope.cancel)
            self._exit = stack.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Leave the network."""
        await self._exit.aclose()

    def _declare(self, session: zenoh.Session) -> None:
        hand = self.hand.name
        # Control and stop wait for nothing: they are checked in Zenoh's own thread.
        takes: dict[str, Callable[[zenoh.Query], None]] = {
            STOP: partial(self._asked, STOP, self._stop),
            CONTROL: partial(self._asked, CONTROL, self._control.take),
            ASK: self._pass_on,
        }
        session.declare_subscriber(network_key(hand, f"{CONTROL}/*"), direct(self._put_here))
        for group, take in takes.items():
            session.declare_queryable(network_key(hand, f"{group}/*"), direct(take))
        clients = network_key(hand, f"{CLIENTS}/*")
        session.liveliness().declare_subscriber(clients, direct(self._client), history=True)
        self._token = session.liveliness().declare_token(network_key(hand, ALIVE))

    @property
    def dropped(self) -> int:
        """Messages that could not be published in time."""
        return self._outbox.dropped

    # --- from Zenoh's threads to the loop's

    def call_soon(self, function: Callable[..., object], *arguments: object) -> None:
        """Have a function called in the loop's thread; does nothing when that has ended."""
        with contextlib.suppress(RuntimeError):
            self._event_loop.call_soon_threadsafe(function, *arguments)

    def in_loop(self, function: Callable[[], T]) -> T:
        """Call a function in the loop's thread and return what it returns.

        Raises:
            RteeError: if the loop doesn't answer.
        """
        answer: concurrent.futures.Future[T] = concurrent.futures.Future()

        def call() -> None:
            try:
                answer.set_result(function())
            except Exception as error:
                answer.set_exception(error)

        self.call_soon(call)
        try:
            return answer.result(_ANSWER_WITHIN)
        except concurrent.futures.TimeoutError:
            raise RteeError("the loop does not answer") from None

    def start(self, function: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run something in the background; called in the loop's thread."""
        self._tasks.start_soon(function)

    def _asked(self, group: str, take: Callable[[Asked], None], query: zenoh.Query) -> None:
        reply = self._outbox.answer_first if group == STOP else self._outbox.answer
        self._receive(query, group, take, partial(reply, query))

    def _put_here(self, sample: zenoh.Sample) -> None:
        """Take what was put instead of asked; to whom the answer goes is looked at afterwards."""
        self._receive(sample, CONTROL, self._control.take, partial(self._answer_put, sample))

    def _answer_put(self, sample: zenoh.Sample, data: bytes, ok: bool) -> None:
        number, client = numbered(sample)
        if self._control.knows(client):
            self._outbox.answer_put(client, number, data, ok)

    def _pass_on(self, query: zenoh.Query) -> None:
        if not self._worker.put(query):
            error = RequestRejected("too many requests are waiting")
            self._outbox.answer(query, refusal(error), False)

    def _ask(self, query: zenoh.Query) -> None:
        self._receive(query, ASK, self._asking.take, partial(answer, self.hand.name, query))

    def _receive(
        self,
        asked: zenoh.Query | zenoh.Sample,
        group: str,
        take: Callable[[Asked], None],
        reply: Reply,
    ) -> None:
        try:
            take(Asked(*read(asked, group), reply))
        except Exception as error:
            reply(refusal(error), False)

    def _client(self, sample: zenoh.Sample) -> None:
        client = str(sample.key_expr).rpartition("/")[2]
        if sample.kind == zenoh.SampleKind.PUT:
            let_go_at_once()
            self._control.came(client)
        else:
            self._control.gone(client)

    def _stop(self, asked: Asked) -> None:
        self.call_soon(self._start_stop, asked, asked.fields["client"] or "a client")

    def _start_stop(self, asked: Asked, client: str) -> None:
        async def stop() -> None:
            confirmed = await self.loop.stop(f"stopped by {client}")
            names = [name for name, _ in confirmed]
            asked.answer({"device": names, "confirmed": [done for _, done in confirmed]})

        self.start(stop)

    def status(self) -> Status:
        """Return devices, statistics, who holds the hand and its goal; in the loop's thread."""
        loop = self.loop
        return loop.statuses(), loop.statistics(), self._control.lease.holder, self._goal

    # --- from the loop to the network

    def on_tick(self, record: TickRecord) -> None:
        """Have the states published that are due."""
        self.latest = record
        self.streams.publish(record)

    def on_goal(self, goal: Goal, stamp: float) -> None:
        """Publish that a goal begins."""
        self._goal = goal
        self._outbox.put(topics.GOALS, lambda wall: encode_goal(goal, time=stamp, wall=wall))

    def on_feedback(self, feedback: Feedback) -> None:
        """Publish a goal's progress."""
        self._put(topics.FEEDBACK, encode_feedback, feedback)

    def on_result(self, result: Result) -> None:
        """Publish how a goal ended."""
        self._control.lease.ended(result.goal_id)
        if self._goal is not None and self._goal.goal_id == result.goal_id:
            self._goal = None
        stamp = self.now()
        self._outbox.put(topics.RESULTS, lambda wall: encode_result(result, time=stamp, wall=wall))

    def on_event(self, event: Event) -> None:
        """Publish an event."""
        self._put(topics.EVENTS, encode_event, event)

    def on_status(self, statuses: Sequence[DeviceStatus], statistics: LoopStatistics) -> None:
        """Publish how devices and clock are doing."""
        for status in statuses:
            self._put(topics.DEVICE_STATUS, encode_device_status, status)
        self._put(topics.LOOP_STATISTICS, encode_loop_statistics, statistics)

    def _put(self, topic: str, encode: Callable[..., bytes], what: Any) -> None:
        self._outbox.put(topic, lambda wall: encode(what, wall=wall))
