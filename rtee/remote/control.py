"""The requests that steer the hand, taken in Zenoh's threads.

What moves the hand is only appended to what the loop does at its next tick, which any thread may
do: a goal does not wait for the event loop to wake up. One lock keeps Zenoh's threads apart; the
loop's thread never takes it, so that it cannot be held up here.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Awaitable, Callable, Mapping
from typing import TYPE_CHECKING, Any

from rtee.errors import ConfigError, GoalRejected, RequestRejected
from rtee.hand.names import check_name
from rtee.messages import decode_goal
from rtee.remote.asked import Asked
from rtee.remote.lease import Lease
from rtee.types import Goal

if TYPE_CHECKING:
    from rtee.remote.server import Server

Fields = Mapping[str, Any]

_MOST_WAITING = 64


class Control:
    """Takes the requests of the group ``control``, and knows who holds the hand."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._loop = server.loop
        self.lease = Lease()
        self._lock = threading.Lock()
        self._clients: set[str] = set()
        self._greeting: dict[str, Asked] = {}
        self._handlers: dict[str, Callable[[Asked], str | None]] = {
            "hello": self._hello,
            "cancel": self._cancel,
            "hold": self._hold,
            "jog": self._jog,
            "gains": self._gains,
            "recover": self._recover,
            "take": self._take,
            "release": self._release,
        }

    def take(self, asked: Asked) -> None:
        """Do what is asked.

        Raises:
            RteeError: why not.
        """
        name = asked.request.name
        goal = decode_goal(asked.question) if name == "do" else None
        client = asked.fields["client"] if goal is None else goal.client
        with self._lock:
            if client not in self._clients and name != "hello":
                raise RequestRejected("who asks is not known here; say hello first")
            done = self._handlers[name](asked) if goal is None else self._do(goal)
        if done is not None:
            asked.accept(done)

    def knows(self, client: str) -> bool:
        """Return whether a client is there."""
        return client in self._clients

    def came(self, client: str) -> None:
        """Note that a client is there."""
        with contextlib.suppress(ConfigError), self._lock:
            self._clients.add(check_name(client, "client"))
            greeting = self._greeting.pop(client, None)
            if greeting is not None:
                greeting.accept()

    def gone(self, client: str) -> None:
        """Note that a client is there no more; if it held the hand, nobody drives it now."""
        with self._lock:
            self._clients.discard(client)
            held = self.lease.gone(client)
        if held:
            self._server.call_soon(self._loop.client_lost, client)

    def _hello(self, asked: Asked) -> str | None:
        client = check_name(asked.fields["client"], "client")
        if client in self._clients:
            return ""
        if len(self._greeting) >= _MOST_WAITING:
            raise RequestRejected("too many clients say hello without being there")
        self._greeting[client] = asked
        return None

    def _do(self, goal: Goal) -> str:
        check_name(goal.goal_id, "goal")
        self.lease.check(goal.client)
        if self.lease.runs(goal.goal_id):
            raise GoalRejected(f"the goal '{goal.goal_id}' runs already")
        self.lease.started(goal.client, goal.goal_id)
        try:
            self._loop.submit(goal)
        except Exception:
            self.lease.ended(goal.goal_id)
            raise
        return goal.goal_id

    def _cancel(self, asked: Asked) -> str:
        self.lease.check(asked.fields["client"])
        self._loop.cancel(asked.fields["goal_id"])
        return ""

    def _hold(self, asked: Asked) -> str:
        self.lease.check(asked.fields["client"])
        self._loop.hold(f"{asked.fields['client']} asked to hold")
        return ""

    def _jog(self, asked: Asked) -> str:
        fields = asked.fields
        self.lease.check(fields["client"])
        limit = None if math.isnan(fields["limit"]) else fields["limit"]
        self._loop.jog(_values(fields), limit)
        self.lease.jogged(fields["client"])
        return ""

    def _gains(self, asked: Asked) -> None:
        fields = asked.fields
        self.lease.check(fields["client"])
        values, device = _values(fields), fields["source"] or None
        self._later(asked, lambda: self._loop.set_gains(values, device))

    def _recover(self, asked: Asked) -> None:
        self.lease.check(asked.fields["client"])
        device = asked.fields["what"] or None
        self._later(asked, lambda: self._loop.recover(device))

    def _take(self, asked: Asked) -> str:
        self.lease.take(asked.fields["client"])
        return ""

    def _release(self, asked: Asked) -> str:
        self.lease.release(asked.fields["client"])
        return ""

    def _later(self, asked: Asked, what: Callable[[], Awaitable[None]]) -> None:
        async def run() -> None:
            try:
                await what()
            except Exception as error:
                asked.refuse(error)
            else:
                asked.accept()

        self._server.call_soon(self._server.start, run)


def _values(fields: Fields) -> dict[str, float]:
    if len(fields["name"]) != len(fields["value"]):
        raise GoalRejected("as many names as values are needed")
    return dict(zip(fields["name"], fields["value"].tolist(), strict=True))
