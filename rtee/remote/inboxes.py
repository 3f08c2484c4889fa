"""The samples of streams that clients publish, each client on a key of its own.

Each message takes Python's interpreter lock when it arrives, and thousands per second take it from
the loop. Queries can be slowed down by late answers, but publishers wait for no answer. So the hand
stops listening to a client that publishes too much, for a moment: its messages are then dropped by
the client or by Zenoh, without Python.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from functools import partial

import zenoh

from rtee import monotonic
from rtee.messages.requests import inbox_key
from rtee.remote.call_queue import CallQueue, DelayQueue
from rtee.remote.rates import EXCESS, Rates
from rtee.remote.session import direct

_CLOSED_FOR = 1.0
"""Time for which the inbox of a client that publishes too much is closed [s]. Meanwhile its
allowance grows again, and the burst that follows delays some ticks; so this time doubles if the
client does not stop."""

_LONGEST_CLOSED = 16.0
"""Longest such time [s]: a client that goes on flooding gets one burst through in it, and one that
has stopped is heard again after it at the latest."""

_LOOK_EVERY = 0.5
"""Interval of the checks whether to open an inbox again [s]: half of the shortest time closed."""

_MOST_CLOSED = 1000
"""Inboxes that may be closed at a time: more than there are clients."""


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
