"""The server beside a hand's loop: the hand on the network.

A request takes this way: Zenoh's thread calls one of `Server`'s methods, which checks it and hands
it to `Control` or `Asking`. What those answer is encoded there and put on the network by a
`Worker`, since that may have to wait for a slow client.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from functools import partial
from typing import Protocol, Self

import anyio
import anyio.to_thread
import zenoh

from rtee.errors import RequestRejected
from rtee.loop.handloop import HandLoop
from rtee.messages import network_key
from rtee.messages.requests import ALIVE, ANSWERS, ASK, CLIENTS, CONTROL, STOP
from rtee.remote.command_handlers import Control
from rtee.remote.directory import announced
from rtee.remote.incoming_request import numbered, receive, refusal, reply
from rtee.remote.lease import Lease
from rtee.remote.loop_thread import LoopThread
from rtee.remote.publishing import Publisher, Streams
from rtee.remote.query_handlers import Asking, Recording
from rtee.remote.session import EXPRESS, direct, let_go_at_once, open_server
from rtee.remote.worker import Worker

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


class Server:
    """Receives what clients ask of a hand; made by `open`.

    Its methods are called in Zenoh's threads. Only questions wait for a thread of their own: they
    may take milliseconds. What steers the hand is done at once.

    Args:
        hand: The hand's name.
        endpoint: Where the hand can be reached from this computer.
        session: The network.
        control: Does what steers the hand.
        asking: Answers questions.

    Attributes:
        endpoint: Where the hand can be reached from this computer.
        outbox: Puts on the network what must arrive, in order.
        stops: Answers stops, which wait for no client that is slow to take something else.
        questions: Answers questions.
    """

    def __init__(
        self, hand: str, endpoint: str, session: zenoh.Session, control: Control, asking: Asking
    ) -> None:
        self.endpoint = endpoint
        self.outbox = Worker(f"publish {hand}")
        self.stops = Worker(f"stop {hand}")
        self.questions = Worker(f"answer {hand}")
        self._hand, self._session = hand, session
        self._control, self._asking = control, asking

    @classmethod
    @contextlib.asynccontextmanager
    async def open(
        cls,
        loop: HandLoop,
        settings: RemoteSettings,
        recording: Recording | None = None,
        profile: str = "",
    ) -> AsyncIterator[Self]:
        """Have a hand on the network for as long as the context lasts.

        Args:
            loop: The hand's loop, which runs in the event loop of this task.
            settings: Where the hand is on the network.
            recording: Its recorder, if it has one.
            profile: How the references move, in words.

        Raises:
            ConfigError: if the hand runs already, or an endpoint cannot be used.
        """
        in_thread = anyio.to_thread.run_sync
        hand = loop.hand
        async with contextlib.AsyncExitStack() as stack:
            stack.callback(sys.setswitchinterval, interval := sys.getswitchinterval())
            sys.setswitchinterval(min(interval, _SWITCH_INTERVAL))
            session, endpoint = await in_thread(
                open_server, list(settings.listen), list(settings.connect)
            )
            stack.push_async_callback(in_thread, session.close)
            streams = Streams(session, hand, loop.settings.rate, settings.state_rate)
            stack.push_async_callback(in_thread, streams.close)
            lease, thread = Lease(), LoopThread()
            control = Control(loop, lease, thread)
            asking = Asking(loop, lease, thread, streams, recording, profile)
            server = cls(hand.name, endpoint, session, control, asking)
            stack.push_async_callback(in_thread, server.close)
            stack.push_async_callback(thread.close)
            publisher = Publisher(session, hand.name, streams, server.outbox, lease)
            loop.add_observer(publisher)
            stack.callback(loop.remove_observer, publisher)
            server.declare()
            # Last: who waits for the hand asks as soon as it is announced.
            stack.enter_context(announced(hand.name, [endpoint]))
            yield server

    def declare(self) -> None:
        """Begin to receive requests."""

        def key(*parts: str) -> str:
            return network_key(self._hand, "/".join(parts))

        session, liveliness = self._session, self._session.liveliness()
        session.declare_subscriber(key(CONTROL, "*"), direct(self._on_put))
        queries: dict[str, Callable[[zenoh.Query], None]] = {
            STOP: self._on_stop,
            CONTROL: self._on_control,
            ASK: self._on_question,
        }
        for group, handle in queries.items():
            session.declare_queryable(key(group, "*"), direct(handle))
        liveliness.declare_subscriber(key(CLIENTS, "*"), direct(self._on_client), history=True)
        self._token = liveliness.declare_token(key(ALIVE))

    def close(self) -> None:
        """Send the answers that are waiting; blocks for a moment."""
        self._asking.close()
        for worker in (self.questions, self.stops, self.outbox):
            worker.close()

    def _reply_by(self, worker: Worker, query: zenoh.Query, data: bytes, ok: bool) -> None:
        worker.put(partial(reply, self._hand, query, data, ok))

    def _on_stop(self, query: zenoh.Query) -> None:
        receive(query, STOP, self._control.stop, partial(self._reply_by, self.stops, query))

    def _on_control(self, query: zenoh.Query) -> None:
        receive(query, CONTROL, self._control.handle, partial(self._reply_by, self.outbox, query))

    def _on_put(self, sample: zenoh.Sample) -> None:
        receive(sample, CONTROL, self._control.handle, partial(self._answer_put, sample))

    def _answer_put(self, sample: zenoh.Sample, data: bytes, ok: bool) -> None:
        # Done after what was asked for: only then does it matter to whom the answer goes.
        number, client = numbered(sample)
        if self._control.knows(client):
            key = network_key(self._hand, f"{ANSWERS}/{client}")
            attachment = f"{'+' if ok else '-'}{number}"
            self.outbox.put(partial(self._session.put, key, data, attachment=attachment, **EXPRESS))

    def _on_question(self, query: zenoh.Query) -> None:
        send = partial(reply, self._hand, query)
        if not self.questions.put(partial(receive, query, ASK, self._asking.handle, send)):
            error = RequestRejected("too many requests are waiting")
            self._reply_by(self.outbox, query, refusal(error), False)

    def _on_client(self, sample: zenoh.Sample) -> None:
        client = str(sample.key_expr).rpartition("/")[2]
        if sample.kind == zenoh.SampleKind.PUT:
            let_go_at_once()
            self._control.came(client)
        else:
            self._control.gone(client)
