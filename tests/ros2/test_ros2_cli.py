"""`rtee ros2`, beside a node in another thread."""

from __future__ import annotations

import json
import subprocess
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import anyio.from_thread
import pytest
from rtee_process import RTEE
from typer.testing import CliRunner

from rtee.cli._common import app_of
from rtee.cli.devices import doctor
from rtee.cli.ros2 import app
from rtee.drivers.diagnosis.checks import Verdict
from rtee.errors import ConfigError, GoalRejected, NoRouter, RemoteError
from rtee.hand.config_schema import Distro, Ros2Settings
from rtee.ros2 import LATCHED, ActionType, Context
from rtee.ros2.action_server import ActionServer, Offer
from rtee.ros2.actions import ActionOutcome, GoalState
from rtee.ros2.diagnosis import check_graph
from rtee.ros2.keys import Entity, Kind, NodeName
from rtee.ros2.listing import Sort, listed, unheard

from .conftest import free_endpoint

NAN = float("nan")


@asynccontextmanager
async def talking(settings: Ros2Settings) -> AsyncIterator[None]:
    """A node that publishes joint states and a description, and has a service."""
    async with Context.open(settings) as context:
        node = context.node("talker", "left")
        states, service = (
            context.interfaces.message("sensor_msgs/msg/JointState"),
            context.interfaces.service("std_srvs/srv/SetBool"),
        )

        async def handle(request: Any) -> Any:
            return service.response(success=request.data, message="heard")

        async def publish() -> None:
            publisher = node.publisher("joint_states", "sensor_msgs/msg/JointState")
            while True:
                publisher.publish(states(name=["a", "b"], position=[0.25, NAN]))
                await anyio.sleep(0.02)

        node.service("~/set", service, handle)
        text = context.interfaces.message("std_msgs/msg/String")
        description = node.publisher("robot_description", "std_msgs/msg/String", LATCHED)
        description.publish(text(data="<robot/>"))
        context.start(publish())
        kind = context.interfaces.action("control_msgs/action/GripperCommand")

        async def accept(goal: Any) -> Closing:
            if goal.command.position < 0:
                raise GoalRejected("no opening is negative")
            return Closing(kind)

        ActionServer(node, "~/gripper_cmd", Offer(kind, accept))
        yield


class Closing:
    """A job that tells feedback twice and ends; with force it fails."""

    def __init__(self, kind: ActionType) -> None:
        self._kind, self._cancelled = kind, anyio.Event()

    async def run(self, goal: Any) -> ActionOutcome:
        for position in (0.05, 0.03):
            goal.feedback(position=position)
            await anyio.sleep(0.05)
        if goal.goal.command.position > 1:  # farther than it opens: it tries for ever
            await self._cancelled.wait()
            CANCELLED.append(goal.id)
            return ActionOutcome(GoalState.CANCELED, self._kind.result())
        failed = goal.goal.command.max_effort > 100
        state = GoalState.ABORTED if failed else GoalState.SUCCEEDED
        return ActionOutcome(state, self._kind.result(position=0.02, reached_goal=not failed))

    async def cancel(self) -> None:
        self._cancelled.set()


CANCELLED: list[bytes] = []
"""Goals that were cancelled."""


@pytest.fixture
def talker(settings: Ros2Settings) -> Iterator[Callable[..., str]]:
    """Runs a command beside the talker and returns its output."""

    def run(*words: str) -> str:
        asked = ["--router", settings.router]
        result = CliRunner().invoke(app_of(app), [*words, *asked], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.output

    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(talking(settings)),
    ):
        yield run


def test_the_graph_is_listed(talker: Callable[..., str]) -> None:
    rows: dict[tuple[str, str], Any] = {}
    for _ in range(20):  # the talker has just come: the router may not know all of it yet
        rows = {(row["kind"], row["name"]): row for row in json.loads(talker("list", "--json"))}
        if len(rows) == 5:
            break
    assert set(rows) == {
        ("node", "/left/talker"),
        ("topic", "/left/joint_states"),
        ("topic", "/left/robot_description"),
        ("service", "/left/talker/set"),
        ("action", "/left/talker/gripper_cmd"),
    }
    assert rows["service", "/left/talker/set"]["type"] == "std_srvs/srv/SetBool"
    assert rows["topic", "/left/joint_states"]["offered"] == ["/left/talker"]
    table = talker("list", "services")
    assert "/left/talker/set" in table
    assert "joint_states" not in table


def test_messages_are_printed(talker: Callable[..., str]) -> None:
    message = json.loads(talker("echo", "/left/joint_states", "--count", "1", "--json"))
    assert (message["name"], message["position"]) == (["a", "b"], [0.25, None])
    texts = talker("echo", "left/joint_states", "--count", "2").split("---\n")
    assert len(texts) == 3
    assert "name: [a, b]\nposition: [0.25, .nan]\n" in texts[0]
    assert "<robot/>" in talker("echo", "/left/robot_description", "--count", "1")


def test_services_are_called(talker: Callable[..., str]) -> None:
    assert (
        talker("call", "/left/talker/set", "{data: true}")
        == "{success: true, message: heard}\n---\n"
    )
    said = talker("call", "/left/talker/set", "std_srvs/srv/SetBool", "data: false", "--json")
    assert json.loads(said) == {"success": False, "message": "heard"}


def test_goals_are_sent(talker: Callable[..., str]) -> None:
    said = talker("send-goal", "/left/talker/gripper_cmd", "{command: {position: 0.02}}")
    assert "position: 0.02" in said
    assert "reached_goal: true" in said
    lines = talker("send-goal", "left/talker/gripper_cmd", "--feedback", "--json").splitlines()
    assert json.loads(lines[-1])["reached_goal"] is True
    assert [json.loads(line)["position"] for line in lines[-2:]] == [0.03, 0.02]


def test_a_goal_that_fails_ends_with_status_1(talker: Callable[..., str]) -> None:
    with pytest.raises(AssertionError, match="reached_goal: false"):
        talker("send-goal", "/left/talker/gripper_cmd", "{command: {max_effort: 200}}")


def test_a_goal_that_takes_too_long_is_cancelled(talker: Callable[..., str]) -> None:
    CANCELLED.clear()
    words = ("send-goal", "/left/talker/gripper_cmd", "{command: {position: 2}}")
    with pytest.raises(RemoteError, match="has not ended after 1 s"):
        talker(*words, "--timeout", "1")
    assert len(CANCELLED) == 1


@pytest.mark.parametrize(
    ("words", "raised", "said"),
    [
        (["echo", "/left/joint_state"], ConfigError, "did you mean '/left/joint_states'"),
        (["echo", "/x", "std_msgs/msg/Strin"], Exception, "there is no type"),
        (["echo", "/x", "std_msgs/msg/String", "--timeout", "0.2"], RemoteError, "no message came"),
        (["call", "/left/talker/sett"], ConfigError, "did you mean '/left/talker/set'"),
        (["call", "/left/talker/set", "{dada: true}"], ConfigError, "'dada'; did you mean 'data'"),
        (
            ["send-goal", "/left/talker/gripper_cmd", "{command: {position: far}}"],
            ConfigError,
            "GripperCommand.position: a float64 expected",
        ),
        (["call", "/left/talker/set", "{data: [}"], ConfigError, "request"),
        (["call", "/x", "std_srvs/srv/Empty", "--timeout", "0.2"], RemoteError, "no node offers"),
        (
            ["call", "/left/talker/set", "std_srvs/srv/Trigger"],
            ConfigError,
            "has the type std_srvs/srv/SetBool, not std_srvs/srv/Trigger",
        ),
        (["send-goal", "/left/talker/grip"], ConfigError, "'/left/talker/gripper_cmd'"),
        (
            ["send-goal", "/left/talker/gripper_cmd", "{command: {position: -1}}"],
            GoalRejected,
            "refuses the goal",
        ),
        (["list", "things"], ConfigError, "nodes, topics, services or actions"),
        (["list", "--distro", "noetic"], ConfigError, "jazzy, kilted, rolling, humble"),
    ],
)
def test_mistakes_are_told(
    talker: Callable[..., str], words: list[str], raised: type[Exception], said: str
) -> None:
    with pytest.raises(raised, match=said):
        talker(*words)


def test_a_call_says_that_it_waits(settings: Ros2Settings) -> None:
    words = ["call", "/x", "std_srvs/srv/Empty", "--timeout", "0.2", "--router", settings.router]
    result = CliRunner().invoke(app_of(app), words)
    assert isinstance(result.exception, RemoteError)
    assert result.output == "rtee: waiting: no node offers the service /x\n"


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("ROS_DOMAIN_ID", "abc"),
        ("ZENOH_SESSION_CONFIG_URI", "/nowhere"),
        ("ZENOH_CONFIG_OVERRIDE", "mode"),
        ("ZENOH_ROUTER_CHECK_ATTEMPTS", "often"),
    ],
)
def test_a_bad_variable_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str
) -> None:
    monkeypatch.setenv(variable, value)
    words = [*RTEE, "ros2", "serve", "robotiq_2f_85"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert variable in done.stderr


def test_a_router_that_is_not_there_is_told() -> None:
    with pytest.raises(NoRouter, match="no router of ROS 2 at"):
        CliRunner().invoke(
            app_of(app), ["list", "--router", free_endpoint()], catch_exceptions=False
        )


def test_a_stand_in_router_brings_nodes_together() -> None:
    place = free_endpoint()
    command = [*RTEE, "ros2", "router", "--listen", place]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == f"router of ROS 2 at {place}\n"
            result = CliRunner().invoke(app_of(app), ["list", "--router", place, "--json"])
            assert (result.exit_code, json.loads(result.output)) == (0, [])
        finally:
            process.terminate()


def test_a_router_for_everybody_is_refused() -> None:
    with pytest.raises(ConfigError, match="listen on tcp/localhost:PORT"):
        CliRunner().invoke(
            app_of(app), ["router", "--listen", "tcp/0.0.0.0:0"], catch_exceptions=False
        )


def entity(kind: Kind, node: str, topic: str = "", type_: str = "", type_hash: str = "") -> Entity:
    return Entity("0", "z", "0", "1", kind, NodeName(node), topic, type_, type_hash)


def test_who_does_not_hear_is_told() -> None:
    kind, action = "sensor_msgs/msg/JointState", "control_msgs/action/GripperCommand_SendGoal"
    rows = listed(
        [
            entity(Kind.PUBLISHER, "hand", "/joint_states", kind, "RIHS01_1"),
            entity(Kind.SUBSCRIPTION, "rviz", "/joint_states", kind, "RIHS01_1"),
            entity(Kind.SUBSCRIPTION, "old", "/joint_states", kind, "RIHS01_2"),
            entity(Kind.SUBSCRIPTION, "odd", "/joint_states", "std_msgs/msg/String", "RIHS01_3"),
            entity(Kind.SUBSCRIPTION, "waits", "/later", kind, "RIHS01_2"),
            entity(Kind.SERVICE, "hand", "/hand/gripper_cmd/_action/send_goal", action, "RIHS01_4"),
            entity(
                Kind.CLIENT, "moveit", "/hand/gripper_cmd/_action/send_goal", action, "RIHS01_5"
            ),
        ]
    )
    assert [(row.name, row.type) for row in rows if row.sort is Sort.ACTION] == [
        ("/hand/gripper_cmd", "control_msgs/action/GripperCommand")
    ] * 2
    said = unheard(rows)
    assert len(said) == 3
    assert "/old asks for the topic /joint_states with another hash (RIHS01_2, not" in said[0]
    assert "/odd asks for the topic /joint_states as std_msgs/msg/String, not" in said[1]
    assert "/moveit asks for the action /hand/gripper_cmd with another hash" in said[2]


@pytest.mark.anyio
async def test_doctor_tells_who_hears_nothing(settings: Ros2Settings) -> None:
    humble = Ros2Settings(router=settings.router, distro=Distro.HUMBLE)
    async with talking(settings), Context.open(humble) as old:
        kind = "sensor_msgs/msg/JointState"
        old.node("old").subscription("/left/joint_states", kind, lambda message: None)
        async with Context.open(settings) as own:
            await own.graph.wait_until(lambda: len(own.graph.nodes()) == 2)
            await own.graph.wait_until(
                lambda: len(own.graph.of(Kind.SUBSCRIPTION, "/left/joint_states")) == 1
            )
        found = {check.subject: check for check in await check_graph(settings, "gripper")}
    assert found["nodes"].text == "2: /left/talker, /old"
    assert found["hand"].remedy == "start it: rtee run gripper --ros2"
    assert "/old asks for the topic /left/joint_states with another hash" in found["types"].text


@pytest.mark.anyio
async def test_doctor_tells_that_the_router_is_missing() -> None:
    (found,) = await check_graph(Ros2Settings(router=free_endpoint()))
    assert found.verdict is Verdict.WRONG
    assert "rtee ros2 router" in found.remedy


def test_doctor_looks_at_the_graph(settings: Ros2Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", f'connect/endpoints=["{settings.router}"]')
    result = CliRunner().invoke(app_of(doctor), ["--ros2", "--json"], catch_exceptions=False)
    checks = {check["subject"]: check for check in json.loads(result.output)["ROS 2"]}
    assert (checks["router"]["verdict"], checks["nodes"]["text"]) == ("ok", "none")
