"""Limits per client, certificate and user: connections, clients, requests and answers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NoReturn

from rtee import monotonic
from rtee.errors import RequestRejected

CONNECTIONS_OF_CERTIFICATE = 32
"""Most connections of one certificate: far more than one person's programs have."""

CONNECTIONS_FOR_STOPS = 8
"""Connections of one certificate beyond its limit, so that a stop gets in even if the certificate's
programs have used up the limit."""

CONNECTIONS_OF_USER = 100
"""Most connections of one user of this computer, less than a hand accepts in all."""

CLIENTS_OF_SHARE = 64
"""Most clients with one certificate, or of one user on the hand's computer: far more than ever work
together."""

TOGETHER = 8.0
"""Allowance of all clients of one share together, in multiples of one client's: as much as eight
programs that are busy all the time. Otherwise a person's share would grow with each client."""

RESERVED = 1.0 / 16.0
"""Allowance of a client that others of its share cannot use up, in multiples of one client's: a
lone client goes on working, slowly. For all of `CLIENTS_OF_SHARE` together, this adds half of
`TOGETHER`."""

_BURST = 0.5
"""Burst of requests, in seconds of their rate [s]: a program's first requests come at once."""

REFUSALS = "refusals"
"""Name under which refusals are counted. Requests beyond the limit get no answer, since an answer
costs more than a look at a request."""

EXCESS = "excess"
"""Name under which publications are counted that are not accepted, from a client or on its keys."""

_USUAL = 100.0
"""Default rate of requests of a kind [1/s]: several times that of programs that poll."""

_RATES = {
    "hello": _USUAL / TOGETHER,  # counted by access path: the client is not known yet
    "jog": 200.0,  # a dragged slider sends sixty
    "sample": 4000.0,  # `StreamIntake` limits samples by the rate of their stream
    "info": 20.0,  # some milliseconds of work for every new posture
    "openings": 20.0,
    "grasp_plan": 10.0,
    "reach": 20.0,
    "add": 40.0,  # these write files, and an event follows each
    "store": 40.0,
    "remove": 40.0,
    "rename": 40.0,
    "record": 10.0,
    "stop": 20.0,  # stops beyond it also take effect, but are answered later
    REFUSALS: 200.0,
    EXCESS: 20.0,  # beyond it, the client's inbox is closed for a moment
}
"""Rates of requests of other kinds [1/s]."""


_BYTES = "bytes"
"""Name under which the bytes of answers to questions are counted."""

_MOST_BYTES = 1e6
"""Rate of the bytes of answers to questions [B/s]: twenty lists of a large hand's actions. Answers
are copied while Python's interpreter lock is held, which the loop also needs."""

_BURST_BYTES = 2e6
"""Burst of the bytes of answers [B]: those that user interfaces request when they start."""


class Ignored(Exception):
    """A request without an answer."""


class Rates:
    """Limits the requests of one client: a token bucket for each kind, by the clock ``now`` [s].

    ``times`` multiplies all limits, for several clients together.
    """

    __slots__ = ("_left", "_now", "_times")

    def __init__(self, now: Callable[[], float] = monotonic.asked, times: float = 1.0) -> None:
        self._now, self._times = now, times
        self._left: dict[str, tuple[float, float]] = {}

    def allow(self, name: str) -> bool:
        """Count a request and return whether it may be handled."""
        now = self._now()
        left, _ = self._allowance(name, now)
        # A refused request uses up nothing: clients that go on are not locked out for longer.
        if left < 1.0:
            return False
        self._left[name] = left - 1.0, now
        return True

    def wait(self, name: str) -> float:
        """Return the time until a request will be allowed [s]."""
        left, rate = self._allowance(name, self._now())
        return max(0.0, 1.0 - left) / rate if rate > 0.0 else math.inf

    def _allowance(self, name: str, now: float) -> tuple[float, float]:
        """Return how many requests are allowed now, and their rate [1/s]."""
        rate = self._times * _RATES.get(name, _USUAL)
        # With less than one, a slow rate would allow nothing at all.
        most = max(_BURST * rate, float(rate > 0.0))
        left, then = self._left.get(name, (most, now))
        return min(left + (now - then) * rate, most), rate

    def charge(self, size: int) -> None:
        """Count the bytes of an answer."""
        # May become negative, since an answer's length is known only after it was permitted.
        self._left[_BYTES] = self._bytes_left() - size, self._now()

    def has_bytes(self) -> bool:
        """Return whether one more answer may be sent, of any length."""
        return self._bytes_left() > 0.0

    def _bytes_left(self) -> float:
        now = self._now()
        rate, most = self._times * _MOST_BYTES, self._times * _BURST_BYTES
        left, then = self._left.get(_BYTES, (most, now))
        return min(left + (now - then) * rate, most)

    def refuse(self, reason: str, kind: type[RequestRejected] = RequestRejected) -> NoReturn:
        """Raise an error with a reason, or `Ignored` after too many refusals."""
        if self.allow(REFUSALS):
            raise kind(reason)
        raise Ignored
