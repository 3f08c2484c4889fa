"""Who may move a hand: one client at a time."""

from __future__ import annotations

import time
from collections.abc import Callable

from rtee.errors import LeaseHeld

JOGGING = 1.0
"""After jogging a hand, a client holds it for this long [s]."""


class Lease:
    """Who holds a hand.

    A client holds it from ``acquire`` to ``release``, and without asking while its own goal runs
    and shortly after it has jogged. A client that has died holds nothing.

    One thread at a time may use it, but for `ended` and `holder`, which any may at any time.

    Args:
        now: The clock [s].
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._taken = ""
        self._goals: dict[str, str] = {}
        self._jogger = ""
        self._jogged_until = 0.0

    @property
    def holder(self) -> str:
        """The client that holds the hand, or an empty string."""
        if self._taken:
            return self._taken
        if running := tuple(self._goals.values()):
            return running[0]
        return self._jogger if self._now() < self._jogged_until else ""

    def check(self, client: str) -> None:
        """Raise `LeaseHeld` if another client holds the hand."""
        holder = self.holder
        if holder and holder != client:
            raise LeaseHeld(holder)

    def acquire(self, client: str) -> None:
        """Hold the hand until `release`; raises `LeaseHeld`."""
        self.check(client)
        self._taken = client

    def release(self, client: str) -> None:
        """Give the hand back, if this client took or jogged it; a goal that runs stays its own."""
        if self._taken == client:
            self._taken = ""
        if self._jogger == client:
            self._jogged_until = 0.0

    def runs(self, goal_id: str) -> bool:
        """Return whether a goal of that name runs."""
        return goal_id in self._goals

    def started(self, client: str, goal_id: str) -> None:
        """Note that a goal of a client runs."""
        self._goals[goal_id] = client

    def ended(self, goal_id: str) -> None:
        """Note that a goal has ended."""
        self._goals.pop(goal_id, None)

    def jogged(self, client: str) -> None:
        """Note that a client has jogged the hand."""
        self._jogger, self._jogged_until = client, self._now() + JOGGING

    def gone(self, client: str) -> bool:
        """Take everything from a client; return whether it held the hand."""
        held = self.holder == client
        self.release(client)
        for goal, who in tuple(self._goals.items()):
            if who == client:
                self.ended(goal)
        return held
