"""Clients of actions."""

from __future__ import annotations

import asyncio
import math
import uuid
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import anyio

from rtee.errors import GoalRejected, MessageError, NoHand
from rtee.ros2.actions import (
    NO_GOAL,
    ActionOutcome,
    GoalState,
    Refusal,
    names,
    time_fields,
    versions,
)
from rtee.ros2.keys import Kind
from rtee.ros2.message import Message
from rtee.ros2.node import Node
from rtee.ros2.qos import LATCHED
from rtee.ros2.types import ActionType

OnFeedback = Callable[[Any], object]
"""Called with the feedback of a goal: a message of the action's type."""

_ANSWER_WITHIN = 5.0
"""Longest time until a server accepts, refuses or cancels a goal [s]."""


_GONE_WITHIN = 0.5
"""Longest time from the end of a query until the graph shows that its server has gone [s]: both
come with the same connection; a server that is still there then has dropped the query."""


class ClientGoal:
    """A goal that a server has accepted; made by `ActionClient.send_goal`.

    Attributes:
        id: Identifier of the goal ``(16,)``.
        stamp: Time of its acceptance by the server's clock, a ``builtin_interfaces/msg/Time``.
        state: State of the goal by the server's last message.
    """

    def __init__(self, client: ActionClient, goal_id: bytes, stamp: Any) -> None:
        self.id, self.stamp, self.state = goal_id, stamp, GoalState.ACCEPTED
        self._client = client

    async def result(self, timeout: float = math.inf) -> ActionOutcome:
        """Wait for the end of the goal and return its outcome.

        Raises `TimeoutError` if the goal has not ended within the timeout [s], and `NoHand` if the
        server has gone, does not answer, or no longer knows the goal.
        """
        return await self._client.result(self, timeout)

    async def cancel(self, timeout: float = _ANSWER_WITHIN) -> Refusal:
        """Ask the server to cancel the goal; return its refusal, or `Refusal.NONE`.

        Raises `TimeoutError` if it does not answer within the timeout [s].
        """
        code, _ = await self._client.cancel(self.id, timeout=timeout)
        return code


class ActionClient:
    """A client of an action, of a type or a type's full name.

    Raises `ConfigError` if ROS 2 would refuse the name, `MessageError` if there is no such type.
    """

    def __init__(self, node: Node, name: str, type_: str | ActionType) -> None:
        known = node.context.interfaces
        self.type = known.action(type_) if isinstance(type_, str) else type_
        self.name = node.name.resolve(name)
        self._node, self._graph = node, node.context.graph
        self._uuid: type[Message] = known.message("unique_identifier_msgs/msg/UUID")
        self._info: type[Message] = known.message("action_msgs/msg/GoalInfo")
        self._time: type[Message] = known.message("builtin_interfaces/msg/Time")
        self._goals: dict[bytes, tuple[ClientGoal, OnFeedback | None]] = {}
        called = names(self.name)
        self._send = node.client(called.send_goal, self.type.send_goal)
        self._result = node.client(called.get_result, self.type.get_result)
        self._cancel = node.client(called.cancel_goal, self.type.cancel_goal)
        self._heard = [
            node.subscription(called.feedback, version.feedback_message, self._on_feedback)
            for version in versions(self.type, known.distro)
        ]
        self._heard.append(
            node.subscription(called.status, self.type.status, self._on_status, LATCHED)
        )

    @property
    def available(self) -> bool:
        """Whether there is a server: all three services and both topics of the action."""
        services = self._send.available and self._result.available and self._cancel.available
        return services and all(
            self._graph.of(Kind.PUBLISHER, topic.name, topic.type.name) for topic in self._heard
        )

    async def wait_for_server(self, timeout: float = math.inf) -> None:
        """Wait until there is a server; raise `TimeoutError` if there is none in time [s]."""
        with anyio.move_on_after(timeout) as scope:
            await self._graph.wait_until(lambda: self.available)
        if scope.cancelled_caught:
            raise TimeoutError(f"no node offers the action {self.name} ({self.type.name})")

    async def send_goal(
        self,
        goal: Message,
        on_feedback: OnFeedback | None = None,
        timeout: float = _ANSWER_WITHIN,
        goal_id: bytes | None = None,
    ) -> ClientGoal:
        """Send a goal and return it when the server has accepted it.

        Args:
            goal: Message of the goal.
            on_feedback: Called in the event loop with the feedback of the goal.
            timeout: Longest time until the server's answer [s]; then `TimeoutError`.
            goal_id: Identifier of the goal ``(16,)``; random unless given.

        Raises:
            GoalRejected: if the server rejects the goal; ROS 2 transmits no reason.
            MessageError: if a field of the goal holds what its type cannot.
        """
        goal_id = uuid.uuid4().bytes if goal_id is None else goal_id
        request = self.type.send_goal.request(goal_id=self._uuid(uuid=goal_id), goal=goal)
        # Registered first, since feedback and status may arrive before the answer.
        client_goal = ClientGoal(self, goal_id, self._time())
        self._goals[goal_id] = (client_goal, on_feedback)
        accepted = False
        try:
            answer = await self._send.call(request, timeout)
            accepted = answer.accepted
        finally:
            if not accepted:
                self._goals.pop(goal_id, None)
        if not accepted:
            raise GoalRejected(f"{self.name} refuses the goal; the server's log says why")
        client_goal.stamp = answer.stamp
        return client_goal

    async def result(self, goal: ClientGoal, timeout: float) -> ActionOutcome:
        """Wait for the end of a goal; see `ClientGoal.result`."""
        request = self.type.get_result.request(goal_id=self._uuid(uuid=goal.id))
        # The query has no timeout and may outlive its server, hence the watch on the graph.
        call = asyncio.ensure_future(self._result.call(request, math.inf))
        watch = asyncio.ensure_future(self._graph.wait_until(lambda: not self._result.available))
        try:
            limit = None if math.isinf(timeout) else timeout
            await asyncio.wait((call, watch), timeout=limit, return_when="FIRST_COMPLETED")
            if not call.done() and not watch.done():
                raise TimeoutError(f"the goal of {self.name} has not ended after {timeout:g} s")
            try:
                answer = call.result() if call.done() else None
            except TimeoutError:  # Zenoh ended the query: no server is left, or it has dropped it
                answer = None
                await asyncio.wait((watch,), timeout=_GONE_WITHIN)
            if answer is None:
                raise NoHand(
                    f"the server of {self.name} is gone"
                    if watch.done()
                    else f"the server of {self.name} gives no result; it may have too many clients"
                )
        finally:
            for task in (call, watch):
                task.cancel()
            # Awaited, so that no task is left behind and asyncio does not log their exceptions as
            # never retrieved.
            await asyncio.gather(call, watch, return_exceptions=True)
        # Not after a timeout, since the goal then goes on and its feedback is still wanted.
        self._goals.pop(goal.id, None)
        # Other implementations may send states that are not defined.
        with suppress(ValueError):
            goal.state = GoalState(answer.status)
        if goal.state is GoalState.UNKNOWN:
            raise NoHand(f"the server of {self.name} does not know the goal; it has restarted")
        return ActionOutcome(goal.state, answer.result)

    async def cancel(
        self, goal_id: bytes = NO_GOAL, until: int = 0, timeout: float = _ANSWER_WITHIN
    ) -> tuple[Refusal, list[bytes]]:
        """Cancel goals, also those of other clients: one, or those accepted up to a time, or all.

        Returns the server's refusal, or `Refusal.NONE`, and the identifiers of the cancelled goals.
        Raises `TimeoutError` if the server does not answer within the timeout [s], and
        `MessageError` if the code of the answer is not defined.

        Args:
            goal_id: The goal; `NO_GOAL`: the goals of ``until``, or all.
            until: Time since 1970 [ns]; also cancels all goals accepted up to then; 0: none.
            timeout: Longest time until the answer [s].
        """
        stamp = self._time(**time_fields(until))
        info = self._info(goal_id=self._uuid(uuid=goal_id), stamp=stamp)
        answer = await self._cancel.call(self.type.cancel_goal.request(goal_info=info), timeout)
        ids = [goal.goal_id.uuid for goal in answer.goals_canceling]
        try:
            return Refusal(answer.return_code), ids
        except ValueError:
            raise MessageError(
                f"{answer.return_code} is not a valid answer to a cancellation"
            ) from None

    def _on_feedback(self, message: Any) -> None:
        known = self._goals.get(message.goal_id.uuid)
        if known is not None and known[1] is not None:
            known[1](message.feedback)

    def _on_status(self, message: Any) -> None:
        for status in message.status_list:
            known = self._goals.get(status.goal_info.goal_id.uuid)
            if known is not None:
                # As above: a state that is not defined.
                with suppress(ValueError):
                    known[0].state = GoalState(status.status)

    def close(self) -> None:
        """Leave the graph."""
        for client in (self._send, self._result, self._cancel):
            self._node.discard(client)
        for subscription in self._heard:
            self._node.discard(subscription)
        self._goals.clear()
