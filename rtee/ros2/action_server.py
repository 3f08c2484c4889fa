"""Servers of actions: long-running goals with feedback, which clients can cancel."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import anyio

from rtee import monotonic
from rtee.errors import RteeError
from rtee.ros2.actions import (
    NO_GOAL,
    ActionOutcome,
    GoalState,
    Refusal,
    names,
    nanoseconds,
    time_fields,
    versions,
)
from rtee.ros2.endpoints import Publisher
from rtee.ros2.inbox import Limit
from rtee.ros2.message import Message
from rtee.ros2.node import Node
from rtee.ros2.qos import LATCHED
from rtee.ros2.types import ActionType, ServiceType

KEPT_FOR = 900.0
"""Time for which clients can request the result of an ended goal [s]: the usual one of rcl."""

_MOST_KEPT = 50
"""Most ended goals kept: each message of the status lists all of them."""

_MOST_ACTIVE = 16
"""Most goals at once: a hand executes one, and some may be about to end."""

_MOST_WAITING = 256
"""Most requests that wait for the end of goals, of whichever; later ones wait for their turn."""

_LOGGED_AGAIN = 60.0
"""Time after which the same reason for a refusal is logged again [s]."""

_LONGEST_END = 2.0
"""Longest time that goals may take to end when the server ends [s]: a hand brakes faster."""

_NEXT_LOOK = 0.01
"""Time between two checks whether goals have ended and their clients have the results [s]."""

_LOGGED_PER_SECOND = 5
"""Most refused goals logged per second, whatever the reasons."""


class Job(Protocol):
    """The work of an accepted goal."""

    async def run(self, goal: ServerGoal) -> ActionOutcome:
        """Do the work to its end; an `RteeError`, or cancellation, aborts the goal."""

    async def cancel(self) -> None:
        """Make `run` end soon; raise an `RteeError` to refuse."""


Accept = Callable[[Any], Awaitable[Job]]
"""Returns the job of a goal's message, or raises an `RteeError` to reject the goal."""


@dataclass(frozen=True, slots=True)
class Offer:
    """A type under which a server offers its action, and the function that accepts its goals."""

    type: ActionType
    accept: Accept


class ServerGoal:
    """An accepted goal with its identifier ``(16,)`` and the time of acceptance since 1970 [ns]."""

    def __init__(
        self, goal_id: bytes, goal: Message, job: Job, offered: _Offered, stamp: int
    ) -> None:
        self.id, self.goal, self.stamp = goal_id, goal, stamp
        self.state = GoalState.ACCEPTED
        self.job, self.offered = job, offered
        self.ended: asyncio.Future[ActionOutcome] = asyncio.get_running_loop().create_future()
        self.task: asyncio.Task[None] | None = None
        self.forget_at = 0.0
        self.waiting = 0

    @property
    def heard(self) -> bool:
        """Whether anybody subscribes to the feedback."""
        return any(publisher.heard for publisher, _ in self.offered.feedback)

    def feedback(self, **fields: Any) -> None:
        """Publish feedback if anybody subscribes, in each version without the fields it lacks."""
        for publisher, kind in self.offered.feedback:
            if publisher.heard:
                known = [field.name for field in kind.STRUCTURE.fields]
                made = kind(**{name: fields[name] for name in known if name in fields})
                publisher.publish(
                    publisher.type.message(goal_id=self.offered.uuid(uuid=self.id), feedback=made)
                )


class _Offered:
    """The endpoints of one type of an action."""

    def __init__(self, server: ActionServer, node: Node, name: str, offer: Offer) -> None:
        self.type, self.accept = offer.type, offer.accept
        self._server, self._node = server, node
        messages = node.context.interfaces.message
        self.uuid: type[Message] = messages("unique_identifier_msgs/msg/UUID")
        self._time: type[Message] = messages("builtin_interfaces/msg/Time")
        called = names(name)
        self.feedback: list[tuple[Publisher, type[Message]]] = []
        for version in versions(offer.type, node.context.interfaces.distro):
            publisher = node.publisher(called.feedback, version.feedback_message)
            self.feedback.append((publisher, version.feedback))
        result, at_once = offer.type.get_result, _MOST_WAITING
        self._services = (
            node.service(called.send_goal, offer.type.send_goal, self._send),
            node.service(called.get_result, result, self._result, at_once=at_once),
        )

    async def _send(self, request: Any) -> Message:
        stamp = time.time_ns()
        accepted = await self._server.begin(request.goal_id.uuid, request.goal, self, stamp)
        return self.type.send_goal.response(
            accepted=accepted, stamp=self._time(**time_fields(stamp))
        )

    async def _result(self, request: Any) -> Message:
        goal = self._server.find(request.goal_id.uuid)
        # The result of a goal of another type would have other fields.
        if goal is None or goal.offered is not self:
            return self.type.get_result.response(status=GoalState.UNKNOWN)
        goal.waiting += 1
        try:
            # Shielded: if this request is cancelled, the others still wait.
            outcome = await asyncio.shield(goal.ended)
        finally:
            goal.waiting -= 1
        return self.type.get_result.response(status=goal.state, result=outcome.result)

    def close(self) -> None:
        for service in self._services:
            self._node.discard(service)
        for publisher, _ in self.feedback:
            self._node.discard(publisher)


class ActionServer:
    """A server of an action, under one type or several at once.

    Rejects goals whose identifier is known already. Keeps the results of the last 50 goals for 15
    minutes, or ``kept_for`` [s]. As in ROS 2, a goal goes on when its client disappears.
    """

    def __init__(self, node: Node, name: str, *offers: Offer, kept_for: float = KEPT_FOR) -> None:
        self.name = node.name.resolve(name)
        self._node, self._context, self._kept_for = node, node.context, kept_for
        self._goals: dict[bytes, ServerGoal] = {}
        self._pending: set[bytes] = set()
        self._logged: dict[str, float] = {}
        self._limit = Limit(_LOGGED_PER_SECOND)
        self._finishing = self._closed = False
        called, first = names(self.name), offers[0].type
        self._status = node.publisher(called.status, first.status, LATCHED)
        self._cancel_type: ServiceType = first.cancel_goal
        self._cancelling = node.service(called.cancel_goal, first.cancel_goal, self._cancel)
        self._offered = [_Offered(self, node, self.name, offer) for offer in offers]
        messages = node.context.interfaces.message
        self._goal_status: type[Message] = messages("action_msgs/msg/GoalStatus")
        self._goal_info: type[Message] = messages("action_msgs/msg/GoalInfo")
        self._uuid: type[Message] = messages("unique_identifier_msgs/msg/UUID")
        self._time: type[Message] = messages("builtin_interfaces/msg/Time")

    @property
    def goals(self) -> list[ServerGoal]:
        """The known goals, in the order of their acceptance."""
        self._forget()
        return list(self._goals.values())

    def find(self, goal_id: bytes) -> ServerGoal | None:
        """Return a known goal; ``None`` if there is none with this identifier."""
        self._forget()
        return self._goals.get(goal_id)

    async def begin(self, goal_id: bytes, message: Message, offered: _Offered, stamp: int) -> bool:
        """Begin a goal and return whether it was accepted; log the reason for a rejection.

        The stamp is the time of acceptance since 1970 [ns].
        """
        if goal_id in self._goals or goal_id in self._pending or goal_id == NO_GOAL:
            self._context.warning_log.tell(
                f"a goal of {self.name} is refused", "its identifier is not new"
            )
            return False
        # Goals that are still being checked count, too: many could arrive during one check.
        active = sum(not goal.state.ended for goal in self._goals.values())
        if active + len(self._pending) >= _MOST_ACTIVE:
            self._log_refusal("too many goals are under way")
            return False
        # The same goal may arrive again while the hand checks this one.
        self._pending.add(goal_id)
        try:
            job = await self._accepted(offered, message)
        finally:
            self._pending.discard(goal_id)
        if job is None:
            return False
        if self._finishing:  # since the hand began to check it
            with suppress(RteeError):
                await job.cancel()
            return False
        goal = ServerGoal(goal_id, message, job, offered, stamp)
        self._forget()
        self._goals[goal_id] = goal
        # Before the task starts, so that clients hear of the accepted goal first.
        self._publish()
        self._context.start(self._run(goal))
        return True

    async def _accepted(self, offered: _Offered, message: Message) -> Job | None:
        if self._finishing:
            self._log_refusal("the server is about to end")
            return None
        try:
            return await offered.accept(message)
        except RteeError as error:
            self._log_refusal(str(error))
        except Exception:
            self._context.log.exception("%s could not check a goal", self.name)
        return None

    def _log_refusal(self, reason: str) -> None:
        now = monotonic.now()
        self._logged = {why: at for why, at in self._logged.items() if now - at < _LOGGED_AGAIN}
        if reason not in self._logged and self._limit.passes():
            self._logged[reason] = now
            self._context.log.warning("a goal of %s is refused: %s", self.name, reason)

    async def _run(self, goal: ServerGoal) -> None:
        goal.task = asyncio.current_task()
        # A goal may be cancelled before its task begins.
        if goal.state is GoalState.ACCEPTED:
            self._change(goal, GoalState.EXECUTING)
        # The outcome if this task is cancelled.
        outcome = ActionOutcome(
            GoalState.ABORTED, goal.offered.type.result(), "the server has ended"
        )
        try:
            outcome = await goal.job.run(goal)
        except RteeError as error:
            outcome = ActionOutcome(GoalState.ABORTED, goal.offered.type.result(), str(error))
        except Exception:
            self._context.log.exception("a goal of %s failed", self.name)
            outcome = ActionOutcome(GoalState.ABORTED, goal.offered.type.result())
        finally:
            self._end(goal, outcome)

    def _end(self, goal: ServerGoal, outcome: ActionOutcome) -> None:
        state = outcome.state
        if state is GoalState.CANCELED and goal.state is not GoalState.CANCELING:
            state = GoalState.ABORTED  # cancelled by another client of the hand, not through ROS 2
        if outcome.reason:
            self._context.log.info("a goal of %s was aborted: %s", self.name, outcome.reason)
        goal.forget_at = monotonic.now() + self._kept_for
        self._change(goal, state)
        # Last, so that a client that has the result finds the goal ended in the status.
        goal.ended.set_result(outcome)

    def _change(self, goal: ServerGoal, state: GoalState) -> None:
        goal.state = state
        self._publish()

    def _publish(self) -> None:
        # A goal aborted by `close` ends later, when the publisher has left the graph.
        if not self._closed:
            self._status.publish(
                self._status.type.message(
                    status_list=[
                        self._goal_status(goal_info=self._info(goal), status=goal.state)
                        for goal in self._goals.values()
                    ]
                )
            )

    def _info(self, goal: ServerGoal) -> Message:
        return self._goal_info(
            goal_id=self._uuid(uuid=goal.id), stamp=self._time(**time_fields(goal.stamp))
        )

    def _forget(self) -> None:
        """Forget goals that ended long ago, and the oldest ended ones beyond `_MOST_KEPT`."""
        now = monotonic.now()
        # The goals are in the order of acceptance, with the oldest first.
        ended = [goal for goal in self._goals.values() if goal.state.ended]
        for place, goal in enumerate(ended):
            if now >= goal.forget_at or place < len(ended) - _MOST_KEPT:
                del self._goals[goal.id]

    async def _cancel(self, request: Any) -> Message:
        """Cancel goals, chosen as rcl does: by identifier, by time of acceptance, or all."""
        self._forget()
        info = request.goal_info
        goal_id, until = info.goal_id.uuid, nanoseconds(info.stamp)
        if goal_id != NO_GOAL and until == 0:
            goal = self._goals.get(goal_id)
            if goal is None:
                return self._cancel_type.response(return_code=Refusal.UNKNOWN_GOAL)
            if goal.state > GoalState.EXECUTING:
                return self._cancel_type.response(return_code=Refusal.ENDED)
            chosen = [goal]
        else:
            everything = until == 0
            chosen = [
                goal
                for goal in self._goals.values()
                if goal.state <= GoalState.EXECUTING
                and (everything or goal.stamp <= until or goal.id == goal_id)
            ]
        cancelled = [goal for goal in chosen if await self._cancelled(goal)]
        code = Refusal.REJECTED if chosen and not cancelled else Refusal.NONE
        return self._cancel_type.response(
            return_code=code, goals_canceling=[self._info(goal) for goal in cancelled]
        )

    async def _cancelled(self, goal: ServerGoal) -> bool:
        """Cancel a goal; return whether the hand agreed."""
        if goal.state > GoalState.EXECUTING:
            return False  # it ended while another one was cancelled
        # Before the hand is asked, since the goal may end as cancelled while it answers.
        self._change(goal, GoalState.CANCELING)
        try:
            await goal.job.cancel()
        except RteeError as error:
            # The goal may have ended during the request.
            if goal.state is GoalState.CANCELING:
                self._change(goal, GoalState.EXECUTING)
            self._context.log.warning("a goal of %s is not cancelled: %s", self.name, error)
            return False
        return True

    async def run(self) -> None:
        """Offer the action until cancelled, and then cancel its active goals."""
        try:
            await anyio.sleep_forever()
        finally:
            await self.finish()

    async def finish(self) -> None:
        """Cancel the active goals, wait until their clients have the results, leave the graph."""
        self._finishing = True
        # Clients of a goal that has just ended may still wait for the result.
        under_way = [goal for goal in self._goals.values() if goal.waiting or not goal.state.ended]
        # Shielded, since `run` calls this when it is cancelled; hence the time limit.
        with anyio.move_on_after(_LONGEST_END, shield=True):
            for goal in under_way:
                if not goal.state.ended:
                    with suppress(RteeError):
                        await goal.job.cancel()
            await self._ended(under_way)
        # Goals that did not end in time; their clients get a result, too.
        self._abort()
        with anyio.move_on_after(_LONGEST_END, shield=True):
            await self._ended(under_way)
        self.close()

    async def _ended(self, goals: Collection[ServerGoal]) -> None:
        """Wait until goals have ended and their clients have the results."""
        while any(goal.waiting or not goal.state.ended for goal in goals):  # noqa: ASYNC110
            await anyio.sleep(_NEXT_LOOK)

    def _abort(self) -> None:
        for goal in self._goals.values():
            if goal.task is not None:
                goal.task.cancel()

    def close(self) -> None:
        """Abort the active goals and leave the graph."""
        self._abort()
        self._closed = True
        for offered in self._offered:
            offered.close()
        self._node.discard(self._cancelling)
        self._node.discard(self._status)
