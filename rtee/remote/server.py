"""The server in the process of a hand's loop, which makes the hand available on the network.

The path of a goal and its answer: Zenoh's thread calls `Server._on_control`; `handle_request`
checks the query and calls `CommandHandlers.handle`, which queues the goal for the loop's next tick
and returns the encoded answer. The thread of a `CallQueue` sends it, since that may have to wait
for a slow client. Samples of streams are published, and handled likewise.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self, TypeVar

import anyio
import anyio.to_thread
import zenoh

from rtee import monotonic
from rtee.errors import ConfigError, NoHand, RequestRejected, TooManyRequests
from rtee.hand.config_schema import RemoteSettings
from rtee.loop.handloop import HandLoop
from rtee.loop.report import Tally
from rtee.messages import network_key
from rtee.messages.identity import claim_of
from rtee.messages.requests import (
    ALIVE,
    ANSWERS,
    ASK,
    CLAIMS,
    CLIENTS,
    CONTROL,
    HELLO,
    STOP,
    Request,
    inbox_key,
    topic_for,
)
from rtee.remote.agents import Agents
from rtee.remote.call_queue import CallQueue, DelayQueue, LoopThread
from rtee.remote.command_handlers import CommandHandlers
from rtee.remote.connections import Connections
from rtee.remote.counts import counting
from rtee.remote.directory import HandLock, claimed
from rtee.remote.door import Door
from rtee.remote.goal_records import GoalRecords
from rtee.remote.identities import Identities
from rtee.remote.incoming_request import (
    IncomingRequest,
    Later,
    Send,
    answer_to,
    attachment_of,
    handle_request,
    last_part,
    refuse,
    reply,
)
from rtee.remote.lease import Lease
from rtee.remote.protection import Protection
from rtee.remote.publishing import HandPublisher, Streams, TopicPublishers
from rtee.remote.query_handlers import QueryHandlers, RecorderControl
from rtee.remote.rates import EXCESS, Rates
from rtee.remote.session import (
    DELIVER,
    LEASE,
    TLS,
    close_session,
    direct,
    fits,
    open_client,
    open_server,
)
from rtee.remote.stopping import CERTIFICATE, SUFFIX, Stopped, StopSocket

_CLOSED_FOR = 1.0
"""Time for which the inbox of a client that publishes too much is closed [s]. Meanwhile its
allowance grows again, and the burst that follows delays some ticks; so this time doubles if the
client does not stop."""

_LONGEST_CLOSED = 16.0
"""Longest such time [s]: a client that goes on flooding gets one burst through in this time, and
one that has stopped is heard again after it at the latest."""

_LOOK_EVERY = 0.5
"""Interval of the checks whether to open an inbox again [s]: half of the shortest time closed."""

_MOST_CLOSED = 1000
"""Inboxes that may be closed at a time: more than there are clients."""

_ROUTER_WITHIN = 1.0
"""Time for a router that accepts connections to answer, before the hand starts without it [s]: over
a VPN up to 1 s."""

_GONE_WITHIN = 3 * LEASE / 1000
"""Time until a hand of the same name must be gone [s]: a killed one counts as dead after the lease,
and this one may be what replaces it."""

_POLL = 0.05
"""Interval of the looks for a hand of the same name [s]."""


class _Inbox:
    """The inbox of a present client.

    Attributes:
        rates: Limits the messages that are not accepted.
        closed: Whether the inbox is closed for a while.
        closed_for: Duration of the last closure [s].
        until: End of the last closure [s].
        subscriber: Receives the messages; ``None`` while the inbox is closed.
    """

    __slots__ = ("closed", "closed_for", "key", "rates", "subscriber", "until")

    def __init__(self, key: str) -> None:
        self.key = key
        self.rates = Rates()
        self.closed = False
        self.closed_for, self.until = 0.0, -math.inf
        self.subscriber: zenoh.Subscriber[None] | None = None

    def close(self) -> None:
        """Close the inbox for a while: twice as long as before if that was not long ago."""
        now = monotonic.now()
        again = now - self.until < 2.0 * self.closed_for
        self.closed_for = min(2.0 * self.closed_for, _LONGEST_CLOSED) if again else _CLOSED_FOR
        self.until, self.closed = now + self.closed_for, True


class Inboxes:
    """Receives the publications of a hand's clients. Any thread may call its methods.

    ``receive`` is called with each message, in Zenoh's thread; ``calls`` makes the calls that
    declare and undeclare subscribers, one after the other.
    """

    def __init__(
        self,
        session: zenoh.Session,
        hand: str,
        receive: Callable[[zenoh.Sample], object],
        calls: CallQueue,
    ) -> None:
        self._session, self._hand, self._receive, self._calls = session, hand, receive, calls
        self._lock = threading.Lock()
        self._inboxes: dict[str, _Inbox] = {}
        self._closed = DelayQueue(f"listen {hand}", _LOOK_EVERY, _MOST_CLOSED)

    def open(self, client: str, access_path: str) -> None:
        """Begin to listen to a client; ``access_path``: its access path, see `HELLO`."""
        inbox = _Inbox(inbox_key(self._hand, access_path, client))
        with self._lock:
            self._inboxes[client] = inbox
        self._call(partial(self._listen, client, inbox))

    def remove(self, client: str) -> None:
        """Stop listening to a client."""
        with self._lock:
            inbox = self._inboxes.pop(client, None)
        if inbox is not None:
            self._call(partial(self._ignore, inbox))

    def count_excess(self, client: str) -> None:
        """Count a message that was not accepted; close the client's inbox after too many."""
        with self._lock:
            inbox = self._inboxes.get(client)
            if inbox is None or inbox.closed or inbox.rates.allow(EXCESS):
                return
            # Without room for the call, the inbox stays open, and the next message tries again.
            if self._calls.put(partial(self._ignore, inbox)):
                inbox.close()
                self._closed.put(partial(self._reopen, client, inbox))

    def close(self) -> None:
        """Keep closed inboxes closed for good; blocks for a moment."""
        with self._lock:
            self._inboxes.clear()
        self._closed.close()

    # --- in the threads of the queues

    def _call(self, call: Callable[[], object]) -> None:
        """Queue a call; without room, try again later."""
        if not self._calls.put(call):
            self._closed.put(partial(self._call, call))

    def _reopen(self, client: str, inbox: _Inbox) -> None:
        with self._lock:
            # The client has left since, or has come back with a new inbox.
            if self._inboxes.get(client) is not inbox:
                return
            if monotonic.now() < inbox.until:
                self._closed.put(partial(self._reopen, client, inbox))
                return
            inbox.closed = False
        self._call(partial(self._listen, client, inbox))

    def _listen(self, client: str, inbox: _Inbox) -> None:
        # The client may have left while this call waited; its subscriber would stay forever.
        if self._inboxes.get(client) is inbox and inbox.subscriber is None:
            inbox.subscriber = self._session.declare_subscriber(inbox.key, direct(self._receive))

    def _ignore(self, inbox: _Inbox) -> None:
        # Without the lock: only the thread of `calls` sets the subscriber.
        if inbox.subscriber is not None:
            inbox.subscriber.undeclare()  # type: ignore[no-untyped-call]
            inbox.subscriber = None


T = TypeVar("T")

_REFUSED_AFTER = 0.25
"""Delay of refusals to clients that send too many requests [s]: it slows down a script that waits
for each answer before its next request, and a person hardly notices it."""

_MOST_REFUSED = 128
"""Most refused queries that wait; each may keep the 64 KiB that were received with it."""

_MOST_QUESTIONS = 128
"""Most requests for information that wait, of all clients: each may keep 64 KiB, too."""

_LARGEST_REFUSED = 4096
"""Longest question of a refused query that waits [bytes]: frequent ones have a few hundred."""


def _claim_name(hand: str, session: zenoh.Session) -> tuple[str, zenoh.LivelinessToken]:
    """Claim a hand's name; return the claim's name, and the claim, to be kept for as long."""
    own = str(session.info.zid())
    return own, session.liveliness().declare_token(network_key(hand, f"{CLAIMS}/{own}"))


def _check_name(hand: str, own: str, endpoint: str, certificates: Mapping[str, Any]) -> None:
    """Wait until no other hand of a name is at a router; blocks for a moment.

    Two hands of a name would both receive what clients send to either, and clients would get the
    answers of both. A router that does not answer may come up later.

    Args:
        hand: The name.
        own: The hand's own claim. It was made before: of two hands that start at the same moment,
            the one that looks later sees the other's, and one stays.
        endpoint: The router's.
        certificates: Zenoh's settings for a link to it.

    Raises:
        ConfigError: if another hand of this name stays.
    """
    try:
        # A session of its own, since a router passes nothing on from one hand to another.
        session = open_client([endpoint], _ROUTER_WITHIN, certificates)
    except NoHand:
        return

    def found(key: str) -> set[str]:
        tokens = session.liveliness().get(network_key(hand, key), timeout=_ROUTER_WITHIN)
        return {str(each.ok.key_expr).rpartition("/")[2] for each in tokens if each.ok}

    begun = monotonic.now()
    try:
        with contextlib.suppress(zenoh.ZError):  # if the router ends meanwhile
            while True:
                claims = found(f"{CLAIMS}/*")
                others = claims - {own}
                passed = monotonic.now() - begun
                if not others and (own in claims or passed > _GONE_WITHIN):
                    return
                # Of those that start now, the others give up first.
                first = own < min(others, default="") and not found(ALIVE)
                if others and passed > (2 if first else 1) * _GONE_WITHIN:
                    raise ConfigError(
                        f"a hand '{hand}' is already running at {endpoint}; give this one "
                        "another name: that of its folder, and name: in its hand.yaml"
                    )
                monotonic.sleep(_POLL)
    finally:
        close_session(session)


class Server:
    """Receives the requests of clients; made by `open`.

    Its methods are called in Zenoh's threads. All requests are checked there, and commands handled
    at once. Only requests for information are handled in another thread, since they may take
    milliseconds; refused ones do not wake it.

    Attributes:
        endpoint: Address of the hand on this computer.
        outbox: Publishes messages that must not be lost, in order.
        inboxes: Receive the publications of clients.
        stops: Answers stops, which must not wait for a client that is slow to read.
        questions: Handles and answers requests for information.
        refused: Refuses requests of clients that send too many, after a delay.
    """

    def __init__(
        self,
        hand: str,
        endpoint: str,
        session: zenoh.Session,
        identities: Identities,
        commands: CommandHandlers,
        queries: QueryHandlers,
    ) -> None:
        self.endpoint = endpoint
        self.outbox = CallQueue(f"publish {hand}")
        self.stops = CallQueue(f"stop {hand}")
        self.questions = CallQueue(f"answer {hand}", _MOST_QUESTIONS)
        self.refused = DelayQueue(f"refuse {hand}", _REFUSED_AFTER, _MOST_REFUSED)
        self.inboxes = Inboxes(session, hand, self._on_sample, self.outbox)
        self._hand, self._session = hand, session
        self._identities, self._commands, self._queries = identities, commands, queries
        identities.present = self.inboxes.open

    @classmethod
    @contextlib.asynccontextmanager
    async def open(
        cls,
        loop: HandLoop,
        settings: RemoteSettings,
        recording: RecorderControl | None = None,
        profile: str = "",
        place: HandLock | None = None,
    ) -> AsyncIterator[Self]:
        """Make a hand available on the network for as long as the context lasts.

        Its loop runs in this task's event loop. ``profile`` describes the profile of its references
        in words; ``place`` is the hand's lock if it is `claimed` already. Raises `ConfigError` if
        the hand runs already, or an endpoint cannot be used.
        """

        # These calls block for milliseconds, and this event loop drives the hand.
        async def in_thread(function: Callable[..., T], *arguments: object) -> T:
            # Shielded: otherwise the session could outlive the hand, and answer for it.
            with anyio.CancelScope(shield=True):
                result = await anyio.to_thread.run_sync(function, *arguments)
            return result  # noqa: RET504 - in the scope, mypy would miss a return behind it

        hand = loop.hand
        # Everything is closed in reverse order: first the announcement goes, last the session.
        async with contextlib.AsyncExitStack() as stack:
            place = place or stack.enter_context(claimed(hand.name))
            protection = await in_thread(Protection, hand.name, settings)
            socket = place.socket
            if not fits(socket):  # too long a path: use a new folder that only this user may read
                folder = await in_thread(partial(TemporaryDirectory, prefix="rtee-"))
                stack.push_async_callback(in_thread, folder.cleanup)
                socket = Path(folder.name) / "hand.sock"
            outside = [each for each in settings.listen if each.startswith(TLS)]
            others = [each for each in settings.listen if each not in outside]
            session, endpoint = await in_thread(
                open_server, socket, others, settings.connect, protection.settings
            )
            stack.push_async_callback(in_thread, partial(close_session, session))
            # Before it receives anything. The claim lasts as long as the session.
            own, _claim = await in_thread(_claim_name, hand.name, session)
            # At all routers at once: each silent one takes seconds.
            await asyncio.gather(
                *(
                    in_thread(_check_name, hand.name, own, at, protection.link)
                    for at in settings.connect
                )
            )
            connections = Connections(session, str(socket))
            stack.push_async_callback(in_thread, connections.close)
            publishers = TopicPublishers(session, hand.name, protection.people)
            streams = Streams(publishers, hand, loop.settings.rate, settings.state_rate)
            stack.push_async_callback(in_thread, streams.close)
            lease, thread = Lease(), LoopThread()
            agents = await in_thread(Agents, place.path)
            commands = CommandHandlers(loop, lease, thread, agents)
            goals = GoalRecords(lease)
            identities = Identities(protection.admit)
            tally = Tally()
            queries = QueryHandlers(
                loop,
                lease,
                agents,
                goals,
                thread,
                streams,
                recording,
                profile,
                counting(loop, identities, tally),
            )
            server = cls(hand.name, endpoint, session, identities, commands, queries)
            stack.push_async_callback(in_thread, server.close)
            stack.push_async_callback(thread.close)
            publisher = HandPublisher(publishers, streams, server.outbox, lease, goals)
            for observer in (publisher, tally):
                loop.add_observer(observer)
                stack.callback(loop.remove_observer, observer)
            server.declare()

            door: Door | None = None
            if outside:
                zid = str(session.info.zid())
                door = await in_thread(
                    Door,
                    hand.name,
                    endpoint,
                    zid,
                    outside,
                    protection.certificates,
                    protection.rules(zid),
                    protection.people,
                )
                stack.push_async_callback(in_thread, door.close)

            def admit(people: Collection[str], revoked: Collection[str]) -> None:
                publishers.admit(people)
                if door is not None:
                    door.admit(people)
                # A client whose certificate was revoked must not keep the lease.
                for client in identities.of(revoked):
                    commands.client_left(client)

            stack.enter_context(protection.watched(admit))

            def stop(client: str, answer: Stopped) -> None:
                # The door knows its clients by their certificates' common names only.
                access_path = client.partition(" ")[0].removeprefix(CERTIFICATE)
                admitted = protection.admit(access_path) if client.startswith(CERTIFICATE) else None
                who = client if admitted is None else admitted.prefix.removesuffix(".")
                commands.stop(who, answer)

            stops = await in_thread(StopSocket, socket.with_suffix(SUFFIX), stop)
            stack.push_async_callback(in_thread, stops.close)
            # Last, since waiting clients send requests as soon as the hand is announced.
            place.write([endpoint])
            stack.callback(place.withdraw)
            yield server

    def declare(self) -> None:
        """Begin to receive requests."""

        def key(*parts: str) -> str:
            return network_key(self._hand, "/".join(parts))

        session, liveliness = self._session, self._session.liveliness()
        queries: dict[str, Callable[[zenoh.Query], None]] = {
            HELLO: self._on_hello,
            STOP: self._on_stop,
            CONTROL: self._on_control,
            ASK: self._on_question,
        }
        for group, handle in queries.items():
            session.declare_queryable(key(group, "*"), direct(handle))
        liveliness.declare_subscriber(key(CLIENTS, "*"), direct(self._on_client), history=True)
        # Last, since clients that see the token send requests at once.
        self._token = liveliness.declare_token(key(ALIVE))

    def close(self) -> None:
        """Send the waiting answers; blocks for a moment."""
        self._queries.close()
        self.inboxes.close()
        # The outbox comes last: refusals and inboxes still put calls into it.
        for queue in (self.refused, self.questions, self.stops, self.outbox):
            queue.close()

    def _on_hello(self, query: zenoh.Query) -> None:
        def handle(request: IncomingRequest) -> None:
            # Before the answer, so that the client's first query of the status includes this agent.
            self._commands.agents.meet(str(request.fields["client"]))
            self._identities.hello(request, last_part(query))

        replier = self._replier(query, self.outbox)
        later = self._later(query, replier)
        check, junk = self._identities.welcome(last_part(query)), self._identities.answers_junk
        handle_request(query, HELLO, check, handle, replier, later, junk)

    def _on_stop(self, query: zenoh.Query) -> None:
        send = self._replier(query, self.stops)

        def answer_later(data: bytes, ok: bool) -> None:
            if not self.refused.put(partial(reply, self._hand, query, data, ok)):
                send(data, ok)

        def handle(request: IncomingRequest) -> None:
            if not self._identities.answers_stop_at_once(request.client):
                # Too many stops: their answers are delayed, but they take effect at once.
                request.send = answer_later
            request.check()
            # Name the person only: the door cannot tell a certificate's clients apart.
            self._commands.stop(request.client.partition(".")[0], request.answer)

        check, junk = self._identities.name, self._identities.answers_junk
        handle_request(query, STOP, check, handle, send, answers_junk=junk)

    def _on_control(self, query: zenoh.Query) -> None:
        replier, check = self._replier(query, self.outbox), self._identities.check
        later, junk = self._later(query, replier), self._identities.answers_junk
        handle_request(query, CONTROL, check, self._commands.handle, replier, later, junk)

    def _replier(self, query: zenoh.Query, queue: CallQueue) -> Callable[[bytes, bool], object]:
        """Return a function that queues the answer to a query."""
        return lambda data, ok: queue.put(partial(reply, self._hand, query, data, ok))

    def _later(self, query: zenoh.Query, send: Send) -> Later:
        """Return a function that refuses a query after a delay, and a large one at once."""

        def later(data: bytes | None) -> None:
            large = query.payload is not None and len(query.payload) > _LARGEST_REFUSED
            waits = not large and self.refused.put(partial(refuse, query, data))
            if not waits and data is not None:
                send(data, False)

        return later

    def _on_sample(self, sample: zenoh.Sample) -> None:
        attachment, owner = attachment_of(sample), last_part(sample)
        signed = False

        def check(request: Request, attachment: bytes | None, question: bytes) -> str:
            nonlocal signed
            client = self._identities.signer(request, attachment, question)
            if client is None or client.name != owner:
                raise RequestRejected(f"'{owner}' did not sign this request")
            signed = self._identities.admits(client)  # revoked clients get no answer
            return self._identities.permit(client, request)

        def answer(data: bytes, ok: bool) -> None:
            # Nobody waits for the answer to a sample, so refusals do not slow its sender down.
            self.inboxes.count_excess(owner)
            # Only to the signer: otherwise others could make the hand refuse its samples.
            if (claim := claim_of(attachment)) is not None and signed:
                self._refuse_sample(owner, claim.number, data)

        def later(data: bytes | None) -> None:
            self.inboxes.count_excess(owner)
            if data is not None:
                answer(data, False)

        handle_request(sample, CONTROL, check, self._commands.take_sample, answer, later)

    def _refuse_sample(self, client: str, number: str, data: bytes) -> None:
        topic = topic_for(self._identities.access_path(client), f"{ANSWERS}/{client}")
        key = network_key(self._hand, topic)
        put = partial(self._session.put, key, data, attachment=f"-{number}", **DELIVER)
        self.outbox.put(put)

    def _on_question(self, query: zenoh.Query) -> None:
        def handle(request: IncomingRequest) -> None:
            def send(data: bytes, ok: bool) -> None:
                self._identities.charge(request.client, len(data))
                reply(self._hand, query, data, ok)

            # The thread of `questions` may wait for the network; a refusal here must not.
            at_once, request.send = request.send, send
            if not self.questions.put(partial(answer_to, request, self._queries.handle)):
                request.send = at_once
                raise TooManyRequests("too many requests are waiting")

        replier, check = self._replier(query, self.outbox), self._identities.check
        later, junk = self._later(query, replier), self._identities.answers_junk
        handle_request(query, ASK, check, handle, replier, later, junk)

    def _on_client(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr).rpartition("/")[2]
        if sample.kind == zenoh.SampleKind.PUT:
            self._identities.came(token)
        elif client := self._identities.left(token):
            self.inboxes.remove(client)
            self._commands.client_left(client)
