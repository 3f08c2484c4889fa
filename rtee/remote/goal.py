"""The goals of a client: send them to the hand, and follow them to their results."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Final, Literal, Unpack

import anyio

from rtee.actions.types import ActionReference
from rtee.errors import (
    GoalRejected,
    NoHand,
    RemoteError,
    RequestRejected,
    RteeError,
    TooManyRequests,
)
from rtee.messages import FEEDBACK, RESULT, topics
from rtee.messages.goals import GOAL, with_new_id
from rtee.remote.goal_values import (
    GoalOptions,
    GraspOptions,
    TouchOptions,
    complete,
    goal_by,
    grasp_goal,
    opening_goal,
    share_of,
    shares,
    spelled_out,
    touch_goal,
)
from rtee.remote.hand_info import HandInfo
from rtee.remote.link import ANSWER_WITHIN, Link
from rtee.types import Feedback, Goal, Result, new_goal_id

_SILENT = 0.5
"""Time without a message about an accepted goal after which the client asks for its result [s]:
feedback comes 50 times a second unless configured otherwise."""

_ASK_WITHIN = 2.0
"""Time to wait for the answer to such a question [s]: a hand on a busy computer answers within a
few tenths."""

_ASKED_FOR = ANSWER_WITHIN
"""Time without an answer to such questions after which the hand counts as lost [s]."""

_CANCEL_AGAIN = 0.1
"""Time until a cancellation that got no answer is repeated [s]: one that Zenoh cannot send fails at
once."""

_CANCEL_FOR = 60.0
"""Time for which cancellations are repeated [s]: after a longer silence, the hand has lost this
client and reacts as configured."""


def check_follower(on_feedback: object) -> None:
    """Raise `GoalRejected` unless feedback can be given to a function, or there is ``None``."""
    # What an async function returns would never be awaited.
    if on_feedback is not None and (
        not callable(on_feedback) or inspect.iscoroutinefunction(on_feedback)
    ):
        raise GoalRejected(
            f"on_feedback must be a function, without async, not {on_feedback!r:.100}"
        )


class RunningGoal:
    """A goal that the hand has accepted.

    ``async for feedback in running`` ends with the goal; ``await running.result()`` returns its
    result.

    Args:
        cancel: Requests the hand to cancel the goal.

    Attributes:
        goal: The goal.
        heard: Time of the hand's last message about the goal, by the event loop's clock [s];
            ``inf``: before it is accepted.
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
        check_follower(on_feedback)
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
    """The running goals of a client, by their identifiers; delivers their feedback and results.

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
        """Deliver messages to a goal from now on; return it."""
        self._running[running.goal.goal_id] = running
        return running

    def discard(self, goal_id: str) -> None:
        """Deliver no more messages to a goal, such as one that was refused."""
        self._running.pop(goal_id, None)

    def watch(self, running: RunningGoal) -> None:
        """Ask for the result of an accepted goal if no message about it arrives."""
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
        """Ask for the results of goals that have been silent for a while; ends with the goals.

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
        except RteeError:  # refused, as too many requests are: the goal may run
            status = True
        if status is None:
            text = f"the hand '{self._link.hand}' does not know the goal any more"
            self._end(goal_id, RequestRejected(text))
        elif isinstance(status, Result):
            self._end(goal_id, status)
        else:
            running.heard = self._loop.time()

    async def _status(self, goal_id: str) -> Result | Literal[True] | None:
        """Return a goal's result, ``True`` while it runs, ``None`` if the hand has no such goal."""
        fields = {"goal_id": goal_id, "client": self._link.client}
        status = await self._link.ask("goal", fields, within=_ASK_WITHIN)
        if status["result"]:
            return RESULT.of(status["result"][0])
        return True if status["running"] else None

    async def check_taken(self, goal_id: str) -> None:
        """Raise `RemoteError` unless the hand knows the goal; its answer was lost."""
        try:
            if await self._status(goal_id) is not None:
                return
        except RteeError:
            self._cancel(goal_id)
            raise
        self._cancel(goal_id)  # it may still be in transit
        raise TooManyRequests(
            f"the hand '{self._link.hand}' has not accepted the goal; it may have received too "
            "many requests"
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


_ACCEPTED_WITHIN = ANSWER_WITHIN - 1.0
"""Time to wait for the answer to a goal before asking whether it runs [s]: both together take at
most a second longer than any other request."""


_MOST_PREPARED: Final = 64
"""Most goals that a client keeps ready to be sent again: a program repeats fewer."""


class GoalClient:
    """Sends goals to the hand, and delivers feedback and results to the running ones.

    Args:
        link: The connection to the hand.
        info: Returns the hand's description, for the effort limits of its actuators.
    """

    def __init__(self, link: Link, info: Callable[[], Awaitable[HandInfo]]) -> None:
        self._link, self._info = link, info
        self._running = RunningGoals(link)
        self._efforts: dict[str, float] | None = None
        self._prepared = lru_cache(_MOST_PREPARED)(self._prepare)

    @spelled_out
    async def start(
        self, action: ActionReference | str, *elements: str, **options: Unpack[GoalOptions]
    ) -> RunningGoal:
        """Begin an action and return at once; a running goal of this client is pre-empted.

        Args:
            action: Its name, in which case and underscores do not matter; or the name with elements
                and scale, such as ``trig:ring*0.8``.
            elements: Fingers or actuator of a primitive, in any order.
            options: See below.

        Raises:
            GoalRejected: if an option cannot be used, or the hand refuses the goal, with the
                reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        share = share_of(options.get("effort"))
        if share is not None:
            options["effort"] = await self.effort_limits(share)
        # Most programs repeat goals, and code that has rested for a tenth of a second is slow.
        try:
            goal, question = self._prepared(action, elements, **options)
        except TypeError:  # an option without a hash, such as efforts by actuator
            goal, question = self._prepare(action, elements, **options)
        goal_id = new_goal_id()
        return await self._send(goal, with_new_id(question, goal_id), goal_id)

    def _prepare(
        self,
        action: ActionReference | str,
        elements: tuple[str, ...],
        /,
        **options: Unpack[GoalOptions],
    ) -> tuple[Goal, bytes]:
        """Return a goal of this client, and its message."""
        goal = goal_by(action, elements, options, self._link.client)
        return goal, GOAL.encode(goal)

    async def start_goal(self, goal: Goal) -> RunningGoal:
        """Begin a complete goal and return at once; raises the same errors as `start`.

        Args:
            goal: The goal; its client is replaced by this one.
        """
        if complete(goal).client != self._link.client:
            goal = replace(goal, client=self._link.client)
        if goal.goal_id in self._running:
            raise GoalRejected(f"a goal '{goal.goal_id}' of this client is running already")
        return await self._send(goal, GOAL.encode(goal), goal.goal_id)

    async def _send(self, goal: Goal, question: bytes, goal_id: str) -> RunningGoal:
        """Begin a goal by its message, in which it has this identifier."""
        # Sent before anything else is prepared: the answer arrives through this event loop, and so
        # not before the goal is registered.
        answer = self._link.send("do", question, within=_ACCEPTED_WITHIN)
        if goal_id != goal.goal_id:
            goal = replace(goal, goal_id=goal_id)
        running = self._running.add(RunningGoal(goal, partial(self.cancel, goal.goal_id)))
        try:
            try:
                await asyncio.shield(answer)
            except NoHand:
                # The answer may be lost although the goal runs.
                if self._link.gone:
                    raise
                await self._running.check_taken(goal.goal_id)
        except anyio.get_cancelled_exc_class():
            # The goal was sent, and the caller has given it up, so it is cancelled here. The answer
            # comes first, since a goal that has not arrived cannot be cancelled.
            with anyio.CancelScope(shield=True), contextlib.suppress(RemoteError):
                with contextlib.suppress(NoHand):
                    await answer
                await self._running.give_up(goal.goal_id)
            self._running.discard(goal.goal_id)
            raise
        # A refused goal must not stay registered.
        except BaseException:
            self._running.discard(goal.goal_id)
            raise
        self._running.watch(running)
        return running

    @spelled_out
    async def do(
        self,
        action: ActionReference | str,
        *elements: str,
        on_feedback: Callable[[Feedback], object] | None = None,
        **options: Unpack[GoalOptions],
    ) -> Result:
        """Execute an action and wait for its result; cancelling the call cancels the goal.

        Args:
            action: Its name, in which case and underscores do not matter; or the name with elements
                and scale, such as ``trig:ring*0.8``.
            elements: Fingers or actuator of a primitive, in any order.
            on_feedback: Called with the feedback until the goal ends; an error in it cancels the
                goal.
            options: See below.

        Raises:
            GoalRejected: if an option cannot be used, or the hand refuses the goal, with the
                reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        return await self._followed(partial(self.start, action, *elements, **options), on_feedback)

    async def _followed(
        self,
        start: Callable[[], Awaitable[RunningGoal]],
        on_feedback: Callable[[Feedback], object] | None,
    ) -> Result:
        """Start a goal and return its result.

        Cancelling this, or an error of ``on_feedback``, cancels the goal.
        """
        check_follower(on_feedback)  # before anything moves
        running = await start()
        try:
            return await running.result(on_feedback)
        except BaseException:
            if not running.done:
                # Shielded, or the cancelled scope would cancel this request, too.
                with anyio.CancelScope(shield=True):
                    await self._running.give_up(running.goal.goal_id)
            raise

    async def open(
        self,
        *,
        speed: float | str = 1.0,
        effort: Mapping[str, float] | float | str | None = None,
        on_feedback: Callable[[Feedback], object] | None = None,
    ) -> Result:
        """Go to the rest posture, or do the hand's action "open", and wait for the result.

        Args:
            speed: Share of the velocity limits, above 0 up to 1; as for `do`.
            effort: Effort limits, as for `do`.
            on_feedback: Called with the feedback until the goal ends.

        Raises:
            GoalRejected: if a value cannot be used, or the hand refuses the goal, with the reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        return await self.do("open", speed=speed, effort=effort, on_feedback=on_feedback)

    async def move_opening(
        self,
        opening: float | str,
        *,
        fingers: Sequence[str] | None = None,
        tip_speed: float | str | None = None,
        on_feedback: Callable[[Feedback], object] | None = None,
    ) -> Result:
        """Open or close the fingertips to an opening and wait for the result.

        Args:
            opening: The opening [m]; or a string such as ``40mm``.
            fingers: The fingers that open or close; by default those of the hand's best action for
                that opening.
            tip_speed: Speed at which the opening changes [m/s]; by default as fast as the hand can.
            on_feedback: Called with the feedback until the goal ends.

        Raises:
            GoalRejected: if a value cannot be used, or the hand refuses the goal, with the reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        goal = opening_goal(opening, fingers, tip_speed)
        return await self._followed(partial(self.start_goal, goal), on_feedback)

    @spelled_out
    async def grasp(
        self,
        width: float | str,
        *,
        on_feedback: Callable[[Feedback], object] | None = None,
        **options: Unpack[GraspOptions],
    ) -> Result:
        """Grasp an object of a width and hold it with a force; wait for the result.

        The hand opens to the width plus a margin, closes until the fingertips meet the object,
        builds up the force and keeps it. ``result.within`` says whether an object is held at a
        width from ``width - width_tolerance[0]`` to ``width + width_tolerance[1]``, as libfranka
        defines *grasped*; ``result.opening`` is that width, ``result.force`` the estimated force
        with the error ``result.force_error``; ``result.action`` and ``result.elements`` are what it
        closed with.

        Args:
            width: Width of the object [m]; or a string such as ``30mm``.
            on_feedback: Called with the feedback until the goal ends.
            options: See below.

        Raises:
            GoalRejected: if a value cannot be used, or the hand refuses the goal, with the reason
                and the nearest possible value.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        goal = grasp_goal(width, **options)
        return await self._followed(partial(self.start_goal, goal), on_feedback)

    @spelled_out
    async def touch(
        self,
        *,
        on_feedback: Callable[[Feedback], object] | None = None,
        **options: Unpack[TouchOptions],
    ) -> Result:
        """Close slowly until a finger touches something, stop there, and wait for the result.

        ``result.touched`` names the fingers that touch; it is empty if the hand closed without a
        contact. ``result.opening`` is the opening of the fingertips there, where it is known.

        Args:
            on_feedback: Called with the feedback until the goal ends.
            options: See below.

        Raises:
            GoalRejected: if a value cannot be used, or the hand refuses the goal, with the reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        goal = touch_goal(**options)
        return await self._followed(partial(self.start_goal, goal), on_feedback)

    async def cancel(self, goal_id: str = "") -> None:
        """Cancel a goal, by default the running one: the hand brakes and holds its posture."""
        await self._link.ask("cancel", {"goal_id": goal_id, "client": self._link.client})

    async def effort_limits(
        self,
        share: float | str,
        only: Collection[str] | None = None,
        *,
        besides: Collection[str] = (),
    ) -> dict[str, float]:
        """Return a share of the effort limits of actuators [N·m | N], for the option ``effort``.

        Args:
            share: The share, above 0 up to 1; or a text such as ``40%``.
            only: The actuators; ``None`` for all.
            besides: Actuators to leave out.

        Raises:
            GoalRejected: if the share is out of range, or an actuator is unknown or has no effort
                limit.
        """
        if self._efforts is None:  # cached: they do not change while the hand runs
            self._efforts = {a.name: a.effort for a in (await self._info()).actuators}
        return shares(self._efforts, share, only, besides)
