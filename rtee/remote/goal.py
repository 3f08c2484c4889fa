"""The goals of a client: send them to the hand, and follow them to their results."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypedDict, Unpack

import anyio

from rtee.errors import (
    GoalRejected,
    NoHand,
    RemoteError,
    RequestRejected,
    RteeError,
    TooManyRequests,
    suggestion,
)
from rtee.messages import decode_feedback, decode_result, encode_goal, topics
from rtee.messages.convert import RESULT
from rtee.remote.goal_values import QUANTITIES, check_types, reactions
from rtee.remote.link import ANSWER_WITHIN, Link
from rtee.remote.planner import HandInfo
from rtee.types import Feedback, Goal, OnContact, Result, Stage
from rtee.units import FORCE, LENGTH, SPEED, quantity

_SILENT = 0.5
"""Time without a message about an accepted goal after which the client asks for its result [s]:
feedback comes 50 times a second unless configured otherwise."""

_ACCEPTED_WITHIN = ANSWER_WITHIN - 1.0
"""Time to wait for the answer to a goal before asking whether it runs [s]: both together take at
most a second longer than any other request."""

_ASK_WITHIN = 2.0
"""Time to wait for the answer to such a question [s]: a hand on a busy computer answers within
some tenths."""

_ASKED_FOR = ANSWER_WITHIN
"""Time without an answer to such questions after which the hand counts as lost [s]."""

OnContactWords = Mapping[str, OnContact | str] | OnContact | str
"""One reaction for all fingers, or reactions by finger, "" for all others."""


class GoalOptions(TypedDict, total=False):
    """Options of a goal.

    Attributes:
        intensity: 0 (rest) to 1 (the action's posture); 1 by default.
        effort: Effort limit by actuator [N·m | N]; or one number, above 0 up to 1, as a share of
            the limit of every actuator.
        tolerance: Norm of the error at which the goal counts as reached; 0.01 by default.
        speed: Scale of the velocity limits, above 0 up to 1; 1 by default.
        timeout: Longest time the goal may take [s]; by default as configured for the hand.
        stage: Stage of a pinch: ``both``, ``pre_grasp`` or ``grasp``; both by default.
        kind: Kind of the action, where its name is ambiguous.
        opening: Target opening of the fingertips, instead of an intensity [m].
        force: Force between the fingertips, with an opening [N].
        tip_speed: Speed at which the opening changes, instead of ``speed`` [m/s].
        on_contact: Reaction of fingers to a contact: ``stop``, ``hold`` or ``squeeze``; or
            reactions by finger, "" for all others. By default as configured for the hand.
        max_force: Force up to which slips raise ``force`` [N].
    """

    intensity: float
    effort: Mapping[str, float] | float
    tolerance: float
    speed: float
    timeout: float | None
    stage: Stage | str
    kind: str | None
    opening: float | str
    force: float | str
    tip_speed: float | str
    on_contact: OnContactWords
    max_force: float | str


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
            on_feedback: Called with the feedback meanwhile.

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


class GoalClient:
    """Sends goals to the hand, and delivers feedback and results to the running ones.

    Args:
        link: The connection to the hand.
        info: Returns the hand's description, for the effort limits of its actuators.
    """

    def __init__(self, link: Link, info: Callable[[], Awaitable[HandInfo]]) -> None:
        self._link, self._info = link, info
        self._running: dict[str, RunningGoal] = {}
        self._efforts: dict[str, float] | None = None
        self._loop = asyncio.get_running_loop()
        self._watch: asyncio.Task[None] | None = None
        self._cancelling: set[asyncio.Task[None]] = set()
        link.subscribe(topics.FEEDBACK, self._on_feedback)
        link.subscribe(topics.RESULTS, self._on_result)
        link.on_gone(self._on_gone)

    def _on_feedback(self, data: bytes) -> None:
        if self._running:  # without goals of this client, messages need not be decoded
            feedback = decode_feedback(data)
            running = self._running.get(feedback.goal_id)
            if running is not None:
                running.heard = self._loop.time()
                running.deliver(feedback)

    def _on_result(self, data: bytes) -> None:
        if self._running:
            result = decode_result(data)
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
                self._give_up(goal_id)
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

    async def _status(self, goal_id: str) -> Result | bool | None:
        """Return the result of a goal, ``True`` if it runs, ``None`` if the hand knows neither."""
        fields = {"goal_id": goal_id, "client": self._link.client}
        status = await self._link.ask("goal", fields, within=_ASK_WITHIN)
        if status["result"]:
            return RESULT.of(status["result"][0])
        return True if status["running"] else None

    async def _check_taken(self, goal_id: str) -> None:
        """Raise `RemoteError` unless the hand knows a goal whose answer has not arrived."""
        try:
            if await self._status(goal_id) is not None:
                return
        except RteeError:
            self._give_up(goal_id)
            raise
        raise TooManyRequests(
            f"the hand '{self._link.hand}' has not taken the goal; too many requests may have come"
        )

    def _give_up(self, goal_id: str) -> None:
        """Cancel a goal for which nobody waits any more, if the hand still hears it."""

        async def cancel() -> None:
            with contextlib.suppress(RemoteError):
                await self.cancel(goal_id)

        task = self._loop.create_task(cancel())
        self._cancelling.add(task)  # the event loop itself keeps only a weak reference
        task.add_done_callback(self._cancelling.discard)

    async def start(
        self, action: str, *elements: str, **options: Unpack[GoalOptions]
    ) -> RunningGoal:
        """Begin an action and return at once; a running goal of this client is pre-empted.

        Args:
            action: Its name; case and underscores do not matter.
            elements: Fingers or actuator of a primitive, in any order.
            options: See `GoalOptions`.

        Raises:
            RequestRejected: if the hand refuses the goal, with the reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        check_types(action, elements, options, GoalOptions.__annotations__)
        effort = options.get("effort")
        if isinstance(effort, float | int):
            options["effort"] = await self.effort_limits(effort)
        return await self.start_goal(_goal(action, elements, self._link.client, options))

    async def start_goal(self, goal: Goal) -> RunningGoal:
        """Begin a complete goal and return at once; raises the same errors as `start`.

        Args:
            goal: The goal; its client is replaced by this one.
        """
        goal = replace(goal, client=self._link.client)
        # Sent before anything else is prepared: the answer arrives through this event loop, and so
        # not before the goal is registered.
        if goal.goal_id in self._running:
            raise GoalRejected(f"a goal '{goal.goal_id}' of this client runs already")
        answer = self._link.send("do", encode_goal(goal), within=_ACCEPTED_WITHIN)
        running = self._running[goal.goal_id] = RunningGoal(
            goal, partial(self.cancel, goal.goal_id)
        )
        try:
            try:
                await asyncio.shield(answer)
            except NoHand:
                # The answer may be lost, and the goal run.
                if self._link.gone:
                    raise
                await self._check_taken(goal.goal_id)
        except anyio.get_cancelled_exc_class():
            # The goal was sent, and the caller has given it up, so it is cancelled here. The answer
            # comes first, since a goal that has not arrived cannot be cancelled.
            with anyio.CancelScope(shield=True), contextlib.suppress(RemoteError):
                with contextlib.suppress(NoHand):
                    await answer
                await running.cancel()
            self._running.pop(goal.goal_id, None)
            raise
        # A refused goal must not stay registered.
        except BaseException:
            self._running.pop(goal.goal_id, None)
            raise
        running.heard = self._loop.time()
        if self._watch is None or self._watch.done():
            self._watch = self._loop.create_task(self._watch_silent())
        return running

    async def do(
        self,
        action: str,
        *elements: str,
        on_feedback: Callable[[Feedback], object] | None = None,
        **options: Unpack[GoalOptions],
    ) -> Result:
        """Execute an action and wait for its result; cancelling the call cancels the goal.

        Takes the arguments of `start`, and ``on_feedback``, which is called with the feedback
        meanwhile. Raises the same errors; an error of ``on_feedback`` cancels the goal, too.
        """
        running = await self.start(action, *elements, **options)
        return await self._followed(running, on_feedback)

    async def _followed(
        self, running: RunningGoal, on_feedback: Callable[[Feedback], object] | None
    ) -> Result:
        """Return the result; cancelling this, or an error of ``on_feedback``, cancels the goal."""
        try:
            return await running.result(on_feedback)
        except BaseException:
            # Shielded, or the cancelled scope would cancel this request, too.
            with anyio.CancelScope(shield=True), contextlib.suppress(RemoteError):
                await running.cancel()
            raise

    async def open(self, on_feedback: Callable[[Feedback], object] | None = None) -> Result:
        """Go to the rest posture and wait for the result. See `do`."""
        return await self.do("open", on_feedback=on_feedback)

    async def move_opening(
        self,
        opening: float | str,
        fingers: Sequence[str] | None = None,
        *,
        speed: float | str | None = None,
        on_feedback: Callable[[Feedback], object] | None = None,
    ) -> Result:
        """Open or close the fingertips to an opening and wait for the result.

        Args:
            opening: The opening [m]; or a text such as ``40mm``.
            fingers: The fingers that open or close; by default those of the hand's best action for
                that opening.
            speed: Speed at which the opening changes [m/s]; by default as fast as the hand can.
            on_feedback: Called with the feedback meanwhile.

        Raises:
            GoalRejected: if a value is not such a quantity.
            RequestRejected: if the hand refuses the goal, with the reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        options: GoalOptions = {"opening": opening}
        if speed is not None:
            options["tip_speed"] = speed
        return await self.do("", *(fingers or ()), on_feedback=on_feedback, **options)

    async def start_grasp(
        self,
        width: float | str,
        force: float | str | None = None,
        speed: float | str | None = None,
        fingers: Sequence[str] | None = None,
        tolerance: tuple[float | str, float | str] = (0.005, 0.005),
        *,
        action: str = "",
        timeout: float | None = None,
        on_contact: OnContactWords | None = None,
        max_force: float | str | None = None,
    ) -> RunningGoal:
        """Begin to grasp an object and return at once; see `grasp`."""
        inner, outer = tolerance
        goal = Goal(
            action,
            tuple(fingers or ()),
            timeout=timeout,
            client=self._link.client,
            opening=quantity(width, LENGTH, "width"),
            force=None if force is None else quantity(force, FORCE, "force"),
            tip_speed=None if speed is None else quantity(speed, SPEED, "speed"),
            grasp=True,
            narrower=quantity(inner, LENGTH, "tolerance"),
            wider=quantity(outer, LENGTH, "tolerance"),
            on_contact=reactions({} if on_contact is None else on_contact),
            max_force=None if max_force is None else quantity(max_force, FORCE, "largest force"),
        )
        return await self.start_goal(goal)

    async def grasp(
        self,
        width: float | str,
        force: float | str | None = None,
        speed: float | str | None = None,
        fingers: Sequence[str] | None = None,
        tolerance: tuple[float | str, float | str] = (0.005, 0.005),
        *,
        action: str = "",
        timeout: float | None = None,
        on_contact: OnContactWords | None = None,
        max_force: float | str | None = None,
        on_feedback: Callable[[Feedback], object] | None = None,
    ) -> Result:
        """Grasp an object of a width and hold it with a force; wait for the result.

        The hand opens to the width plus a margin, closes until the fingertips meet the object,
        builds up the force and keeps it. ``result.within`` says whether an object is held at a
        width from ``width - tolerance[0]`` to ``width + tolerance[1]``, as libfranka defines
        *grasped*; ``result.opening`` is that width, ``result.force`` the estimated force with the
        error ``result.force_error``.

        Args:
            width: Width of the object [m]; or a text such as ``30mm``.
            force: Force between the fingertips [N]; by default by the effort limits.
            speed: Speed at which the opening changes [m/s]; by default as fast as the hand can.
            fingers: The fingers that hold the object; by default those of the hand's best action
                for that width, as in ``result.action`` and ``result.elements``.
            tolerance: How much narrower and wider than the width the object may be held [m].
            action: The action to close with, instead of the best one.
            timeout: Longest time the goal may take [s]; by default as configured for the hand.
            on_contact: Reaction of fingers to a contact: with ``squeeze`` they wait until enough of
                them touch, so that a light object is not pushed away; see `GoalOptions`.
            max_force: Force up to which slips raise ``force`` [N]; by default they do not.
            on_feedback: Called with the feedback meanwhile.

        Raises:
            GoalRejected: if a value is not such a quantity.
            RequestRejected: if the hand refuses the goal, with the reason and the nearest possible
                value.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        running = await self.start_grasp(
            width,
            force,
            speed,
            fingers,
            tolerance,
            action=action,
            timeout=timeout,
            on_contact=on_contact,
            max_force=max_force,
        )
        return await self._followed(running, on_feedback)

    async def start_touch(
        self,
        fingers: Sequence[str] | None = None,
        *,
        action: str = "",
        speed: float | str | None = None,
        timeout: float | None = None,
    ) -> RunningGoal:
        """Begin to close until a first contact and return at once; see `touch`."""
        goal = Goal(
            action,
            tuple(fingers or ()),
            timeout=timeout,
            client=self._link.client,
            tip_speed=None if speed is None else quantity(speed, SPEED, "speed"),
            touch=True,
        )
        return await self.start_goal(goal)

    async def touch(
        self,
        fingers: Sequence[str] | None = None,
        *,
        action: str = "",
        speed: float | str | None = None,
        timeout: float | None = None,
        on_feedback: Callable[[Feedback], object] | None = None,
    ) -> Result:
        """Close slowly until a finger touches something, stop there, and wait for the result.

        ``result.touched`` names the fingers that touch; it is empty if the hand closed without a
        contact. ``result.opening`` is the opening of the fingertips there, where it is known.

        Args:
            fingers: The fingers to close; by default those of the action with the most fingers.
            action: The action to close with, instead of the fingers' own.
            speed: Speed at which the opening closes [m/s]; 10 mm/s by default.
            timeout: Longest time the goal may take [s]; by default as configured for the hand.
            on_feedback: Called with the feedback meanwhile.

        Raises:
            GoalRejected: if a value is not such a quantity.
            RequestRejected: if the hand refuses the goal, with the reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        running = await self.start_touch(fingers, action=action, speed=speed, timeout=timeout)
        return await self._followed(running, on_feedback)

    async def cancel(self, goal_id: str = "") -> None:
        """Cancel a goal, by default the running one: the hand brakes and holds its posture."""
        await self._link.ask("cancel", {"goal_id": goal_id, "client": self._link.client})

    async def effort_limits(
        self, share: float, only: Collection[str] | None = None, *, besides: Collection[str] = ()
    ) -> dict[str, float]:
        """Return a share of the effort limits of actuators [N·m | N], for the option ``effort``.

        Args:
            share: The share, above 0 up to 1.
            only: The actuators; ``None`` for all.
            besides: Actuators to leave out.

        Raises:
            GoalRejected: if the share is out of range, or an actuator is unknown or has no effort
                limit.
        """
        if not 0.0 < share <= 1.0:
            raise GoalRejected(
                f"an effort for all actuators is a share of their limits, above 0 and at most 1 "
                f"(100 %), not {share:g}"
            )
        if self._efforts is None:  # cached: they do not change while the hand runs
            self._efforts = {a.name: a.effort for a in (await self._info()).actuators}
        known = self._efforts
        chosen = [name for name in (known if only is None else only) if name not in besides]
        for name in chosen:
            if name not in known:
                raise GoalRejected(
                    f"effort for an unknown actuator '{name}'; {suggestion(name, known)}"
                )
            if not math.isfinite(known[name]):
                raise GoalRejected(
                    f"'{name}' has no effort limit to take a share of; give one under 'limits' "
                    "in hand.yaml, or its effort by name"
                )
        return {name: share * known[name] for name in chosen}


def _goal(action: str, elements: Sequence[str], client: str, options: GoalOptions) -> Goal:
    values: dict[str, Any] = dict(options)
    for option, (units, name) in QUANTITIES.items():
        if values.get(option) is not None:
            values[option] = quantity(values[option], units, name)
    if "on_contact" in values:
        values["on_contact"] = reactions(values["on_contact"])
    if "stage" in values:
        try:
            values["stage"] = Stage(values["stage"])
        except ValueError:
            raise GoalRejected(
                f"unknown stage '{values['stage']}'; {suggestion(str(values['stage']), Stage)}"
            ) from None
    return Goal(action=action, elements=tuple(elements), client=client, **values)
