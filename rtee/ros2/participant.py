"""A program's session in a ROS 2 domain, shared by its publishers, subscriptions and services."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import threading
from collections.abc import Callable, Coroutine
from typing import Any

import anyio
import zenoh

from rtee.remote.session import direct
from rtee.ros2.inbox import WarningLog
from rtee.ros2.keys import GRAPH, LONGEST_TOKEN, Entity, Kind, parse_token
from rtee.ros2.types import interfaces

MOST = 20_000
"""Most entities kept: twenty times those of a large robot."""

_SETTLE = 3.0
"""Longest time until all sessions have announced their entities [s]."""

_QUIET = 0.3
"""Time without changes after which all sessions have announced their entities [s]: sessions on one
computer find each other within 0.1 s."""


_PAUSE = 0.01
"""Least time between two evaluations of the graph [s]: a robot that starts changes it thousands of
times."""


class Graph:
    """The graph of a domain, kept up to date once it is first used.

    Args:
        session: Zenoh session to observe the graph with.
        domain: The domain.
        warning_log: Receives tokens that cannot be parsed.
    """

    def __init__(self, session: zenoh.Session, domain: int, warning_log: WarningLog) -> None:
        self._session, self._warning_log = session, warning_log
        self._keys = f"{GRAPH}/{domain}/**"
        # By token: its entity, the token itself until it is parsed, or None if that failed.
        self._tokens: dict[str, Entity | str | None] = {}
        self._lock = threading.Lock()
        self._subscriber: zenoh.Subscriber[None] | None = None
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()
        self._due = False

    def _start(self) -> None:
        if self._subscriber is None:
            liveliness = self._session.liveliness()
            # The history brings the tokens that were declared before this.
            self._subscriber = liveliness.declare_subscriber(
                self._keys, direct(self._on_sample), history=True
            )

    def _on_sample(self, sample: zenoh.Sample) -> None:
        # Runs in a thread of Zenoh: parsing is left to `entities`.
        key = str(sample.key_expr)
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._tokens.pop(key, None)
            # `ready` delivers tokens again, and the earlier ones may already be parsed.
            elif key not in self._tokens:
                if len(self._tokens) >= MOST or len(key) > LONGEST_TOKEN:
                    self._warning_log.tell("entities of the ROS graph are left out", "too many")
                    return
                self._tokens[key] = key
            wake, self._due = not self._due, True
        if wake:
            with contextlib.suppress(RuntimeError):  # raised once the event loop is closed
                self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        with self._lock:
            self._due = False
        # Replaced rather than cleared, since waiting tasks hold the old event.
        self._changed.set()
        self._changed = asyncio.Event()

    def entities(self) -> list[Entity]:
        """Return all known entities; see `ready`."""
        self._start()
        with self._lock:
            tokens = list(self._tokens.items())
        entities: list[Entity] = []
        for key, entity in tokens:
            if isinstance(entity, str):
                # Without the lock, for which Zenoh's threads wait: parsing takes longer than a
                # copy.
                entity = parse_token(key)
                if entity is None:
                    self._warning_log.tell("a token of the ROS graph is not understood", key[:200])
                with self._lock:
                    # The entity may have left the graph during the parsing.
                    if key in self._tokens:
                        self._tokens[key] = entity
            if entity is not None:
                entities.append(entity)
        return entities

    def nodes(self) -> list[Entity]:
        """Return the nodes."""
        return self.of(Kind.NODE)

    def of(self, kind: Kind, name: str | None = None, type_: str | None = None) -> list[Entity]:
        """Return the entities of a kind.

        Args:
            kind: Publishers, subscriptions, services or clients.
            name: Fully qualified name of the topic or service; all unless given.
            type_: Full name of the type; all unless given.
        """
        return [
            entity
            for entity in self.entities()
            if entity.kind is kind and name in (None, entity.topic) and type_ in (None, entity.type)
        ]

    async def ready(self) -> None:
        """Wait until all reachable sessions have announced their entities, about 6 s at most."""
        self._start()
        answered = asyncio.Event()

        def ended() -> None:
            with contextlib.suppress(RuntimeError):  # raised once the event loop is closed
                self._loop.call_soon_threadsafe(answered.set)

        def reply(answer: zenoh.Reply) -> None:
            if answer.ok is not None:
                self._on_sample(answer.ok)

        self._session.liveliness().get(self._keys, direct(reply, ended), timeout=_SETTLE)
        with anyio.move_on_after(_SETTLE + 1):
            await answered.wait()
        # The router does not speak for other peers, which announce themselves once connected.
        with anyio.move_on_after(_SETTLE):
            changing = True
            while changing:
                changed = self._changed
                with anyio.move_on_after(_QUIET) as quiet:
                    await changed.wait()
                changing = not quiet.cancelled_caught

    async def wait_until(self, holds: Callable[[], bool]) -> None:
        """Wait until a condition on the graph holds; evaluate it after each change."""
        self._start()
        while True:
            # Taken before the evaluation, so that no change in between is missed.
            changed = self._changed
            if holds():
                return
            await changed.wait()
            await anyio.sleep(_PAUSE)

    def close(self) -> None:
        """Stop observing the graph."""
        if self._subscriber is not None:
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]
            self._subscriber = None


log = logging.getLogger(__name__)


class Participant:
    """A session in a domain, with the objects that its nodes share.

    Must be made in the event loop's thread.

    Args:
        distro: The distribution of ROS 2.

    Attributes:
        session: The session.
        domain: The domain.
        zid: Identifier of the session.
        interfaces: The interfaces of the distribution.
        graph: The ROS graph.
        warning_log: Problems with the messages of others.
    """

    def __init__(self, session: zenoh.Session, domain: int, distro: str) -> None:
        self.session, self.domain, self.zid = session, domain, str(session.zid())
        self.interfaces = interfaces(distro)
        self.warning_log = WarningLog(log)
        self.graph = Graph(session, domain, self.warning_log)
        self._ids = itertools.count()
        self._tasks: set[asyncio.Task[None]] = set()
        self._closed = False

    def next_id(self) -> int:
        """Return the number of the next entity of the session."""
        return next(self._ids)

    def start(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine until it or the context ends."""
        if self._closed:
            # Otherwise Python would warn of a coroutine that was never awaited.
            work.close()
            return
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # the event loop itself keeps only a weak reference
        task.add_done_callback(self._tasks.discard)

    async def close(self) -> None:
        """Cancel all tasks and stop observing the graph."""
        self._closed = True
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.graph.close()
