"""A goal that runs, as a client sees it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable

from rtee.types import Feedback, Goal, Result


class RunningGoal:
    """A goal that was taken.

    ``async for feedback in running`` ends with the goal; ``await running.result()`` tells how.

    Args:
        goal: The goal.
        cancel: Asks the hand to cancel it.

    Attributes:
        goal: The goal.
    """

    def __init__(self, goal: Goal, cancel: Callable[[], Awaitable[None]]) -> None:
        self.goal = goal
        self._cancel = cancel
        self._feedback: asyncio.Queue[Feedback | None] = asyncio.Queue()
        self._result: asyncio.Future[Result] = asyncio.get_running_loop().create_future()
        # Nobody need ask for the result of a goal whose hand has gone.
        self._result.add_done_callback(lambda done: done.cancelled() or done.exception())

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self._result.done()

    def __aiter__(self) -> AsyncIterator[Feedback]:
        """Iterate over its feedback until it has ended."""
        return self._iterate()

    async def _iterate(self) -> AsyncIterator[Feedback]:
        while (feedback := await self._feedback.get()) is not None:
            yield feedback
        self._feedback.put_nowait(None)

    async def result(self, on_feedback: Callable[[Feedback], object] | None = None) -> Result:
        """Wait until it has ended.

        Args:
            on_feedback: Called with its feedback meanwhile.

        Raises:
            NoHand: if the hand has gone.
        """
        if on_feedback is not None:
            async for feedback in self:
                on_feedback(feedback)
        return await asyncio.shield(self._result)

    async def cancel(self) -> None:
        """Cancel it: the hand brakes and holds; the result says so. Once it has ended: nothing."""
        if not self.done:
            await self._cancel()

    def deliver(self, what: Feedback | Result | Exception) -> None:
        """Take what came from the hand."""
        if isinstance(what, Feedback):
            self._feedback.put_nowait(what)
            return
        if not self._result.done():
            if isinstance(what, Result):
                self._result.set_result(what)
            else:
                self._result.set_exception(what)
        self._feedback.put_nowait(None)
