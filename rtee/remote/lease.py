"""The lease: the right to move a hand, which one client at a time has."""

from __future__ import annotations

import math
from collections.abc import Callable

from rtee import monotonic
from rtee.errors import LeaseHeld

JOGGING = 1.0
"""Time for which a client holds the lease after a jog [s]: longer than between two clicks."""


IDLE = 3.0
"""Time without a sample, beyond the stream's deadline, after which an open stream does not hold the
lease any more [s]: the hand has paused it, and its person may have gone."""


class Lease:
    """The lease of a hand, by the clock ``now`` [s].

    A client holds it from ``acquire`` to ``release``, and implicitly while its own goal runs, while
    samples of its stream come, and shortly after it has jogged the hand. A client that has left
    holds nothing.

    One thread at a time may use it, except `ended` and `holder`, which may be used at any time.
    """

    def __init__(self, now: Callable[[], float] = monotonic.asked) -> None:
        self._now = now
        self._acquired = ""
        self._goals: dict[str, str] = {}
        self._deadlines: dict[str, float] = {}  # by open stream [s]
        self._sampled = 0.0
        self._jogger = ""
        self._jogged_until = 0.0

    @property
    def holder(self) -> str:
        """The client that holds the lease, or an empty string."""
        if self._acquired:
            return self._acquired
        # A copy, since the loop's thread may end a goal meanwhile.
        for goal_id, client in tuple(self._goals.items()):
            deadline = self._deadlines.get(goal_id, math.inf)
            if self._now() - self._sampled < deadline + IDLE:
                return client
        return self._jogger if self._now() < self._jogged_until else ""

    def check(self, client: str) -> None:
        """Raise `LeaseHeld` if another client holds the lease."""
        holder = self.holder
        if holder and holder != client:
            raise LeaseHeld(holder)

    def acquire(self, client: str) -> None:
        """Give a client the lease until `release`; raises `LeaseHeld`."""
        self.check(client)
        self._acquired = client

    def release(self, client: str) -> None:
        """Release the lease that a client got by `acquire` or a jog; its running goal keeps it."""
        if self._acquired == client:
            self._acquired = ""
        if self._jogger == client:
            self._jogged_until = 0.0

    def runs(self, goal_id: str) -> bool:
        """Return whether a goal with this identifier is running."""
        return goal_id in self._goals

    def started(self, client: str, goal_id: str) -> None:
        """Record that a goal of a client runs."""
        self._goals[goal_id] = client

    def streams(self, client: str, stream: str, deadline: float) -> None:
        """Record that a client's stream is open, with its deadline [s]."""
        self._sampled = self._now()
        self._deadlines = {stream: deadline}  # a hand plays one stream at a time
        self.started(client, stream)

    def sampled(self, client: str, stream: str) -> None:
        """Record that a client has sent a sample; raises `LeaseHeld` if the stream is another's."""
        owner = self._goals.get(stream, client)
        if owner != client:
            raise LeaseHeld(owner)
        self._sampled = self._now()

    def ended(self, goal_id: str) -> None:
        """Record that a goal or a stream has ended."""
        # One atomic step: the loop's thread calls this while Zenoh's threads look up leases.
        self._goals.pop(goal_id, None)

    def stream_ended(self, stream: str) -> None:
        """Record that a stream has ended; a goal of the same name continues."""
        if stream in self._deadlines:
            self.ended(stream)

    def jogged(self, client: str) -> None:
        """Record that a client has jogged the hand."""
        self._jogger, self._jogged_until = client, self._now() + JOGGING

    def client_left(self, client: str) -> bool:
        """Release all that a client holds when it has left; return whether it held the lease."""
        # First, since after the release the client holds nothing.
        held = self.holder == client
        self.release(client)
        for goal, owner in tuple(self._goals.items()):
            if owner == client:
                self.ended(goal)
        return held
