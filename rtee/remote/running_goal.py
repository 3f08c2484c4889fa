"""The running goals of a client: their feedback and results, and recovery of missed ones."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Literal

from rtee.errors import NoHand, RemoteError, RequestRejected, RteeError, TooManyRequests
from rtee.messages import FEEDBACK, RESULT, topics
from rtee.remote.link import ANSWER_WITHIN, Link
from rtee.types import Feedback, Goal, Result

_SILENT = 0.5
"""Time without a message about an accepted goal after which the client asks for its result [s]:
feedback comes 50 times a second unless configured otherwise."""

_ASK_WITHIN = 2.0
"""Time to wait for the answer to such a question [s]: a hand on a busy computer answers within
some tenths."""

_ASKED_FOR = ANSWER_WITHIN
"""Time without an answer to such questions after which the hand counts as lost [s]."""

_CANCEL_AGAIN = 0.1
"""Time until a cancellation that got no answer is repeated [s]: one that Zenoh cannot send fails at
once."""

_CANCEL_FOR = 60.0
"""Time for which cancellations are repeated [s]: a hand that is silent for longer has lost this
client, and does what is configured for that."""


class RunningGoal:
    """A goal that the hand has accepted.

    ``async for feedback in running`` ends with the goal; ``await running.result()`` returns its
    result.

    Args:
        cancel: Requests the hand to cancel the goal.

    Attributes:
        goal: The goal.
        heard: When the hand was last heard of it, by the event loop's clock [s]; ``inf``: before
            it is accepted.
    """

    def __init__(self, goal: Goal, cancel: Callable[[], Awaitable[None]]) -> None:
        self.goal = goal
        self._cancel = cancel
        self._feedback: asyncio.Queue[Feedback | None] = asyncio.Queue()
        self.heard = math.inf
        self._result: asyncio.Future[Result] = asyncio.get_running_loop().create_future()
        # Without this, asyncio would log an unretrieved error when the hand has gone.
        self._result.add_done_callback(lambda done: done.cancelled() or done.exception())

    @property
    def done(self) -> bool:
        """Whether the goal has ended."""
        return self._result.done()

    def __aiter__(self) -> AsyncIterator[Feedback]:
        """Iterate over the feedback until the goal has ended."""
        return self._iterate()

    async def _iterate(self) -> AsyncIterator[Feedback]:
        while (feedback := await self._feedback.get()) is not None:
            yield feedback
        self._feedback.put_nowait(None)  # for the next iterator

    async def result(self, on_feedback: Callable[[Feedback], object] | None = None) -> Result:
        """Wait until the goal has ended, and return its result.

        Args:
            on_feedback: Called with the feedback until the goal ends.

        Raises:
            NoHand: if the hand has gone.
        """
        if on_feedback is not None:
            async for feedback in self:
                on_feedback(feedback)
        # Cancelling one waiting task must not cancel the result for the others.
        return await asyncio.shield(self._result)

    async def cancel(self) -> None:
        """Cancel the goal: the hand brakes and holds, and the result says so.

        Does nothing once the goal has ended.
        """
        if not self.done:
            await self._cancel()

    def deliver(self, what: Feedback | Result | Exception) -> None:
        """Deliver feedback, the result, or the error that ends the goal."""
        if isinstance(what, Feedback):
            self._feedback.put_nowait(what)
            return
        if not self._result.done():
            if isinstance(what, Result):
                self._result.set_result(what)
            else:
                self._result.set_exception(what)
        self._feedback.put_nowait(None)


class RunningGoals:
    """The running goals of a client, by their identifiers; delivers what the hand says of them.

    Args:
        link: The connection to the hand.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._running: dict[str, RunningGoal] = {}
        self._loop = asyncio.get_running_loop()
        self._watch: asyncio.Task[None] | None = None
        self._cancelling: set[asyncio.Task[None]] = set()
        link.subscribe(topics.FEEDBACK, self._on_feedback)
        link.subscribe(topics.RESULTS, self._on_result)
        link.on_gone(self._on_gone)

    def __contains__(self, goal_id: str) -> bool:
        """Return whether a goal runs."""
        return goal_id in self._running

    def add(self, running: RunningGoal) -> RunningGoal:
        """Deliver to a goal from now on; return it."""
        self._running[running.goal.goal_id] = running
        return running

    def discard(self, goal_id: str) -> None:
        """Deliver nothing more to a goal, such as one that was refused."""
        self._running.pop(goal_id, None)

    def watch(self, running: RunningGoal) -> None:
        """Ask for the result of an accepted goal if nothing is heard of it."""
        running.heard = self._loop.time()
        if self._watch is None or self._watch.done():
            self._watch = self._loop.create_task(self._watch_silent())

    def _on_feedback(self, data: bytes) -> None:
        if self._running:  # without goals of this client, messages need not be decoded
            feedback = FEEDBACK.decode(data)
            running = self._running.get(feedback.goal_id)
            if running is not None:
                running.heard = self._loop.time()
                running.deliver(feedback)

    def _on_result(self, data: bytes) -> None:
        if self._running:
            result = RESULT.decode(data)
            self._end(result.goal_id, result)

    def _end(self, goal_id: str, how: Result | Exception) -> None:
        running = self._running.pop(goal_id, None)
        if running is not None:
            running.deliver(how)

    def _on_gone(self) -> None:
        if self._watch is not None:
            self._watch.cancel()
        for goal_id in tuple(self._running):
            self._end(goal_id, self._link.lost())

    async def _watch_silent(self) -> None:
        """Ask for the results of goals of which nothing was heard for a while; ends with them.

        A result is published once, and may be lost if the connection is congested.
        """
        while self._running:
            await asyncio.sleep(_SILENT / 2.0)
            since = self._loop.time() - _SILENT
            silent = [item for item in self._running.items() if item[1].heard < since]
            await asyncio.gather(*(self._ask_for(*item) for item in silent))

    async def _ask_for(self, goal_id: str, running: RunningGoal) -> None:
        try:
            status = await self._status(goal_id)
        except NoHand as error:
            if self._loop.time() - running.heard > _ASKED_FOR:
                self._end(goal_id, error)
                self._cancel(goal_id)
            return
        # A hand of an earlier version does not know the request, but publishes the result.
        except RteeError:
            status = True
        if status is None:
            text = f"the hand '{self._link.hand}' does not know the goal any more"
            self._end(goal_id, RequestRejected(text))
        elif isinstance(status, Result):
            self._end(goal_id, status)
        else:
            running.heard = self._loop.time()

    async def _status(self, goal_id: str) -> Result | Literal[True] | None:
        """Return the result of a goal, ``True`` if it runs, ``None`` if the hand knows neither."""
        fields = {"goal_id": goal_id, "client": self._link.client}
        status = await self._link.ask("goal", fields, within=_ASK_WITHIN)
        if status["result"]:
            return RESULT.of(status["result"][0])
        return True if status["running"] else None

    async def check_taken(self, goal_id: str) -> None:
        """Raise `RemoteError` unless the hand knows the goal, whose answer was lost."""
        try:
            if await self._status(goal_id) is not None:
                return
        except RteeError:
            self._cancel(goal_id)
            raise
        self._cancel(goal_id)  # it may still be in transit
        raise TooManyRequests(
            f"the hand '{self._link.hand}' has not taken the goal; too many requests may have come"
        )

    async def give_up(self, goal_id: str) -> None:
        """Cancel a goal whose caller no longer waits.

        Returns once the hand has confirmed that, or after `ANSWER_WITHIN`; then goes on in the
        background.
        """
        await asyncio.wait({self._cancel(goal_id)}, timeout=ANSWER_WITHIN)

    def _cancel(self, goal_id: str) -> asyncio.Task[None]:
        """Cancel a goal until the hand has confirmed or refused that, or the link is lost."""
        fields = {"goal_id": goal_id, "client": self._link.client}
        until = self._loop.time() + _CANCEL_FOR

        async def cancel() -> None:
            while not self._link.gone and self._loop.time() < until:
                try:
                    await self._link.ask("cancel", fields, within=_ASK_WITHIN)
                except (NoHand, TooManyRequests):
                    await asyncio.sleep(_CANCEL_AGAIN)
                except RemoteError:  # such as another client's lease, which has ended the goal
                    return
                else:
                    return

        task = self._loop.create_task(cancel())
        self._cancelling.add(task)  # the event loop itself keeps only a weak reference
        task.add_done_callback(self._cancelling.discard)
        return task
