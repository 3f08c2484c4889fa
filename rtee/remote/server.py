"""The server beside a hand's loop: it makes the hand available on the network.

The way of a goal and its answer: Zenoh's thread calls `Server._on_put`; `handle_request` checks the
message and calls `CommandHandlers.handle_put`, which appends the goal to what the loop does at its
next tick and returns the encoded answer. `Server._answer_put` gives the answer to a `CallQueue`,
whose thread publishes it, since that may have to wait for a slow client. Queries are handled
likewise.
"""

from __future__ import annotations

import contextlib
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
from rtee.remote.call_queue import CallQueue
from rtee.remote.command_handlers import CommandHandlers
from rtee.remote.directory import claimed
from rtee.remote.incoming_request import handle_request, number_and_client, refusal, reply
from rtee.remote.lease import Lease
from rtee.remote.loop_thread import LoopThread
from rtee.remote.publishing import Publisher, Streams
from rtee.remote.query_handlers import QueryHandlers, Recording
from rtee.remote.session import EXPRESS, direct, disable_linger, open_server


class RemoteSettings(Protocol):
    """Network settings of a hand."""

    @property
    def listen(self) -> Sequence[str]:
        """Zenoh endpoints to listen on, besides the socket on this computer."""

    @property
    def connect(self) -> Sequence[str]:
        """Zenoh endpoints to connect to."""

    @property
    def state_rate(self) -> float:
        """Rate of the topics for all clients [Hz]."""


class Server:
    """Receives the requests of clients; made by `open`.

    Its methods are called in Zenoh's threads. Commands are handled there at once. Only queries wait
    for a thread of their own, since they may take milliseconds.

    Args:
        hand: The hand's name.
        endpoint: Address of the hand on this computer.
        session: The Zenoh session.
        commands: Handles what moves or stops the hand.
        queries: Handles what asks for information or changes the actions.

    Attributes:
        endpoint: Address of the hand on this computer.
        outbox: Publishes what must not be lost, in order.
        stops: Answers stops, which must not wait for a client that is slow to read.
        questions: Handles and answers queries.
    """

    def __init__(
        self,
        hand: str,
        endpoint: str,
        session: zenoh.Session,
        commands: CommandHandlers,
        queries: QueryHandlers,
    ) -> None:
        self.endpoint = endpoint
        self.outbox = CallQueue(f"publish {hand}")
        self.stops = CallQueue(f"stop {hand}")
        self.questions = CallQueue(f"answer {hand}")
        self._hand, self._session = hand, session
        self._commands, self._queries = commands, queries

    @classmethod
    @contextlib.asynccontextmanager
    async def open(
        cls,
        loop: HandLoop,
        settings: RemoteSettings,
        recording: Recording | None = None,
        profile: str = "",
    ) -> AsyncIterator[Self]:
        """Make a hand available on the network for as long as the context lasts.

        Args:
            loop: The hand's loop, which runs in the event loop of this task.
            settings: The hand's network settings.
            recording: Its recorder, if it has one.
            profile: The profile of its references, in words.

        Raises:
            ConfigError: if the hand runs already, or an endpoint cannot be used.
        """
        in_thread = anyio.to_thread.run_sync
        hand = loop.hand
        async with contextlib.AsyncExitStack() as stack:
            place = stack.enter_context(claimed(hand.name))
            session, endpoint = await in_thread(
                open_server, place.socket, list(settings.listen), list(settings.connect)
            )
            stack.push_async_callback(in_thread, session.close)
            streams = Streams(session, hand, loop.settings.rate, settings.state_rate)
            stack.push_async_callback(in_thread, streams.close)
            lease, thread = Lease(), LoopThread()
            commands = CommandHandlers(loop, lease, thread)
            queries = QueryHandlers(loop, lease, thread, streams, recording, profile)
            server = cls(hand.name, endpoint, session, commands, queries)
            stack.push_async_callback(in_thread, server.close)
            stack.push_async_callback(thread.close)
            publisher = Publisher(session, hand.name, streams, server.outbox, lease)
            loop.add_observer(publisher)
            stack.callback(loop.remove_observer, publisher)
            server.declare()
            # Last: waiting clients send requests as soon as the hand is announced.
            place.write([endpoint])
            stack.callback(place.withdraw)
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
        """Send the waiting answers; blocks for a moment."""
        self._queries.close()
        for queue in (self.questions, self.stops, self.outbox):
            queue.close()

    def _on_stop(self, query: zenoh.Query) -> None:
        handle_request(query, STOP, self._commands.stop, self._replier(query, self.stops))

    def _on_control(self, query: zenoh.Query) -> None:
        handle_request(query, CONTROL, self._commands.handle, self._replier(query, self.outbox))

    def _replier(self, query: zenoh.Query, queue: CallQueue) -> Callable[[bytes, bool], object]:
        """Return a function that has a query answered by a queue."""
        return lambda data, ok: queue.put(partial(reply, self._hand, query, data, ok))

    def _on_put(self, sample: zenoh.Sample) -> None:
        answer = partial(self._answer_put, sample)
        handle_request(sample, CONTROL, self._commands.handle_put, answer)

    def _answer_put(self, sample: zenoh.Sample, data: bytes, ok: bool) -> None:
        # The attachment is decoded only now, so that it does not delay the request itself.
        number, client = number_and_client(sample)
        if self._commands.knows(client):
            key = network_key(self._hand, f"{ANSWERS}/{client}")
            attachment = f"{'+' if ok else '-'}{number}"
            self.outbox.put(partial(self._session.put, key, data, attachment=attachment, **EXPRESS))

    def _on_question(self, query: zenoh.Query) -> None:
        send = partial(reply, self._hand, query)
        if not self.questions.put(partial(handle_request, query, ASK, self._queries.handle, send)):
            error = RequestRejected("too many requests are waiting")
            self._replier(query, self.outbox)(refusal(error), False)

    def _on_client(self, sample: zenoh.Sample) -> None:
        client = str(sample.key_expr).rpartition("/")[2]
        if sample.kind == zenoh.SampleKind.PUT:
            disable_linger()
            self._commands.client_came(client)
        else:
            self._commands.client_left(client)
