"""Publishers and subscriptions of a node."""

from __future__ import annotations

import inspect
import logging
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any

import zenoh
from zenoh import ext

from rtee.errors import MessageError
from rtee.remote.session import direct
from rtee.ros2 import attachments
from rtee.ros2.attachments import Attachment
from rtee.ros2.inbox import Inbox
from rtee.ros2.keys import Entity
from rtee.ros2.message import Message
from rtee.ros2.participant import Participant
from rtee.ros2.qos import History, Qos
from rtee.ros2.types import TopicType

log = logging.getLogger(__name__)

_MOST_KEPT = 1000
"""Most messages of a topic that wait or are kept, whatever the QoS: a limit to the memory."""


LONGEST = 1 << 20
"""Default length of the longest message, request or response accepted [bytes]: ten times the
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
            # By listener, since each query of the status takes as long as encoding a message.
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
        # All others drop messages, so that a slow subscriber cannot block the hand's node.
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
        # to stop that, Zenoh waits for its threads while it holds Python's lock, for which these
        # threads may wait, a deadlock. On a stream such as TCP, no last message is lost.
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
        longest: int,
    ) -> None:
        self.type, self.name = kind, entity.topic
        self.source = Attachment(0, 0, b"")
        self._participant, self._callback, self._longest = participant, callback, longest
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
            if len(sample.payload) > self._longest:
                raise MessageError(f"of {len(sample.payload)} bytes")
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
