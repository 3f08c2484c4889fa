"""Publishers, subscriptions, services and clients of a node."""

from __future__ import annotations

import asyncio
import inspect
import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import anyio
import zenoh
from zenoh import ext

from rtee.errors import MessageError, RteeError
from rtee.remote.session import direct
from rtee.ros2 import attachments
from rtee.ros2.attachments import Attachment
from rtee.ros2.inbox import Inbox, SharedLimit
from rtee.ros2.keys import Entity, Kind
from rtee.ros2.message import Message
from rtee.ros2.participant import Participant
from rtee.ros2.qos import History, Qos
from rtee.ros2.types import ServiceType, TopicType

__all__ = ["Client", "Publisher", "Service", "Subscription"]  # the rest is for `rtee.ros2` only

log = logging.getLogger(__name__)

_MOST_KEPT = 1000
"""Most messages of a topic that wait or are kept, whatever the QoS, to limit memory."""


LONGEST = 1 << 20
"""Length of the longest message, request or response accepted [bytes]: ten times the
longest message for a hand, a trajectory of thousands of points."""

Callback = Callable[[Any], Awaitable[None] | None]
"""Called in the event loop with each message of a subscription."""

_Received = tuple[bytes, Attachment]


class Publisher:
    """A publisher; made by `rtee.ros2.node.Node.publisher`.

    Attributes:
        type: Type of the topic.
        name: Fully qualified name of the topic.
        sent: Number of messages published.
    """

    def __init__(self, participant: Participant, entity: Entity, key: str, kind: TopicType) -> None:
        self.type, self.name, self.sent = kind, entity.topic, 0
        self._gid = attachments.gid(entity.token)
        self._lock, self._closed = threading.Lock(), False
        self._publisher = self._declared(participant.session, key, entity.qos)
        self._heard, self._listener = True, None
        if isinstance(self._publisher, zenoh.Publisher):
            # Use a listener, since each query of the status takes as long as encoding a message.
            self._heard = False
            self._listener = self._publisher.declare_matching_listener(direct(self._matched))
            # Queried after declaring the listener, so that no subscriber in between is missed.
            if getattr(self._publisher.matching_status, "matching", True):
                self._heard = True
        # Last, so that a node that sees the publisher in the graph receives its messages.
        self._token = participant.session.liveliness().declare_token(entity.token)

    def _matched(self, status: Any) -> None:
        self._heard = status.matching

    @staticmethod
    def _declared(session: zenoh.Session, key: str, qos: Qos) -> Any:
        # Block only if every message must arrive; a slow subscriber must not stop the hand's node.
        block = qos.reliable and qos.history == History.KEEP_ALL
        control = zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP
        if not qos.transient_local:
            reliability = zenoh.Reliability
            return session.declare_publisher(
                key,
                congestion_control=control,
                reliability=reliability.RELIABLE if qos.reliable else reliability.BEST_EFFORT,
            )
        # Unlike rmw_zenoh's publishers, do not repeat the number of the last message for a while:
        # to stop that, Zenoh waits for its threads while it holds the GIL, for which these threads
        # may wait: a deadlock. On a stream such as TCP, the last message is not lost anyway.
        return ext.declare_advanced_publisher(
            session,
            key,
            congestion_control=control,
            cache=ext.CacheConfig(max_samples=min(qos.depth, _MOST_KEPT)),
            publisher_detection=True,
        )

    @property
    def heard(self) -> bool:
        """Whether anybody subscribes; always true for a latched topic."""
        return self._heard

    def publish(self, message: Message | bytes) -> None:
        """Publish a message, or the CDR bytes of one; may be called from any thread.

        Raises:
            MessageError: if a value does not fit its field, or the message is of another type.
        """
        if isinstance(message, Message):
            if message.STRUCTURE.name != self.type.name:
                raise MessageError(
                    f"{self.name} is a topic of {self.type.name}, not of {message.STRUCTURE.name}"
                )
            message = message.encode()
        # Subscribers detect lost messages by the numbers, which must be consecutive.
        with self._lock:
            # Zenoh would raise an error, and a task may still publish while its node closes.
            if self._closed:
                return
            attachment = attachments.encode(self.sent + 1, time.time_ns(), self._gid)
            self._publisher.put(message, attachment=attachment)
            self.sent += 1

    def close(self) -> None:
        """Leave the graph; drop messages that are published later."""
        with self._lock:
            self._closed = True
        # The token first: the graph must not contain a publisher that does not exist any more.
        self._token.undeclare()  # type: ignore[no-untyped-call]
        if self._listener is not None:
            self._listener.undeclare()  # type: ignore[no-untyped-call]
        self._publisher.undeclare()


class Subscription:
    """A subscription; made by `rtee.ros2.node.Node.subscription`.

    Attributes:
        type: Type of the topic.
        name: Fully qualified name of the topic.
        source: Attachment of the message that the callback receives.
    """

    def __init__(
        self,
        participant: Participant,
        entity: Entity,
        key: str,
        kind: TopicType,
        callback: Callback,
    ) -> None:
        self.type, self.name = kind, entity.topic
        self.source = Attachment(0, 0, b"")
        self._participant, self._callback = participant, callback
        depth = min(entity.qos.depth, _MOST_KEPT)
        if entity.qos.history == History.KEEP_ALL:
            depth = _MOST_KEPT
        self._inbox: Inbox[_Received] = Inbox(self._take, depth)
        # The newest messages wait here while a callback is awaited, since the inbox never waits.
        self._waiting: deque[_Received] = deque(maxlen=max(depth, 1))
        self._busy = False
        self._subscriber = self._declared(participant.session, key, entity.qos)
        self._token = participant.session.liveliness().declare_token(entity.token)

    def _declared(self, session: zenoh.Session, key: str, qos: Qos) -> Any:
        handler = direct(self._on_sample)
        if not qos.transient_local:
            return session.declare_subscriber(key, handler)
        # rmw_zenoh's publishers repeat the number of their last message, which reveals lost ones
        # without periodic queries.
        recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        return ext.declare_advanced_subscriber(
            session,
            key,
            handler,
            history=ext.HistoryConfig(
                detect_late_publishers=True, max_samples=min(qos.depth, _MOST_KEPT)
            ),
            recovery=recovery if qos.reliable else None,
            subscriber_detection=True,
        )

    def _drop(self, error: MessageError) -> None:
        self._participant.warning_log.tell(f"a message on {self.name} is dropped", str(error))

    def _on_sample(self, sample: zenoh.Sample) -> None:
        try:
            attachment = attachments.decode(sample.attachment)
            # Checked before `bytes` copies it, since anybody may send anything.
            if len(sample.payload) > LONGEST:
                raise MessageError(f"it has {len(sample.payload)} bytes")
        except MessageError as error:
            self._drop(error)
            return
        self._inbox.put((bytes(sample.payload), attachment))

    def _take(self, received: _Received) -> None:
        self._waiting.append(received)
        if not self._busy:
            self._next()

    def _next(self) -> None:
        """Call the callback with the waiting messages, until it returns an awaitable."""
        while self._waiting:
            payload, self.source = self._waiting.popleft()
            try:
                result = self._callback(self.type.message.decode(payload))
            except MessageError as error:
                self._drop(error)
            except Exception:
                log.exception("a message on %s could not be handled", self.name)
            else:
                if inspect.isawaitable(result):
                    self._busy = True
                    self._participant.start(self._finish(result))
                    return

    async def _finish(self, result: Awaitable[None]) -> None:
        try:
            await result
        except Exception:
            log.exception("a message on %s could not be handled", self.name)
        finally:
            self._busy = False
        # Not in `finally`, since this task is cancelled only when the context closes.
        self._next()

    def close(self) -> None:
        """Receive nothing more, and leave the graph."""
        self._inbox.close()
        self._waiting.clear()
        # The token first, as for a publisher.
        self._token.undeclare()  # type: ignore[no-untyped-call]
        self._subscriber.undeclare()


_MOST_WAITING = 100
"""Most requests that wait for their turn; further ones are dropped, and their clients time out."""

_MOST_A_SECOND = 400
"""Most requests of a service per second, of which one client may send half: tools send some dozen,
and each takes 0.2 ms of the interpreter, which the hand's loop needs, too."""

FOREVER = 86_400.0 * 365
"""Timeout of a query without one [s]: a year, since Zenoh has no infinite timeout."""

Handler = Callable[[Any], Awaitable[Any]]
"""Returns the response to a request of a service."""


def fields_handler(
    service: ServiceType, handler: Callable[[Any], Awaitable[dict[str, Any]]]
) -> Handler:
    """Return the handler of a service for a function that returns the response's fields."""

    async def handle(request: Any) -> Message:
        return service.response(**await handler(request))

    return handle


@dataclass(frozen=True, slots=True)
class _Asked:
    """A request before decoding, with its query, which ends when its last reference is dropped."""

    query: zenoh.Query
    payload: bytes
    attachment: Attachment


class Service:
    """A service; made by `rtee.ros2.node.Node.service`.

    Attributes:
        type: Its type.
        name: Its fully qualified name.
    """

    def __init__(
        self,
        participant: Participant,
        entity: Entity,
        key: str,
        kind: ServiceType,
        handler: Handler,
        at_once: int,
    ) -> None:
        self.type, self.name = kind, entity.topic
        self._participant, self._key, self._handler, self._most = participant, key, handler, at_once
        self._under_way: set[tuple[bytes, int]] = set()
        self._by_client: Counter[bytes] = Counter()
        self._waiting: deque[_Asked] = deque()
        self._closed = False
        self._limit = SharedLimit(_MOST_A_SECOND)
        # With a place for every request of a second, so that a client that sends many at once
        # takes no other's: who loses one is decided by `_take`, which knows the clients.
        self._inbox: Inbox[_Asked] = Inbox(
            self._take, _MOST_A_SECOND, keep_newest=False, dropped=self._too_many
        )
        # Complete, since clients of rmw_zenoh query only complete queryables.
        self._queryable = participant.session.declare_queryable(
            key, direct(self._on_query), complete=True
        )
        # Last, so that a client that sees the service in the graph can call it.
        self._token = participant.session.liveliness().declare_token(entity.token)

    @property
    def _nothing(self) -> Message:
        """The response with the default value in each field."""
        made: Message = self.type.response.from_dict({})
        return made

    @contextmanager
    def _errors_logged(self) -> Iterator[None]:
        """Log errors raised in the context."""
        try:
            yield
        except RteeError as error:
            self._participant.warning_log.tell(f"a request of {self.name} fails", str(error))
        except Exception:
            log.exception("the service %s failed", self.name)

    def _drop(self, why: str) -> None:
        self._participant.warning_log.tell(f"a request of {self.name} is dropped", why)

    def _too_many(self) -> None:
        self._participant.warning_log.tell(
            f"requests of {self.name} are dropped", "too many at once"
        )

    def _on_query(self, query: zenoh.Query) -> None:
        try:
            attachment = attachments.decode(query.attachment)
            # Before the payload is copied, so that refusing a flood of requests costs little.
            if not self._limit.passes(attachment.gid):
                self._too_many()
                return
            payload = query.payload
            if payload is None or not 0 < len(payload) <= LONGEST:
                length = 0 if payload is None else len(payload)
                raise MessageError(f"{length} bytes are not a {self.type.request.STRUCTURE.name}")
        except MessageError as error:
            self._drop(str(error))
            return
        self._inbox.put(_Asked(query, bytes(payload), attachment))

    def _take(self, received: _Asked) -> None:
        if self._has_place(received):
            self._begin(received)
            return
        self._waiting.append(received)
        if len(self._waiting) > _MOST_WAITING:
            # The client with the most waiting requests loses its last one, so that a client that
            # sends many takes no other's turn.
            clients = [asked.attachment.gid for asked in self._waiting]
            most = Counter(reversed(clients)).most_common(1)[0][0]
            del self._waiting[max(n for n, client in enumerate(clients) if client == most)]
            self._too_many()

    def _has_place(self, received: _Asked) -> bool:
        """Whether a request can begin: its client has fewer under way than there are places left.

        So one client takes half of the places at most, the next one half of the rest, and a client
        without a request under way finds one as long as there is any.
        """
        left = self._most - len(self._under_way)
        return self._by_client[received.attachment.gid] < left

    def _begin(self, received: _Asked) -> None:
        number = (received.attachment.gid, received.attachment.sequence)
        # A client matches answers by this number and could not distinguish two with the same one.
        if number in self._under_way:
            self._drop("an earlier request with its number is not answered yet")
            return
        try:
            request = self.type.request.decode(received.payload)
        except MessageError as error:
            self._drop(str(error))
            self._reply(received, self._nothing)
            return
        self._under_way.add(number)
        self._by_client[number[0]] += 1
        self._participant.start(self._answer(received, number, request))

    async def _answer(self, received: _Asked, number: tuple[bytes, int], request: Any) -> None:
        # ROS 2 has no error responses, and its clients wait for ever: so send an empty response.
        response = self._nothing
        try:
            with self._errors_logged():
                response = await self._handler(request)
            with self._errors_logged():
                # The handler may take any time, and the queryable may be gone by then.
                if not self._closed:
                    self._reply(received, response)
        finally:
            self._under_way.discard(number)
            self._by_client -= Counter((number[0],))  # which forgets a client at zero
            waiting, self._waiting = self._waiting, deque()
            for asked in waiting:
                if self._has_place(asked):
                    self._begin(asked)
                else:
                    self._waiting.append(asked)

    def _reply(self, received: _Asked, response: Any) -> None:
        if not isinstance(response, self.type.response):
            raise MessageError(f"{self.type.response.STRUCTURE.name} expected, not {response!r}")
        attachment = attachments.encode(
            received.attachment.sequence, time.time_ns(), received.attachment.gid
        )
        # Leaving the context ends the query at once instead of at garbage collection.
        with received.query as query:
            query.reply(self._key, response.encode(), attachment=attachment)

    def close(self) -> None:
        """Drop the waiting requests, and leave the graph."""
        self._closed = True
        self._inbox.close()
        self._waiting.clear()
        self._token.undeclare()  # type: ignore[no-untyped-call]
        self._queryable.undeclare()  # type: ignore[no-untyped-call]


class Client:
    """A client of a service; made by `rtee.ros2.node.Node.client`.

    Attributes:
        type: Type of the service.
        name: Fully qualified name of the service.
    """

    def __init__(
        self, participant: Participant, entity: Entity, key: str, kind: ServiceType
    ) -> None:
        self.type, self.name = kind, entity.topic
        self._participant, self._key = participant, key
        self._gid = attachments.gid(entity.token)
        self._asked = 0
        self._lock = threading.Lock()
        self._token = participant.session.liveliness().declare_token(entity.token)

    @property
    def available(self) -> bool:
        """Whether any node offers the service."""
        return bool(self._participant.graph.of(Kind.SERVICE, self.name, self.type.name))

    async def wait(self, timeout: float = math.inf) -> None:
        """Wait until a node offers the service.

        Args:
            timeout: Longest time to wait [s].

        Raises:
            TimeoutError: if no node does by then.
        """
        with anyio.move_on_after(timeout) as scope:
            await self._participant.graph.wait_until(lambda: self.available)
            await self._answerable()
        if scope.cancelled_caught:
            raise TimeoutError(f"no node offers the service {self.name} ({self.type.name})")

    async def _answerable(self) -> None:
        """Wait for the queryable: a call that comes after its token but before it would fail."""
        loop, there = asyncio.get_running_loop(), asyncio.Event()

        def note(status: Any) -> None:
            if status.matching:
                loop.call_soon_threadsafe(there.set)

        with self._participant.session.declare_querier(
            self._key, target=zenoh.QueryTarget.ALL_COMPLETE
        ) as querier:
            querier.declare_matching_listener(direct(note))
            if not getattr(querier.matching_status, "matching", True):
                await there.wait()

    async def call(self, request: Message, timeout: float = 5.0) -> Any:
        """Call the service and return its response.

        Args:
            request: The request.
            timeout: Longest time until the response [s]; may be infinite.

        Raises:
            TimeoutError: if there is no response.
            MessageError: if a value of the request does not fit its field, or the response is
                malformed.
        """
        if not isinstance(request, self.type.request):
            raise MessageError(f"{self.type.request.STRUCTURE.name} expected, not {request!r}")
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[bytes] = loop.create_future()

        def settle(payload: bytes | None) -> None:
            # After a timeout, or at the end of a query that has been answered.
            if answer.done():
                return
            if payload is None:
                # Zenoh's end of the query, not the timeout below: no server, or one that gave no
                # response.
                answer.set_exception(TimeoutError(f"the service {self.name} does not answer"))
            else:
                answer.set_result(payload)

        def hand_over(payload: bytes | None) -> None:
            try:
                loop.call_soon_threadsafe(settle, payload)
            except RuntimeError:  # the event loop is closed
                pass

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and len(reply.ok.payload) <= LONGEST:
                hand_over(bytes(reply.ok.payload))

        payload, token = request.encode(), zenoh.CancellationToken()
        with self._lock:
            self._asked += 1
            attachment = attachments.encode(self._asked, time.time_ns(), self._gid)
        self._participant.session.get(
            self._key,
            direct(on_reply, lambda: hand_over(None)),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            # With consolidation, Zenoh would hold the response back until the query ends.
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=min(timeout, FOREVER),
            payload=payload,
            attachment=attachment,
            cancellation_token=token,
        )
        try:
            with anyio.move_on_after(timeout):
                return self.type.response.decode(await answer)
            raise TimeoutError(f"the service {self.name} does not answer")
        finally:
            # An abandoned query would stay open until its timeout, up to a year.
            token.cancel()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Leave the graph."""
        self._token.undeclare()  # type: ignore[no-untyped-call]
