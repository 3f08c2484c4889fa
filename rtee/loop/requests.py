"""Requests to a device's task: done between two exchanges, one after the other."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from rtee.errors import RteeError


@dataclass(slots=True)
class _Request:
    name: str
    action: Callable[[], Awaitable[Any]]
    answer: asyncio.Future[Any]


class Requests:
    """What others ask of a device, and the bell that wakes its task.

    Attributes:
        wake: Set whenever there is something to do.
    """

    def __init__(self) -> None:
        self.wake = asyncio.Event()
        self._waiting: deque[_Request] = deque()
        self._closed: Exception | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    async def ask(
        self, name: str, action: Callable[[], Awaitable[Any]], *, first: bool = False
    ) -> Any:
        """Have the device's task do something; return or raise what it does.

        Args:
            name: What it is, for messages.
            action: What to do.
            first: Do it before what is waiting already.
        """
        if self._closed is not None:
            raise self._closed
        request = _Request(name, action, asyncio.get_running_loop().create_future())
        if first:
            self._waiting.appendleft(request)
        else:
            self._waiting.append(request)
        self.wake.set()
        return await request.answer

    async def serve(self) -> None:
        """Do what is waiting; an action's exception goes to who asked."""
        while self._waiting:
            request = self._waiting.popleft()
            if request.answer.cancelled():
                continue
            try:
                result = await request.action()
            except asyncio.CancelledError:
                if not request.answer.done():
                    request.answer.set_exception(RteeError(f"'{request.name}' was interrupted"))
                raise
            except Exception as error:
                if not request.answer.done():
                    request.answer.set_exception(error)
            else:
                if not request.answer.done():
                    request.answer.set_result(result)

    def refuse(self, error: Exception) -> None:
        """Answer everything that waits or will ever be asked with an error."""
        self._closed = error
        while self._waiting:
            request = self._waiting.popleft()
            if not request.answer.done():
                request.answer.set_exception(error)
