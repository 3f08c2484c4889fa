"""What clients put: each puts on keys of its own, so that who puts too much is kept out alone.

Each message that arrives has Python's lock taken, and thousands in a second take it from the loop.
Who asks can be answered later; who puts waits for nothing. So the hand stops listening to such a
client for a moment: what it puts then is dropped where it is sent, or by Zenoh, without Python.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from functools import partial

import zenoh

from rtee.messages.requests import inbox_key
from rtee.remote.call_queue import CallQueue, DelayQueue
from rtee.remote.rates import EXCESS, Rates
from rtee.remote.session import direct

_CLOSED_FOR = 1.0
"""Time for which a client that puts too much is not heard [s]. In the meantime its allowance grows
again, and what it then sends at once delays some ticks; so this time doubles if it goes on."""

_LONGEST_CLOSED = 16.0
"""Longest such time [s]."""

_LOOK_EVERY = 0.5
"""How often it is looked whether a client is heard again [s]."""

_MOST_CLOSED = 1000
"""Inboxes that may be closed at a time: more than there are clients."""


class _Inbox:
    """The inbox of a client that is there.

    Attributes:
        key: The keys on which the client puts.
        rates: How much may come that is not accepted.
        closed: Whether the client is not heard for a while.
        closed_for: How long it was not heard, or will not be, the last time [s].
        until: When that ends, or ended [s].
        subscriber: Receives what it puts; `None` while it is not heard.
    """

    __slots__ = ("closed", "closed_for", "key", "rates", "subscriber", "until")

    def __init__(self, key: str) -> None:
        self.key = key
        self.rates = Rates()
        self.closed = False
        self.closed_for, self.until = 0.0, -math.inf
        self.subscriber: zenoh.Subscriber[None] | None = None

    def close(self) -> None:
        """Note that the client is not heard from now on; the sooner again, the longer."""
        now = time.monotonic()
        again = now - self.until < 2.0 * self.closed_for
        self.closed_for = min(2.0 * self.closed_for, _LONGEST_CLOSED) if again else _CLOSED_FOR
        self.until, self.closed = now + self.closed_for, True


class Inboxes:
    """Receives what the clients of a hand put. Any thread may call its methods.

    Args:
        session: The Zenoh session.
        hand: The hand's name.
        receive: Called with each message, in Zenoh's thread.
        calls: Makes the calls that tell Zenoh what to listen to, one after the other.
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

    def open(self, client: str, way: str) -> None:
        """Begin to listen to a client that comes to the hand in a way, see `HELLO`."""
        inbox = _Inbox(inbox_key(self._hand, way, "*", client))
        with self._lock:
            self._inboxes[client] = inbox
        self._call(partial(self._listen, client, inbox))

    def remove(self, client: str) -> None:
        """Listen to a client no more."""
        with self._lock:
            inbox = self._inboxes.pop(client, None)
        if inbox is not None:
            self._call(partial(self._ignore, inbox))

    def count_excess(self, client: str) -> None:
        """Count what came to a client's inbox and must not come often.

        Where too much comes, this client is not heard for a while.
        """
        with self._lock:
            inbox = self._inboxes.get(client)
            if inbox is None or inbox.closed or inbox.rates.allow(EXCESS):
                return
            # Without room for the call the client is still heard, and the next excess tries again.
            if self._calls.put(partial(self._ignore, inbox)):
                inbox.close()
                self._closed.put(partial(self._reopen, client, inbox))

    def close(self) -> None:
        """Listen to nobody who is closed out now again; blocks for a moment."""
        with self._lock:
            self._inboxes.clear()
        self._closed.close()

    # --- in the threads of the queues

    def _call(self, call: Callable[[], object]) -> None:
        """Have a call made soon; one for which there is no room is tried again."""
        if not self._calls.put(call):
            self._closed.put(partial(self._call, call))

    def _reopen(self, client: str, inbox: _Inbox) -> None:
        with self._lock:
            # It has left meanwhile, or has come again with a new inbox.
            if self._inboxes.get(client) is not inbox:
                return
            if time.monotonic() < inbox.until:
                self._closed.put(partial(self._reopen, client, inbox))
                return
            inbox.closed = False
        self._call(partial(self._listen, client, inbox))

    def _listen(self, client: str, inbox: _Inbox) -> None:
        # The client may have left while this call waited; its subscriber would stay for ever.
        if self._inboxes.get(client) is inbox and inbox.subscriber is None:
            inbox.subscriber = self._session.declare_subscriber(inbox.key, direct(self._receive))

    def _ignore(self, inbox: _Inbox) -> None:
        if inbox.subscriber is not None:
            inbox.subscriber.undeclare()  # type: ignore[no-untyped-call]
            inbox.subscriber = None
