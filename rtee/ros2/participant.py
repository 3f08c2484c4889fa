"""A program's session in a ROS 2 domain, shared by its publishers, subscriptions and services."""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Coroutine
from typing import Any

import zenoh

from rtee.ros2.graph import Graph
from rtee.ros2.inbox import WarningLog
from rtee.ros2.types import interfaces

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
            # Or Python would warn of a coroutine that was never awaited.
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
