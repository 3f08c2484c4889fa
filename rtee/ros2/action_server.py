"""Servers of actions: goals that take a while, tell how far they are, and can be cancelled."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import anyio

from rtee.errors import MessageError, RteeError
from rtee.ros2.actions import (
    NO_GOAL,
    GoalState,
    Outcome,
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
"""Time for which a goal's result can be asked for after its end [s], as rcl had it."""

_MOST_KEPT = 50
"""Ended goals that are remembered: their states are published with each change of any."""

_MOST_ACTIVE = 16
"""Goals that are under way at once: a hand does one, and some may be about to end."""

_MOST_WAITING = 16
"""Requests for the result of a goal that wait for its end."""

_TOLD_AGAIN = 60.0
"""Time after which a reason for which goals are refused is logged again [s]."""

_LONGEST_END = 2.0
"""Time that goals have to end when the server does [s]: a hand brakes in less."""

_NEXT_LOOK = 0.01
"""Time between two looks whether the ends of goals are told [s]."""

_TOLD_A_SECOND = 5
"""Refused goals that are logged in a second, whatever the reason."""


class Job(Protocol):
    """What an accepted goal makes happen."""

    async def run(self, goal: ServerGoal) -> Outcome:
        """Do it until it ends; raising an `RteeError` aborts the goal, being cancelled too."""

    async def cancel(self) -> None:
        """Have `run` end soon; raises an `RteeError` if that is refused."""


Accept = Callable[[Any], Awaitable[Job]]
"""Takes a goal's message and returns its job; raises an `RteeError` to reject it."""


@dataclass(frozen=True, slots=True)
class Offer:
    """A type under which an action is offered.

    Attributes:
        type: The type.
        accept: Accepts its goals.
    """

    type: ActionType
    accept: Accept


class ServerGoal:
    """A goal that was accepted.

    Attributes:
        id: Its identifier.
        goal: Its message.
        stamp: When it was accepted, since 1970 [ns].
        state: How far it is.
    """

    def __init__(
        self, goal_id: bytes, goal: Message, job: Job, offered: _Offered, stamp: int
    ) -> None:
        self.id, self.goal, self.stamp = goal_id, goal, stamp
        self.state = GoalState.ACCEPTED
        self.job, self.offered = job, offered
        self.ended: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        self.task: asyncio.Task[None] | None = None
        self.forget_at = 0.0
        self.waiting = 0

    @property
    def heard(self) -> bool:
        """Whether anybody listens to its feedback."""
        return any(publisher.heard for publisher, _ in self.offered.feedback)

    def feedback(self, **fields: Any) -> None:
        """Publish feedback, if anybody listens.

        Args:
            fields: Its fields by name; a version of the type that lacks one is sent the others.
        """
        for publisher, kind in self.offered.feedback:
            if publisher.heard:
                known = [member.name for member in kind.STRUCTURE.members]
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
        # Room for all who may wait for results, and for one more, who is refused at once.
        at_once = _MOST_ACTIVE * _MOST_WAITING + 1
        self._services = (
            node.service(called.send_goal, offer.type.send_goal, self._send),
            node.service(called.get_result, offer.type.get_result, self._result, at_once=at_once),
        )

    async def _send(self, request: Any) -> Message:
        stamp = time.time_ns()
        accepted = await self._server.begin(request.goal_id.uuid, request.goal, self, stamp)
        return self.type.send_goal.response(
            accepted=accepted, stamp=self._time(**time_fields(stamp))
        )

    async def _result(self, request: Any) -> Message:
        goal = self._server.find(request.goal_id.uuid)
        # Under another type the result would have other fields.
        if goal is None or goal.offered is not self:
            return self.type.get_result.response(status=GoalState.UNKNOWN)
        if goal.waiting >= _MOST_WAITING:
            raise MessageError(f"{_MOST_WAITING} already wait for the end of this goal")
        goal.waiting += 1
        try:
            # Whoever asks may be cancelled; the others still wait.
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

    Goals whose identifier is known already are rejected. Results are kept for 15 minutes after the
    end, of the last fifty goals. A goal goes on when its client disappears, as in ROS 2.

    Args:
        node: The node.
        name: The action's name, such as ``~/gripper_cmd``.
        offers: The types under which it is offered.
        kept_for: Time for which results are kept [s].
    """

    def __init__(self, node: Node, name: str, *offers: Offer, kept_for: float = KEPT_FOR) -> None:
        self.name = node.name.resolve(name)
        self._node, self._context, self._kept_for = node, node.context, kept_for
        self._goals: dict[bytes, ServerGoal] = {}
        self._looked_at: set[bytes] = set()
        self._told: dict[str, float] = {}
        self._limit = Limit(_TOLD_A_SECOND)
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
        """The goals that are remembered, in the order of their acceptance."""
        self._forget()
        return list(self._goals.values())

    def find(self, goal_id: bytes) -> ServerGoal | None:
        """Return a goal that is remembered."""
        self._forget()
        return self._goals.get(goal_id)

    async def begin(self, goal_id: bytes, message: Message, offered: _Offered, stamp: int) -> bool:
        """Begin a goal and return whether it was accepted; what refuses it is logged.

        Args:
            goal_id: Its identifier.
            message: Its message.
            offered: The type under which it came.
            stamp: When it is accepted, since 1970 [ns].
        """
        if goal_id in self._goals or goal_id in self._looked_at or goal_id == NO_GOAL:
            self._context.complaints.tell(f"a goal of {self.name} is refused", "its id is not new")
            return False
        active = sum(not goal.state.ended for goal in self._goals.values())
        if active + len(self._looked_at) >= _MOST_ACTIVE:
            self._refused("too many goals are under way")
            return False
        # Known from here on: the same goal may come again while the hand looks at this one.
        self._looked_at.add(goal_id)
        try:
            job = await self._accepted(offered, message)
        finally:
            self._looked_at.discard(goal_id)
        if job is None:
            return False
        if self._finishing:  # since it was asked
            with suppress(RteeError):
                await job.cancel()
            return False
        goal = ServerGoal(goal_id, message, job, offered, stamp)
        self._forget()
        self._goals[goal_id] = goal
        self._publish()
        self._context.start(self._run(goal))
        return True

    async def _accepted(self, offered: _Offered, message: Message) -> Job | None:
        if self._finishing:
            self._refused("the server is about to end")
            return None
        try:
            return await offered.accept(message)
        except RteeError as error:
            self._refused(str(error))
        except Exception:
            self._context.log.exception("%s could not look at a goal", self.name)
        return None

    def _refused(self, reason: str) -> None:
        now = time.monotonic()
        self._told = {one: at for one, at in self._told.items() if now - at < _TOLD_AGAIN}
        if reason not in self._told and self._limit.passes():
            self._told[reason] = now
            self._context.log.warning("a goal of %s is refused: %s", self.name, reason)

    async def _run(self, goal: ServerGoal) -> None:
        goal.task = asyncio.current_task()
        # It may have been cancelled before its task began.
        if goal.state is GoalState.ACCEPTED:
            self._change(goal, GoalState.EXECUTING)
        # What counts if this task is cancelled.
        outcome = Outcome(GoalState.ABORTED, goal.offered.type.result(), "the server has ended")
        try:
            outcome = await goal.job.run(goal)
        except RteeError as error:
            outcome = Outcome(GoalState.ABORTED, goal.offered.type.result(), str(error))
        except Exception:
            self._context.log.exception("a goal of %s failed", self.name)
            outcome = Outcome(GoalState.ABORTED, goal.offered.type.result())
        finally:
            self._end(goal, outcome)

    def _end(self, goal: ServerGoal, outcome: Outcome) -> None:
        state = outcome.state
        if state is GoalState.CANCELED and goal.state is not GoalState.CANCELING:
            state = GoalState.ABORTED  # nobody cancelled it here
        if outcome.reason:
            self._context.log.info("a goal of %s was aborted: %s", self.name, outcome.reason)
        goal.forget_at = time.monotonic() + self._kept_for
        self._change(goal, state)
        goal.ended.set_result(outcome)

    def _change(self, goal: ServerGoal, state: GoalState) -> None:
        goal.state = state
        self._publish()

    def _publish(self) -> None:
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
        """Forget goals that ended long ago, and the oldest beyond the number that is kept."""
        now = time.monotonic()
        # In the order of acceptance, so that the oldest come first.
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
        """Cancel a goal; return whether that was not refused."""
        if goal.state > GoalState.EXECUTING:
            return False  # it ended while another one was cancelled
        self._change(goal, GoalState.CANCELING)
        try:
            await goal.job.cancel()
        except RteeError as error:
            # It may have ended while the hand was asked to cancel it.
            if goal.state is GoalState.CANCELING:
                self._change(goal, GoalState.EXECUTING)
            self._context.log.warning("a goal of %s is not cancelled: %s", self.name, error)
            return False
        return True

    async def run(self) -> None:
        """Offer the action until cancelled; goals that are under way then are cancelled, too."""
        try:
            await anyio.sleep_forever()
        finally:
            await self.finish()

    async def finish(self) -> None:
        """Cancel what is under way, tell those who wait for it, and leave the graph."""
        self._finishing = True
        # Of a goal that has just ended, some may still be about to hear it.
        under_way = [one for one in self._goals.values() if one.waiting or not one.state.ended]
        with anyio.move_on_after(_LONGEST_END, shield=True):
            for goal in under_way:
                if not goal.state.ended:
                    with suppress(RteeError):
                        await goal.job.cancel()
            await self._ended(under_way)
        # Those that did not end in time; their clients get a result, too.
        self._abort()
        with anyio.move_on_after(_LONGEST_END, shield=True):
            await self._ended(under_way)
        self.close()

    async def _ended(self, goals: Collection[ServerGoal]) -> None:
        """Wait until goals have ended and those who wait for their results have them."""
        while any(goal.waiting or not goal.state.ended for goal in goals):  # noqa: ASYNC110
            await anyio.sleep(_NEXT_LOOK)

    def _abort(self) -> None:
        for goal in self._goals.values():
            if goal.task is not None:
                goal.task.cancel()

    def close(self) -> None:
        """Abort what is under way, and leave the graph."""
        self._abort()
        self._closed = True
        for offered in self._offered:
            offered.close()
        self._node.discard(self._cancelling)
        self._node.discard(self._status)
