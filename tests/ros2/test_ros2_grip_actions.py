"""A hand's actions ``gripper_cmd`` and ``grasp``, as other nodes of ROS 2 call them."""

from __future__ import annotations

import logging
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
import pytest
from msgspec import structs
from remote.serving import Served, serving, until

from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError, GoalRejected
from rtee.hand.config_schema import GripperUnit, Ros2Settings
from rtee.hand.load import load_configured
from rtee.hand.model import Hand
from rtee.remote.client import connect
from rtee.ros2 import interfaces
from rtee.ros2.action_client import ActionClient
from rtee.ros2.actions import ActionOutcome, GoalState, Refusal
from rtee.ros2.diagnosis import check_graph
from rtee.ros2.grip_actions import GripCommand, is_stalled, joint_goal, joint_of
from rtee.ros2.hand_goals import goal_in, reason_of, state_of
from rtee.ros2.serving import Shown
from rtee.types import Aim, Force, Intensity, Named, Opening, Result

from .facing import Robot, a_hand_in_ros, facing
from .facing import robot as robot_of

pytestmark = pytest.mark.anyio

CONFIG = Path(__file__).parents[2] / "config"
NAME = "robotiq_2f_85"
SIMPLE = "control_msgs/action/GripperCommand"
PARALLEL = "control_msgs/action/ParallelGripperCommand"
GRASP = "rtee_msgs/action/Grasp"


@asynccontextmanager
async def a_gripper(settings: Ros2Settings) -> AsyncIterator[tuple[Served, Robot]]:
    hand, _ = load_configured(CONFIG / NAME)
    library = ActionLibrary.load(hand, CONFIG / NAME / "actions")
    async with a_hand_in_ros(hand, library, settings) as got:
        yield got


async def client_of(robot: Robot, action: str, kind: str) -> ActionClient:
    client = ActionClient(robot.node, action, kind)
    await client.wait_for_server(20)
    return client


def simple_goal(client: ActionClient, position: float, effort: float = 0.0) -> Any:
    goal = client.type.goal()
    goal.command.position, goal.command.max_effort = position, effort
    return goal


def parallel_goal(client: ActionClient, **fields: Any) -> Any:
    goal = client.type.goal()
    for name, value in fields.items():
        setattr(goal.command, name, value)
    return goal


async def set_parameter(robot: Robot, name: str, **value: Any) -> str:
    """Set a parameter of the gripper's node; return why it refuses."""
    asked = robot.context.interfaces.message("rcl_interfaces/msg/Parameter")(name=name)
    for field, content in value.items():
        setattr(asked.value, field, content)
    kind = "rcl_interfaces/srv/SetParametersAtomically"
    answer = await robot.call(f"/{NAME}/set_parameters_atomically", kind, parameters=[asked])
    return str(answer.result.reason)


async def test_the_gap_in_metres(settings: Ros2Settings) -> None:
    async with a_gripper(settings) as (served, robot):
        client = await client_of(robot, f"/{NAME}/gripper_cmd", SIMPLE)
        heard: list[Any] = []
        goal = await client.send_goal(simple_goal(client, 0.03, 50.0), heard.append)
        outcome = await goal.result(30)
        assert outcome.state is GoalState.SUCCEEDED
        assert (outcome.result.reached_goal, outcome.result.stalled) == (True, False)
        assert outcome.result.position == pytest.approx(0.03, abs=2e-3)
        asked = served.watcher.goals[-1]
        assert (asked.to, asked.effort) == (Opening(0.03), Force(50.0))
        assert heard
        assert not heard[-1].reached_goal
        # As wide as it goes, and a little more, as planners round.
        widest = await client.send_goal(simple_goal(client, 0.0865))
        outcome = await widest.result(30)
        assert outcome.result.reached_goal
        assert outcome.result.position == pytest.approx(0.086, abs=2e-3)


async def test_more_force_than_the_hand_has_is_all_that_it_has(settings: Ros2Settings) -> None:
    """``max_effort`` is a bound: MoveIt's examples give 100 N for any gripper."""
    async with a_gripper(settings) as (served, robot):
        client = await client_of(robot, f"/{NAME}/gripper_cmd", SIMPLE)
        outcome = await (await client.send_goal(simple_goal(client, 0.03, 900.0))).result(30)
        assert outcome.result.reached_goal
        assert served.watcher.goals[-1].force.value == pytest.approx(222.0, rel=0.01)
        parallel = await client_of(robot, f"/{NAME}/gripper_cmd", PARALLEL)
        asked = parallel_goal(parallel, name=["finger_joint"], position=[0.4], effort=[900.0])
        outcome = await (await parallel.send_goal(asked)).result(30)
        assert outcome.result.reached_goal
        [(joint, effort)] = served.watcher.goals[-1].effort.items()
        assert joint == "finger_joint"
        assert 0.0 < effort < 900.0


async def test_an_object_in_the_way(settings: Ros2Settings) -> None:
    async with a_gripper(settings) as (served, robot):
        served.driver.place_object("finger_joint", 0.5)
        client = await client_of(robot, f"/{NAME}/gripper_cmd", SIMPLE)
        outcome = await (await client.send_goal(simple_goal(client, 0.0, 60.0))).result(30)
        assert outcome.state is GoalState.SUCCEEDED  # it is held
        assert (outcome.result.reached_goal, outcome.result.stalled) == (False, True)
        width = outcome.result.position
        assert 0.02 < width < 0.07
        assert outcome.result.effort == pytest.approx(60.0, rel=0.3)
        grasp = await client_of(robot, f"/{NAME}/grasp", GRASP)
        asked = grasp.type.goal(grasp=True, opening=[width], force=[40.0])
        outcome = await (await grasp.send_goal(asked)).result(30)
        assert outcome.state is GoalState.SUCCEEDED
        assert (outcome.result.grasped, outcome.result.within) == (True, True)
        assert outcome.result.opening[0] == pytest.approx(width, abs=3e-3)


async def test_what_a_gripper_refuses(
    settings: Ros2Settings, caplog: pytest.LogCaptureFixture
) -> None:
    async with a_gripper(settings) as (served, robot):
        simple = await client_of(robot, f"/{NAME}/gripper_cmd", SIMPLE)
        parallel = await client_of(robot, f"/{NAME}/gripper_cmd", PARALLEL)
        refused = [
            (simple, simple_goal(simple, math.nan), "the position must be a finite number"),
            (simple, simple_goal(simple, 0.2), "beyond the widest opening, 8"),
            (simple, simple_goal(simple, 0.03, -1.0), "the effort must be 0"),
            (parallel, parallel_goal(parallel), "takes one position"),
            (
                parallel,
                parallel_goal(parallel, name=["finger"], position=[0.1]),
                "no actuator 'finger'",
            ),
        ]
        for client, goal, reason in refused:
            caplog.clear()
            with pytest.raises(GoalRejected):
                await client.send_goal(goal)
            assert reason in caplog.text
        assert served.watcher.goals == []


async def test_a_joint_value(settings: Ros2Settings) -> None:
    settings = structs.replace(settings, gripper_joint="finger_joint")
    async with a_gripper(settings) as (served, robot):
        client = await client_of(robot, f"/{NAME}/gripper_cmd", SIMPLE)
        outcome = await (await client.send_goal(simple_goal(client, 0.4, 5.0))).result(30)
        assert outcome.state is GoalState.SUCCEEDED
        assert outcome.result.position == pytest.approx(0.4, abs=0.02)
        assert served.watcher.goals[-1].effort == {"finger_joint": 5.0}
        # A name comes before the parameter.
        parallel = await client_of(robot, f"/{NAME}/gripper_cmd", PARALLEL)
        asked = parallel_goal(parallel, name=["opening"], position=[0.05], effort=[60.0])
        outcome = await (await parallel.send_goal(asked)).result(30)
        assert outcome.result.reached_goal
        assert list(outcome.result.state.name) == ["opening"]
        assert outcome.result.state.position[0] == pytest.approx(0.05, abs=2e-3)
        goal = served.watcher.goals[-1]
        assert (goal.to, goal.effort) == (Opening(0.05), Force(60.0))


async def test_a_gripper_as_moveit_and_ros2_control_have_it(
    settings: Ros2Settings, caplog: pytest.LogCaptureFixture
) -> None:
    moveit = structs.replace(settings, gripper=GripperUnit.MOVEIT)
    async with a_gripper(moveit) as (served, robot):
        client = await client_of(robot, f"/{NAME}/gripper_cmd", SIMPLE)
        closed = await (await client.send_goal(simple_goal(client, 0.7))).result(30)
        assert closed.result.position == pytest.approx(0.7, abs=0.02)
        opened = await (await client.send_goal(simple_goal(client, 0.0))).result(30)
        assert opened.result.position == pytest.approx(0.0, abs=0.02)
        [check] = [c for c in await check_graph(moveit, NAME) if c.subject == "gripper"]
        assert "positions are joint values, as from MoveIt" in check.text
        # An object stops it: succeeded, unless it is to be as by default in ros2_control.
        served.driver.place_object("finger_joint", 0.5)
        for allowed, state in ((True, GoalState.SUCCEEDED), (False, GoalState.ABORTED)):
            name = "gripper.allow_stalling"
            assert not await set_parameter(robot, name, type=1, bool_value=allowed)
            outcome = await (await client.send_goal(simple_goal(client, 0.8, 5.0))).result(30)
            assert (outcome.state, outcome.result.stalled) == (state, True)
            await (await client.send_goal(simple_goal(client, 0.0))).result(30)


async def test_a_joint_value_is_no_gap(
    settings: Ros2Settings, caplog: pytest.LogCaptureFixture
) -> None:
    async with a_gripper(settings) as (_, robot):
        robot.node = robot.context.node("move_group")
        client = await client_of(robot, f"/{NAME}/gripper_cmd", SIMPLE)
        with pytest.raises(GoalRejected):
            await client.send_goal(simple_goal(client, 0.8))
        assert "if it is the value of 'finger_joint', as MoveIt sends it" in caplog.text
        [check] = [c for c in await check_graph(settings, NAME) if c.subject == "gripper"]
        assert "/move_group seems to be MoveIt" in check.text


def test_moveit_needs_to_know_the_joint_of_several(settings: Ros2Settings) -> None:
    moveit = structs.replace(settings, gripper=GripperUnit.MOVEIT)
    with pytest.raises(ConfigError, match="3 actuators; name the gripper's"):
        joint_of(moveit, ("near", "thumb", "push"))


async def test_a_joint_that_the_hand_does_not_have(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    settings = structs.replace(settings, gripper_joint="nera")
    with pytest.raises(ExceptionGroup) as caught:
        async with a_hand_in_ros(hand, library, settings):
            pass
    assert caught.group_contains(ConfigError, match="no actuator 'nera'; did you mean")


async def test_cancel_holds_and_a_new_goal_replaces(settings: Ros2Settings) -> None:
    async with a_gripper(settings) as (_, robot):
        client = await client_of(robot, f"/{NAME}/gripper_cmd", PARALLEL)
        slow = parallel_goal(client, position=[0.0], velocity=[0.005])
        goal = await client.send_goal(slow)
        assert await goal.cancel() is Refusal.NONE
        outcome = await goal.result(30)
        assert outcome.state is GoalState.CANCELED
        assert not outcome.result.reached_goal
        first = await client.send_goal(slow)
        second = await client.send_goal(parallel_goal(client, position=[0.07]))
        assert (await first.result(30)).state is GoalState.ABORTED
        assert (await second.result(30)).state is GoalState.SUCCEEDED
        async with connect(NAME) as other:
            async with other.lease():
                with pytest.raises(GoalRejected):
                    await client.send_goal(slow)
            third = await client.send_goal(slow)
            # What another one stops is nothing that this client has cancelled.
            await other.stop()
            assert (await third.result(30)).state is GoalState.ABORTED


async def test_a_hand_that_goes_aborts_its_goal(
    hand: Hand,
    library: ActionLibrary,
    settings: Ros2Settings,
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def run() -> None:
        async with serving(hand, library):
            await end.wait()

    caplog.set_level(logging.INFO)
    end = anyio.Event()
    async with (
        anyio.create_task_group() as group,
        facing(Shown("small", settings, configured=hand)),
        robot_of(settings) as robot,
    ):
        group.start_soon(run)
        client = await client_of(robot, "/small/grasp", GRASP)
        goal = await client.send_goal(client.type.goal(action="fist", speed=0.01))
        ends: list[ActionOutcome] = []

        async def follow() -> None:
            ends.append(await goal.result(30))

        group.start_soon(follow)
        await until(lambda: goal.state is GoalState.EXECUTING)
        end.set()
        await until(lambda: bool(ends))
    assert ends[0].state is GoalState.ABORTED
    assert "a goal of /small/grasp was aborted: " in caplog.text


async def test_a_grasp_has_all_that_a_goal_has(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        client = await client_of(robot, "/small/grasp", GRASP)
        heard: list[Any] = []
        asked = client.type.goal(
            action="wave", kind="timed", timeout=[20.0], effort_name=["near"], effort=[1.5]
        )
        outcome = await (await client.send_goal(asked, heard.append)).result(30)
        assert outcome.state is GoalState.SUCCEEDED
        result = outcome.result
        assert (result.action, result.reached) == ("wave", True)
        assert list(result.position_name) == list(hand.actuator_names)
        assert len(result.opening) == 0
        assert list(heard[-1].inner_name) == ["up", "side"]
        goal = served.watcher.goals[-1]
        assert (goal.timeout, goal.effort, goal.to) == (20.0, {"near": 1.5}, Intensity())
        asked = client.type.goal(
            action="PinchTight",
            elements=["thumb", "index"],
            intensity=0.5,
            contact_finger=[""],
            on_contact=["hold"],
            speed=0.5,
            tolerance=0.02,
        )
        outcome = await (await client.send_goal(asked)).result(30)
        assert list(outcome.result.position) == pytest.approx([0.5, 0.4, 0.0], abs=0.03)
        assert served.watcher.goals[-1].on_contact == {"": "hold"}


async def test_what_a_grasp_refuses(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings, caplog: pytest.LogCaptureFixture
) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        client = await client_of(robot, "/small/grasp", GRASP)
        for fields, reason in (
            ({"action": "fits"}, "did you mean"),
            ({"action": "fist", "intensity": math.nan}, "the intensity must be 0 to 1"),
            ({"opening": [0.03], "grasp": True}, "opening"),
        ):
            caplog.clear()
            with pytest.raises(GoalRejected):
                await client.send_goal(client.type.goal(**fields))
            assert "a goal of /small/grasp is refused: " in caplog.text
            assert reason in caplog.text
        assert served.watcher.goals == []


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"stage": "half"}, "stage 'half' must be both"),
        ({"on_contact": ["hold"]}, "on_contact: 0 names for 1 values"),
        ({"contact_finger": ["thumb"], "on_contact": ["hit"]}, "on_contact 'hit' must be stop"),
        ({"effort_name": ["near", "near"], "effort": [1.0, 2.0]}, "effort: a name occurs twice"),
    ],
)
def test_a_grasp_that_is_none(fields: dict[str, Any], reason: str) -> None:
    made = interfaces().action(GRASP).goal(action="fist", **fields)
    with pytest.raises(GoalRejected, match=reason):
        goal_in(made)


async def test_the_parameters_of_a_gripper(settings: Ros2Settings) -> None:
    async with a_gripper(settings) as (served, robot):

        async def put(name: str, value: str) -> str:
            return await set_parameter(robot, name, type=4, string_value=value)

        assert "no actuator 'finger_join'" in await put("gripper.joint", "finger_join")
        assert not await put("gripper.action", "PinchTight finger_1 finger_2")
        client = await client_of(robot, f"/{NAME}/gripper_cmd", SIMPLE)
        outcome = await (await client.send_goal(simple_goal(client, 0.05))).result(30)
        assert outcome.result.position == pytest.approx(0.05, abs=2e-3)
        goal = served.watcher.goals[-1]
        assert goal.what == Named("PinchTight", ("finger_1", "finger_2"))
        assert not await put("gripper.action", "pinch_tight finger_2 finger_1")
        outcome = await (await client.send_goal(simple_goal(client, 0.03, 900.0))).result(30)
        assert outcome.result.reached_goal, "more force than it has is all that it has"
        assert served.watcher.goals[-1].force.value == pytest.approx(222.0, rel=0.01)
        assert not await put("gripper.joint", "finger_joint")
        outcome = await (await client.send_goal(simple_goal(client, 0.3))).result(30)
        assert outcome.result.position == pytest.approx(0.3, abs=0.02)
        assert isinstance(served.watcher.goals[-1].to, Intensity)


async def test_a_command_of_ros_end_effector(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings, caplog: pytest.LogCaptureFixture
) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        client = await client_of(robot, "/action_command", "rosee_msg/action/ROSEECommand")
        control = robot.context.interfaces.message("rosee_msg/msg/ROSEEActionControl")
        for fields, done in (
            (
                {
                    "action_name": "pinchTight",
                    "selectable_items": ["index", "thumb"],
                    "percentage": 0.5,
                },
                (Named("PinchTight", ("index", "thumb"), "primitive"), 0.5),
            ),
            ({"action_name": "fist", "action_type": 2, "percentage": 0.2}, (Named("fist"), 0.2)),
            ({"action_name": "wave", "action_type": 3}, (Named("wave", kind="timed"), 1.0)),
        ):
            heard: list[Any] = []
            asked = control(**fields)
            goal = await client.send_goal(client.type.goal(goal_action=asked), heard.append)
            outcome = await goal.result(30)
            assert outcome.state is GoalState.SUCCEEDED
            assert outcome.result.completed_action == asked
            got = served.watcher.goals[-1]
            assert (got.what, got.to) == (done[0], Intensity(done[1]))
        assert {one.action_name_current for one in heard} >= {"side"}
        assert max(one.completation_percentage for one in heard) > 50.0
        fist = {"action_name": "fist", "action_type": 2}
        efforts = {"optional_motors_names": ["near", "thumb"]}
        asked = control(**fist, **efforts, optional_motors_commands=[1.5, 0.0], percentage=0.3)
        goal = await client.send_goal(client.type.goal(goal_action=asked))
        assert (await goal.result(30)).state is GoalState.SUCCEEDED
        assert served.watcher.goals[-1].effort == {"near": 1.5}
        # Like there, every goal is accepted, and what cannot be done is aborted.
        caplog.set_level(logging.INFO)
        for fields, reason in (
            ({"action_name": "fist", "action_type": 4}, "action_type 4 is unknown"),
            ({"action_name": "hook", "action_type": 2}, "unknown action 'hook'"),
            (fist | {"percentage": 40.0}, "must be 0 to 1"),
            (fist | efforts | {"optional_motors_commands": [1.0]}, "needs 2 numbers"),
        ):
            asked = control(**fields)
            goal = await client.send_goal(client.type.goal(goal_action=asked))
            outcome = await goal.result(30)
            assert (outcome.state, outcome.result.completed_action) == (GoalState.ABORTED, asked)
            assert reason in caplog.text


@pytest.mark.parametrize(
    ("grasped", "velocity", "stalled"),
    [
        ([True, False], [0.01, 0.0], True),
        ([True, False], [0.5, 0.0], False),  # it is blocked, but still closing in on the object
        ([True, False], [0.0, -0.5], False),
        ([True, False], [math.nan, math.nan], True),
        ([False, False], [0.0, 0.0], False),
    ],
)
def test_what_is_stalled(grasped: list[bool], velocity: list[float], stalled: bool) -> None:
    state: Any = SimpleNamespace(grasped=np.array(grasped), velocity=np.array(velocity))
    assert is_stalled(state, [2.0, 2.0]) is stalled


def test_the_action_that_moves_a_joint(library: ActionLibrary, hand: Hand) -> None:
    near = hand.actuators[0]
    goal = joint_goal(GripCommand("near", 0.75, speed=1.5), near, library.all())
    assert (goal.what, goal.to) == (Named("Trig", ("index",), "primitive"), Intensity(0.5))
    assert (goal.speed, goal.effort) == (0.5, {})
    with pytest.raises(GoalRejected, match="the effort must be 0"):
        GripCommand("near", 0.5, math.nan)
    with pytest.raises(GoalRejected, match="the velocity must be 0"):
        GripCommand("near", 0.5, speed=-1.0)
    with pytest.raises(GoalRejected, match=r"bring 'near' from 0 to 1.5, not to -0.3"):
        joint_goal(GripCommand("near", -0.3), near, library.all())


@pytest.mark.parametrize(
    ("result", "state", "reason"),
    [
        (Result("1", "a", reached=True), GoalState.SUCCEEDED, ""),
        (Result("1", "a", stalled=True, grasped=True), GoalState.SUCCEEDED, ""),
        (Result("1", "a", stalled=True), GoalState.ABORTED, "holds nothing"),
        (Result("1", "a", touched=("thumb",), aim=Aim.CONTACT), GoalState.SUCCEEDED, ""),
        (Result("1", "a", reached=True, aim=Aim.CONTACT), GoalState.ABORTED, "nothing was touched"),
        (Result("1", "a", cancelled=True, reached=True), GoalState.CANCELED, ""),
        (Result("1", "a", preempted=True), GoalState.ABORTED, "a new goal"),
        (Result("1", "a", timed_out=True, duration=3.0), GoalState.ABORTED, "3 s"),
        (Result("1", "a", aborted=True, reason="a fault"), GoalState.ABORTED, "a fault"),
    ],
)
def test_how_goals_end(result: Result, state: GoalState, reason: str) -> None:
    assert state_of(result) is state
    told = reason_of(result)
    assert reason in told
    assert bool(told) is (state is GoalState.ABORTED)
