"""The requests that steer the hand: checked in a thread of Zenoh, done in the loop's thread."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Mapping
from typing import TYPE_CHECKING, Any

from rtee.errors import GoalRejected, RequestRejected
from rtee.hand.names import check_name
from rtee.loop.plan import make_plan
from rtee.messages.convert import goal_of
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
        self._clients: set[str] = set()
        self._greeting: dict[str, Asked] = {}
        self._handlers: dict[str, Callable[[Asked], None]] = {
            "hello": self._hello,
            "do": self._do,
            "cancel": self._cancel,
            "hold": self._hold,
            "jog": self._jog,
            "gains": self._gains,
            "recover": self._recover,
            "take": self._take,
            "release": self._release,
        }

    # --- in Zenoh's thread

    def check(self, asked: Asked) -> Asked:
        """Refuse what cannot be, before the loop's thread hears of it.

        Raises:
            RteeError: why not.
        """
        fields = asked.fields
        check_name(fields["client"], "client")
        if asked.request.name == "do":
            goal = goal_of(fields)
            check_name(goal.goal_id, "goal")
            make_plan(goal, self._server.hand, self._loop.library, self._loop.settings)
        elif "value" in fields and len(fields["name"]) != len(fields["value"]):
            raise GoalRejected("as many names as values are needed")
        return asked

    # --- in the loop's thread

    def take(self, asked: Asked) -> None:
        """Do what is asked."""
        try:
            if asked.request.name != "hello" and asked.fields["client"] not in self._clients:
                raise RequestRejected("who asks is not known here; say hello first")
            self._handlers[asked.request.name](asked)
        except Exception as error:
            asked.refuse(error)

    def came(self, client: str) -> None:
        """Note that a client is there."""
        self._clients.add(client)
        greeting = self._greeting.pop(client, None)
        if greeting is not None:
            greeting.accept()

    def gone(self, client: str) -> None:
        """Note that a client is there no more; if it held the hand, nobody drives it now."""
        self._clients.discard(client)
        if self.lease.gone(client):
            self._loop.client_lost(client)

    def _hello(self, asked: Asked) -> None:
        client = asked.fields["client"]
        if client in self._clients:
            asked.accept()
        elif len(self._greeting) < _MOST_WAITING:
            self._greeting[client] = asked
        else:
            raise RequestRejected("too many clients say hello without being there")

    def _do(self, asked: Asked) -> None:
        goal: Goal = goal_of(asked.fields)
        self.lease.check(goal.client)
        if self.lease.runs(goal.goal_id):
            raise GoalRejected(f"the goal '{goal.goal_id}' runs already")
        self._loop.submit(goal)
        self.lease.started(goal.client, goal.goal_id)
        asked.accept(goal.goal_id)

    def _cancel(self, asked: Asked) -> None:
        self.lease.check(asked.fields["client"])
        self._loop.cancel(asked.fields["goal_id"])
        asked.accept()

    def _hold(self, asked: Asked) -> None:
        self.lease.check(asked.fields["client"])
        self._loop.hold(f"{asked.fields['client']} asked to hold")
        asked.accept()

    def _jog(self, asked: Asked) -> None:
        fields = asked.fields
        self.lease.check(fields["client"])
        limit = None if math.isnan(fields["limit"]) else fields["limit"]
        self._loop.jog(_values(fields), limit)
        self.lease.jogged(fields["client"])
        asked.accept()

    def _gains(self, asked: Asked) -> None:
        fields = asked.fields
        self.lease.check(fields["client"])
        device = fields["source"] or None
        self._later(asked, lambda: self._loop.set_gains(_values(fields), device))

    def _recover(self, asked: Asked) -> None:
        self.lease.check(asked.fields["client"])
        device = asked.fields["what"] or None
        self._later(asked, lambda: self._loop.recover(device))

    def _take(self, asked: Asked) -> None:
        self.lease.take(asked.fields["client"])
        asked.accept()

    def _release(self, asked: Asked) -> None:
        self.lease.release(asked.fields["client"])
        asked.accept()

    def _later(self, asked: Asked, what: Callable[[], Awaitable[None]]) -> None:
        async def run() -> None:
            try:
                await what()
            except Exception as error:
                asked.refuse(error)
            else:
                asked.accept()

        self._server.start(run)


def _values(fields: Fields) -> dict[str, float]:
    return dict(zip(fields["name"], fields["value"].tolist(), strict=True))
