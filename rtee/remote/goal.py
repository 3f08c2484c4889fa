"""The goals of a client: send them to the hand, and follow them to their results."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypedDict, Unpack

import anyio

from rtee.errors import GoalRejected, NoHand, RemoteError, suggestion
from rtee.messages.goals import GOAL, goal_of
from rtee.remote.goal_values import check_types, names, reactions, sizes, tolerances
from rtee.remote.hand_info import HandInfo
from rtee.remote.link import ANSWER_WITHIN, Link
from rtee.remote.running_goal import RunningGoal, RunningGoals
from rtee.types import Feedback, Goal, OnContact, Result, Stage
from rtee.units import FORCE, LENGTH, SPEED, quantity

_ACCEPTED_WITHIN = ANSWER_WITHIN - 1.0
"""Time to wait for the answer to a goal before asking whether it runs [s]: both together take at
most a second longer than any other request."""

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

    intensity: float | str
    effort: Mapping[str, float] | float
    tolerance: float
    speed: float | str
    timeout: float | str | None
    stage: Stage | str
    kind: str | None
    opening: float | str
    force: float | str
    tip_speed: float | str
    on_contact: OnContactWords
    max_force: float | str


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

    async def start(
        self, action: str, *elements: str, **options: Unpack[GoalOptions]
    ) -> RunningGoal:
        """Begin an action and return at once; a running goal of this client is pre-empted.

        Args:
            action: Its name; case and underscores do not matter.
            elements: Fingers or actuator of a primitive, in any order.
            options: See `GoalOptions`.

        Raises:
            GoalRejected: if the hand refuses the goal, with the reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        check_types(action, elements, options, GoalOptions.__annotations__)
        effort = options.get("effort")
        if isinstance(effort, float | int):
            options["effort"] = await self.effort_limits(effort)
        return await self.start_goal(goal_with(action, elements, self._link.client, options))

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
            if not running.done:
                # Shielded, or the cancelled scope would cancel this request, too.
                with anyio.CancelScope(shield=True):
                    await self._running.give_up(running.goal.goal_id)
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
            GoalRejected: if a value cannot be used, or the hand refuses the goal, with the reason.
            LeaseHeld: if another client holds the lease.
            NoHand: if the hand has gone.
        """
        options: GoalOptions = {"opening": opening}
        if speed is not None:
            options["tip_speed"] = speed
        return await self.do("", *names(fingers), on_feedback=on_feedback, **options)

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
        narrower, wider = tolerances(tolerance)
        goal = goal_of(
            action,
            names(fingers),
            grasp=True,
            opening=quantity(width, LENGTH, "width"),
            narrower=narrower,
            wider=wider,
            tip_speed=None if speed is None else quantity(speed, SPEED, "speed"),
            force=None if force is None else quantity(force, FORCE, "force"),
            max_force=None if max_force is None else quantity(max_force, FORCE, "largest force"),
            on_contact=reactions({} if on_contact is None else on_contact),
            timeout=timeout,
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
            GoalRejected: if a value cannot be used, or the hand refuses the goal, with the reason
                and the nearest possible value.
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
        tip_speed = None if speed is None else quantity(speed, SPEED, "speed")
        goal = goal_of(action, names(fingers), touch=True, tip_speed=tip_speed, timeout=timeout)
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
            GoalRejected: if a value cannot be used, or the hand refuses the goal, with the reason.
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


def goal_with(action: str, elements: Sequence[str], client: str, options: GoalOptions) -> Goal:
    """Return the goal for an action with options, of a client.

    Raises:
        GoalRejected: if an option makes no sense.
    """
    values: dict[str, Any] = dict(options)
    values |= sizes(options)
    if "on_contact" in values:
        values["on_contact"] = reactions(values["on_contact"])
    if "stage" in values:
        try:
            values["stage"] = Stage(values["stage"])
        except ValueError:
            raise GoalRejected(
                f"unknown stage '{values['stage']}'; {suggestion(str(values['stage']), Stage)}"
            ) from None
    return goal_of(action, elements, client=client, **values)
