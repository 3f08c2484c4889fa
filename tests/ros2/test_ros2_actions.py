"""Servers and clients of actions, each in a session of its own."""

from __future__ import annotations

import logging
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import anyio
import pytest
from remote.serving import until

from rtee.errors import GoalRejected, NoHand, RteeError
from rtee.hand.config_schema import Ros2Settings
from rtee.ros2 import Context, Node
from rtee.ros2.action_client import ActionClient, ClientGoal
from rtee.ros2.action_server import ActionServer, Offer, ServerGoal
from rtee.ros2.actions import ActionOutcome, GoalState, Refusal
from rtee.ros2.inbox import SharedLimit

pytestmark = pytest.mark.anyio

GRIPPER = "control_msgs/action/GripperCommand"
PARALLEL = "control_msgs/action/ParallelGripperCommand"
STUBBORN, IMPOSSIBLE = 0.5, 9.0
"""Positions: goals there refuse to be cancelled, or are refused."""


class Job:
    """Runs until it is told to end, or cancelled."""

    def __init__(self, position: float) -> None:
        self.position = position
        self.end = anyio.Event()
        self.state = GoalState.SUCCEEDED
        self.error: RteeError | None = None

    async def run(self, goal: ServerGoal) -> ActionOutcome:
        goal.feedback(position=self.position, reached_goal=False)
        await self.end.wait()
        if self.error is not None:
            raise self.error
        result = goal.offered.type.result
        return ActionOutcome(self.state, result(reached_goal=self.state is GoalState.SUCCEEDED))

    async def cancel(self) -> None:
        if self.position == STUBBORN:
            raise GoalRejected("it does not want to")
        self.state = GoalState.CANCELED
        self.end.set()


@dataclass
class Works:
    """A server with the jobs of its goals, and a client."""

    settings: Ros2Settings
    there: Node
    here: Node
    jobs: list[Job] = field(default_factory=list)
    server: ActionServer = field(init=False)
    client: ActionClient = field(init=False)

    async def accept(self, message: Any) -> Job:
        if message.command.position == IMPOSSIBLE:
            raise GoalRejected("nothing opens so wide")
        self.jobs.append(Job(message.command.position))
        return self.jobs[-1]

    async def send(self, position: float = 0.01, **options: Any) -> ClientGoal:
        goal = self.client.type.goal()
        goal.command.position = position
        return await self.client.send_goal(goal, **options)

    async def sees(self, goal: ClientGoal, state: GoalState) -> None:
        await until(lambda: goal.state is state)


@asynccontextmanager
async def working(settings: Ros2Settings, **options: Any) -> AsyncIterator[Works]:
    async with Context.open(settings, {}) as one, Context.open(settings, {}) as other:
        works = Works(settings, one.node("gripper"), other.node("planner"))
        kind = one.interfaces.action(GRIPPER)
        works.server = ActionServer(works.there, "~/cmd", Offer(kind, works.accept), **options)
        works.client = ActionClient(works.here, "/gripper/cmd", GRIPPER)
        await works.client.wait_for_server(20)
        yield works


async def test_a_goal_from_its_acceptance_to_its_result(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        heard: list[Any] = []
        before = time.time()
        goal = await works.send(0.02, on_feedback=heard.append)
        assert before - 1 < goal.stamp.sec <= time.time()
        await works.sees(goal, GoalState.EXECUTING)
        [accepted] = works.server.goals
        await until(lambda: accepted.heard)
        accepted.feedback(position=0.03)
        await until(lambda: bool(heard) and heard[-1].position == 0.03)
        works.jobs[0].end.set()
        outcome = await goal.result(20)
        assert (outcome.state, outcome.result.reached_goal) == (GoalState.SUCCEEDED, True)
        # Kept: whoever asks later is told the same.
        assert (await goal.result(20)).state is GoalState.SUCCEEDED


async def test_a_refused_goal_is_logged_with_the_reason(
    settings: Ros2Settings, caplog: pytest.LogCaptureFixture
) -> None:
    async with working(settings) as works:
        for _ in range(3):
            with pytest.raises(GoalRejected, match="/gripper/cmd refuses the goal"):
                await works.send(IMPOSSIBLE)
        assert works.server.goals == []
    told = [one.getMessage() for one in caplog.records if "opens so wide" in one.getMessage()]
    assert told == ["a goal of /gripper/cmd is refused: nothing opens so wide"]


@pytest.mark.parametrize("error", [NoHand("the hand has gone"), None])
async def test_a_goal_that_cannot_go_on_is_aborted(
    settings: Ros2Settings, error: RteeError | None, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    async with working(settings) as works:
        goal = await works.send()
        # An end that nobody asked for here is none that the client has cancelled.
        works.jobs[0].error, works.jobs[0].state = error, GoalState.CANCELED
        works.jobs[0].end.set()
        assert (await goal.result(20)).state is GoalState.ABORTED
        assert ("was aborted: the hand has gone" in caplog.text) is (error is not None)


async def test_cancelling_one_of_two(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        first, second = await works.send(), await works.send()
        assert await first.cancel() is Refusal.NONE
        assert (await first.result(20)).state is GoalState.CANCELED
        assert await first.cancel() is Refusal.ENDED
        await works.sees(second, GoalState.EXECUTING)
        code, ids = await works.client.cancel(bytes(range(16)))
        assert (code, ids) == (Refusal.UNKNOWN_GOAL, [])


async def test_cancelling_all_and_those_up_to_a_time(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        goals = [await works.send() for _ in range(4)]
        stamps = [one.stamp.sec * 10**9 + one.stamp.nanosec for one in goals]
        assert stamps == sorted(set(stamps))
        # By time: those accepted up to then.
        code, ids = await works.client.cancel(until=stamps[0])
        assert (code, ids) == (Refusal.NONE, [goals[0].id])
        # By time and identifier: those up to then, and that one.
        code, ids = await works.client.cancel(goals[3].id, until=stamps[1])
        assert (code, ids) == (Refusal.NONE, [goals[1].id, goals[3].id])
        # Neither: all that are left.
        code, ids = await works.client.cancel()
        assert (code, ids) == (Refusal.NONE, [goals[2].id])
        for goal in goals:
            assert (await goal.result(20)).state is GoalState.CANCELED
        assert await works.client.cancel() == (Refusal.NONE, [])


async def test_a_goal_that_will_not_be_cancelled_goes_on(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        goal = await works.send(STUBBORN)
        assert await goal.cancel() is Refusal.REJECTED
        await works.sees(goal, GoalState.EXECUTING)
        works.jobs[0].end.set()
        assert (await goal.result(20)).state is GoalState.SUCCEEDED


async def test_a_goal_that_nobody_knows(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        client = works.here.client("/gripper/cmd/_action/get_result", works.client.type.get_result)
        answer = await client.call(client.type.request(), 20)
        assert answer.status == GoalState.UNKNOWN


async def test_an_identifier_counts_once(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        goal = await works.send(goal_id=bytes(range(16)))
        with pytest.raises(GoalRejected):
            await works.send(goal_id=goal.id)
        works.jobs[0].end.set()
        with pytest.raises(GoalRejected):
            await works.send(goal_id=bytes(16))
        assert len(works.jobs) == 1


async def test_results_are_forgotten(settings: Ros2Settings) -> None:
    async with working(settings, kept_for=0.0) as works:
        goal = await works.send()
        waiting = works.server.goals[0]
        works.jobs[0].end.set()
        await until(lambda: waiting.state.ended)
        with pytest.raises(NoHand, match="does not know the goal"):
            await goal.result(20)
        assert works.server.goals == []
        again = await works.send(goal_id=goal.id)  # as good as new
        assert again.id == goal.id


async def test_the_last_fifty_results_are_kept(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        first = await works.send()
        works.jobs[0].end.set()
        await first.result(20)
        for _ in range(50):
            goal = await works.send()
            works.jobs[-1].end.set()
            await goal.result(20)
        assert (await goal.result(20)).state is GoalState.SUCCEEDED
        assert len(works.server.goals) == 50
        with pytest.raises(NoHand, match="does not know"):
            await first.result(20)


async def test_too_many_goals_at_once(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        for _ in range(16):
            await works.send()
        with pytest.raises(GoalRejected):
            await works.send()
        await works.client.cancel()
        await until(lambda: all(one.state.ended for one in works.server.goals))
        await works.send()


async def test_everybody_who_waits_for_a_goal_gets_its_result(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        goal, states = await works.send(), list[GoalState]()

        async def follow() -> None:
            states.append((await goal.result(20)).state)

        async with anyio.create_task_group() as group:
            for _ in range(40):
                group.start_soon(follow)
            await until(lambda: works.server.goals[0].waiting == 40)
            works.jobs[0].end.set()
        assert states == [GoalState.SUCCEEDED] * 40


async def test_a_client_that_goes_leaves_its_goal(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        async with Context.open(settings, {}) as third:
            gone = ActionClient(third.node("gone"), "/gripper/cmd", GRIPPER)
            await gone.wait_for_server(20)
            goal = await gone.send_goal(gone.type.goal())
            async with anyio.create_task_group() as group:
                group.start_soon(goal.result)
                await until(lambda: works.server.goals[0].waiting == 1)
                group.cancel_scope.cancel()
        await works.here.context.graph.wait_until(
            lambda: not any(one.node.full == "/gone" for one in works.here.context.graph.entities())
        )
        assert works.server.goals[0].state is GoalState.EXECUTING
        assert await works.client.cancel() == (Refusal.NONE, [goal.id])


async def test_a_server_that_ends_tells_its_clients(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        goal = await works.send()
        ends: list[ActionOutcome] = []

        async def follow() -> None:
            ends.append(await goal.result(20))

        async with anyio.create_task_group() as group:
            group.start_soon(follow)
            await until(lambda: works.server.goals[0].waiting == 1)
            await works.server.finish()
        assert [one.state for one in ends] == [GoalState.ABORTED]
        with pytest.raises(NoHand, match="is gone"):
            await goal.result(20)
        assert not works.client.available


async def test_a_server_that_drops_a_request_is_not_gone(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        goal = await works.send()
        _, service = works.server._offered[0]._services
        service._limit = SharedLimit(0)
        with pytest.raises(NoHand, match="gives no result"):
            await goal.result(20)
        assert works.client.available


async def test_two_types_of_one_action(settings: Ros2Settings) -> None:
    async with working(settings) as works:
        known = works.there.context.interfaces

        async def accept(message: Any) -> Job:
            works.jobs.append(Job(message.command.position[0]))
            return works.jobs[-1]

        both = ActionServer(
            works.there,
            "/both",
            Offer(known.action(GRIPPER), works.accept),
            Offer(known.action(PARALLEL), accept),
        )
        simple = ActionClient(works.here, "/both", GRIPPER)
        parallel = ActionClient(works.here, "/both", PARALLEL)
        await simple.wait_for_server(20)
        await parallel.wait_for_server(20)
        asked = parallel.type.goal()
        asked.command.position = [0.04]
        goal = await parallel.send_goal(asked)
        other = await simple.send_goal(simple.type.goal())
        assert [job.position for job in works.jobs] == [0.04, 0.0]
        assert len(both.goals) == 2
        code, ids = await simple.cancel()
        assert (code, ids) == (Refusal.NONE, [goal.id, other.id])
        outcome = await goal.result(20)
        assert outcome.state is GoalState.CANCELED
        assert isinstance(outcome.result, parallel.type.result)
