"""The goals of a client: send them to the hand, and follow them to their results."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Unpack

import anyio

from rtee.actions.types import ActionReference
from rtee.errors import GoalRejected, NoHand, RemoteError
from rtee.messages.goals import GOAL
from rtee.remote.goal_values import (
    GoalOptions,
    GraspOptions,
    TouchOptions,
    action_goal,
    grasp_goal,
    opening_goal,
    share_of,
    shares,
    spelled_out,
    touch_goal,
)
from rtee.remote.hand_info import HandInfo
from rtee.remote.link import ANSWER_WITHIN, Link
from rtee.remote.running_goal import RunningGoal, RunningGoals
from rtee.types import Feedback, Goal, Result

_ACCEPTED_WITHIN = ANSWER_WITHIN - 1.0
"""Time to wait for the answer to a goal before asking whether it runs [s]: both together take at
most a second longer than any other request."""


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

    @spelled_out
    async def start(
        self, action: ActionReference | str, *elements: str, **options: Unpack[GoalOptions]
    ) -> RunningGoal:
        """Begin an action and return at once; a running goal of this client is pre-empted.

        Args:
            action: Its name; case and underscores do not matter. Or the name with elements and
                scale, such as ``trig:ring*0.8``.
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
        return await self.start_goal(action_goal(action, *elements, **options))

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
        answer = self._link.send("do", GOAL.encode(goal), within=_ACCEPTED_WITHIN)
        running = self._running.add(RunningGoal(goal, partial(self.cancel, goal.goal_id)))
        try:
            try:
                await asyncio.shield(answer)
            except NoHand:
                # The answer may be lost, and the goal run.
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
            action: Its name; case and underscores do not matter. Or the name with elements and
                scale, such as ``trig:ring*0.8``.
            elements: Fingers or actuator of a primitive, in any order.
            on_feedback: Called with the feedback until the goal ends; an error of it cancels the
                goal.
            options: See below.

        Raises:
            GoalRejected: if an option cannot be used, or the hand refuses the goal, with the
                reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
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
            opening: The opening [m]; or a text such as ``40mm``.
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
        return await self._followed(await self.start_goal(goal), on_feedback)

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
            width: Width of the object [m]; or a text such as ``30mm``.
            on_feedback: Called with the feedback until the goal ends.
            options: See below.

        Raises:
            GoalRejected: if a value cannot be used, or the hand refuses the goal, with the reason
                and the nearest possible value.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        running = await self.start_goal(grasp_goal(width, **options))
        return await self._followed(running, on_feedback)

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
        return await self._followed(await self.start_goal(touch_goal(**options)), on_feedback)

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
        if self._efforts is None:  # cached: they do not change while the hand runs
            self._efforts = {a.name: a.effort for a in (await self._info()).actuators}
        return shares(self._efforts, share, only, besides)
