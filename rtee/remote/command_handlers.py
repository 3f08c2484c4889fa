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
from typing import Any

from rtee.errors import ConfigError, GoalRejected, RequestRejected
from rtee.hand.names import check_name
from rtee.loop.handloop import HandLoop
from rtee.messages import decode_goal
from rtee.remote.incoming_request import Asked
from rtee.remote.lease import Lease
from rtee.remote.loop_thread import LoopThread
from rtee.types import Goal

Fields = Mapping[str, Any]

_MOST_WAITING = 64
"""Clients that may wait for their greeting: far more than connect at once, but bounded."""


class Control:
    """Takes the requests of the groups ``control`` and ``stop``, and knows who is there.

    Args:
        loop: The hand's loop.
        lease: Who holds the hand.
        thread: The loop's thread.
    """

    def __init__(self, loop: HandLoop, lease: Lease, thread: LoopThread) -> None:
        self._loop, self._lease, self._thread = loop, lease, thread
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
            "acquire": self._acquire,
            "release": self._release,
        }

    def handle(self, asked: Asked) -> None:
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

    def stop(self, asked: Asked) -> None:
        """Stop all devices; whoever asks may, and need not have said hello."""
        client = asked.fields["client"] or "a client"

        async def run() -> None:
            confirmed = dict(await self._loop.stop(f"stopped by {client}"))
            asked.answer({"device": list(confirmed), "confirmed": list(confirmed.values())})

        self._thread.start(run)

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
            held = self._lease.gone(client)
        if held:
            self._thread.call_soon(self._loop.client_lost, client)

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
        self._lease.check(goal.client)
        if self._lease.runs(goal.goal_id):
            raise GoalRejected(f"the goal '{goal.goal_id}' runs already")
        self._lease.started(goal.client, goal.goal_id)
        try:
            self._loop.submit(goal)
        except Exception:
            self._lease.ended(goal.goal_id)
            raise
        return goal.goal_id

    def _cancel(self, asked: Asked) -> str:
        self._lease.check(asked.fields["client"])
        self._loop.cancel(asked.fields["goal_id"])
        return ""

    def _hold(self, asked: Asked) -> str:
        self._lease.check(asked.fields["client"])
        self._loop.hold(f"{asked.fields['client']} asked to hold")
        return ""

    def _jog(self, asked: Asked) -> str:
        fields = asked.fields
        self._lease.check(fields["client"])
        limit = None if math.isnan(fields["limit"]) else fields["limit"]
        self._loop.jog(_values(fields), limit)
        self._lease.jogged(fields["client"])
        return ""

    def _gains(self, asked: Asked) -> None:
        fields = asked.fields
        self._lease.check(fields["client"])
        values, device = _values(fields), fields["source"] or None
        self._later(asked, lambda: self._loop.set_gains(values, device))

    def _recover(self, asked: Asked) -> None:
        self._lease.check(asked.fields["client"])
        device = asked.fields["what"] or None
        self._later(asked, lambda: self._loop.recover(device))

    def _acquire(self, asked: Asked) -> str:
        self._lease.acquire(asked.fields["client"])
        return ""

    def _release(self, asked: Asked) -> str:
        self._lease.release(asked.fields["client"])
        return ""

    def _later(self, asked: Asked, what: Callable[[], Awaitable[None]]) -> None:
        async def run() -> None:
            try:
                await what()
            except Exception as error:
                asked.refuse(error)
            else:
                asked.accept()

        self._thread.start(run)


def _values(fields: Fields) -> dict[str, float]:
    if len(fields["name"]) != len(fields["value"]):
        raise GoalRejected("as many names as values are needed")
    return dict(zip(fields["name"], fields["value"].tolist(), strict=True))
