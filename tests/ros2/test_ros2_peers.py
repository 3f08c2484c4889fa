"""A hand's node beside other implementations of ROS 2 over Zenoh, each in its own process.

`make ros2-peers` installs them, as `make test` does.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from anyio.streams.buffered import BufferedByteReceiveStream
from remote.serving import until

from rtee.actions.library import ActionLibrary
from rtee.errors import GoalRejected
from rtee.hand.config_schema import Distro, Ros2Settings
from rtee.hand.load import load_configured
from rtee.hand.model import Hand
from rtee.ros2 import ActionType, Context, Node
from rtee.ros2.action_client import ActionClient
from rtee.ros2.action_server import ActionServer, Offer, ServerGoal
from rtee.ros2.actions import ActionOutcome, GoalState, Refusal
from rtee.ros2.types import definitions, interfaces

from .facing import a_hand_in_ros

SCRIPTS = Path(__file__).parent / "peers"
PEERS = Path(__file__).parents[2] / ".ros2-peers"
STATES, COMMANDS = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
TRIGGER, SET = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
STRING = "std_msgs/msg/String"
FOLLOW = "control_msgs/action/FollowJointTrajectory"
GRIP = "control_msgs/action/GripperCommand"

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.skipif(
        not (PEERS / ".ready").exists(),
        reason="other implementations of ROS 2 are not installed: make ros2-peers",
    ),
]


@dataclass
class Peer:
    """A process of another implementation, which prints JSON."""

    lines: BufferedByteReceiveStream

    async def said(self) -> dict[str, Any]:
        """Return what it says next."""
        with anyio.fail_after(300):
            line = await self.lines.receive_until(b"\n", 1 << 20)
        found: dict[str, Any] = json.loads(line)
        return found


Open = Callable[..., AbstractAsyncContextManager[Peer]]


@asynccontextmanager
async def opened(script: str, definitions: Path, *words: str) -> AsyncIterator[Peer]:
    command = [sys.executable, "-W", "ignore", str(SCRIPTS / script), str(definitions), *words]
    more = {"PYTHONPATH": str(PEERS), "AMENT_PREFIX_PATH": str(definitions)}
    environment = {**os.environ, **more}
    async with await anyio.open_process(command, env=environment, stderr=None) as process:
        assert process.stdout is not None
        try:
            yield Peer(BufferedByteReceiveStream(process.stdout))
        finally:
            if process.returncode is None:
                process.kill()


def write_prefix(prefix: Path) -> None:
    """Write our definitions as ROS installs them, with descriptions and hashes."""
    known = interfaces("jazzy")
    for name, text in known.texts.items():
        package, kind, last = name.split("/")
        share = prefix / "share" / package
        (share / kind).mkdir(parents=True, exist_ok=True)
        (share / "package.xml").write_text(
            f'<package format="3"><name>{package}</name><version>0.0.0</version></package>'
        )
        (share / kind / f"{last}.{kind}").write_text(text)
        parts = {
            "msg": ("",),
            "srv": ("", "_Request", "_Response", "_Event"),
            "action": (
                *("", "_Goal", "_Result", "_Feedback", "_SendGoal", "_GetResult"),
                "_FeedbackMessage",
            ),
        }[kind]
        hashes = [
            {"type_name": name + part, "hash_string": known.hash(name + part)} for part in parts
        ]
        found = {"type_description_msg": known.description(name), "type_hashes": hashes}
        (share / kind / f"{last}.json").write_text(json.dumps(found))


@pytest.fixture(scope="session")
def prefix(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("prefix")
    write_prefix(folder)
    return folder


@pytest.fixture(scope="session")
def texts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("definitions")
    for name, text in definitions("jazzy").items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_name(f"{path.name}.{path.parent.name}").write_text(text)
    return folder


@pytest.fixture
def dora(prefix: Path, router: str, tmp_path: Path) -> Open:
    session = tmp_path / "session.json5"
    session.write_text(
        json.dumps(
            {
                "mode": "peer",
                "connect": {"endpoints": [router]},
                "listen": {"endpoints": ["tcp/localhost:0"]},
                "scouting": {"multicast": {"enabled": False}},
            }
        )
    )
    return lambda *words: opened("dora_peer.py", prefix, str(session), "peer", *words)


@pytest.fixture
def sdk(texts: Path, router: str) -> Open:
    port = router.rpartition(":")[2]
    return lambda *words: opened("sdk_peer.py", texts, port, *words)


@pytest.fixture(params=["dora", "sdk"])
def peer(request: pytest.FixtureRequest) -> Open:
    found: Open = request.getfixturevalue(request.param)
    return found


@pytest.fixture
async def node(settings: Ros2Settings) -> AsyncIterator[Node]:
    async with Context.open(settings, {}) as context:
        yield context.node("hand")


@pytest.mark.heavy
async def test_no_message_is_missed(peer: Open, node: Node) -> None:
    publisher = node.publisher("/numbers", STATES)

    async def count() -> None:
        number = 0
        while True:
            publisher.publish(publisher.type.message(name=["a"], position=[float(number)]))
            number += 1
            await anyio.sleep(0.01)

    node.context.start(count())
    async with peer("echo", "/numbers", STATES, "300") as other:
        assert await other.said() == {"ready": True}
        heard = (await other.said())["numbers"]
        assert heard == list(range(int(heard[0]), int(heard[0]) + 300))


async def test_another_hash_is_not_heard(peer: Open, router: str) -> None:
    """Humble has no hashes: a newer node hears nothing of it, and there is no error."""
    humble = Ros2Settings(router=router, distro=Distro.HUMBLE)
    async with Context.open(humble, {}) as context:
        publisher = context.node("old").publisher("/numbers", STATES)
        async with peer("echo", "/numbers", STATES, "1") as other:
            assert await other.said() == {"ready": True}
            for _ in range(20):
                publisher.publish(publisher.type.message(name=["a"], position=[1.0]))
                assert not publisher.heard
                await anyio.sleep(0.05)


async def test_a_service_is_called(peer: Open, node: Node) -> None:
    kind = node.context.interfaces.service(SET)

    async def answer(request: Any) -> Any:
        return kind.response(success=request.data, message="heard")

    node.service("~/set", kind, answer)
    async with peer("call", "/hand/set", SET, '{"data": true}') as other:
        assert await other.said() == {"response": {"success": True, "message": "heard"}}


async def test_a_service_of_theirs_is_called(peer: Open, node: Node) -> None:
    client = node.client("/theirs/set", SET)
    async with peer("serve", "/theirs/set", SET, '{"success": true, "message": "hi"}') as other:
        assert await other.said() == {"ready": True}
        await client.wait(300)
        answer = await client.call(client.type.request(data=True), 20)
        assert (answer.success, answer.message) == (True, "hi")


async def test_a_hand_is_stopped(
    dora: Open, hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with a_hand_in_ros(hand, library, settings):
        async with dora("echo", "/joint_states", STATES, "5") as other:
            assert await other.said() == {"ready": True}
            assert len((await other.said())["numbers"]) == 5
        # dora-rs sends no byte at all for a request without fields.
        async with dora("call", f"/{hand.name}/stop", TRIGGER, "{}") as other:
            assert (await other.said())["response"]["success"]


async def test_a_hand_is_moved(
    dora: Open, hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, _):
        goal = [0.02] * len(hand.actuator_names)  # inside the limits of all: rad and m
        fields = json.dumps({"data": goal})
        async with dora("publish", f"/{hand.name}/commands", COMMANDS, fields) as other:
            assert await other.said() == {"ready": True}
            await until(lambda: max(abs(served.loop.snapshot().position - np.array(goal))) < 0.01)


async def test_a_description_is_there_for_who_comes_late(
    dora: Open, hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with (
        a_hand_in_ros(hand, library, settings),
        dora("latched", "/robot_description", STRING, "data") as other,
    ):
        assert await other.said() == {"ready": True}
        assert (await other.said())["field"] == hand.urdf.text


async def test_a_hand_follows_a_trajectory_of_theirs(
    dora: Open, hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, _):
        name = hand.actuator_names[0]
        points = [
            {"positions": [value], "time_from_start": {"sec": 0, "nanosec": at}}
            for at, value in ((300_000_000, 0.01), (600_000_000, 0.02))
        ]
        fields = json.dumps({"trajectory": {"joint_names": [name], "points": points}})
        action = f"/{hand.name}/follow_joint_trajectory"
        async with dora("goal", action, FOLLOW, fields, "0") as other:
            assert await other.said() == {"accepted": True}
            said = await other.said()
        assert (said["feedback"] > 0, said["status"]) == (True, "succeeded")
        assert said["result"]["error_code"] == 0
        assert served.loop.snapshot().position[0] == pytest.approx(0.02, abs=1e-3)


async def test_a_gripper_is_closed_by_them(dora: Open, settings: Ros2Settings) -> None:
    folder = Path(__file__).parents[2] / "config" / "robotiq_2f_85"
    hand, _ = load_configured(folder)
    library = ActionLibrary.load(hand, folder / "actions")
    async with a_hand_in_ros(hand, library, settings):
        async with dora("goal", "/robotiq_2f_85/gripper_cmd", GRIP, command(0.03), "0") as other:
            assert await other.said() == {"accepted": True}
            said = await other.said()
        assert (said["status"], said["result"]["reached_goal"]) == ("succeeded", True)
        assert said["result"]["position"] == pytest.approx(0.03, abs=2e-3)


class Closing:
    """A job that takes two seconds, unless it is cancelled."""

    def __init__(self, kind: ActionType) -> None:
        self._kind, self._cancelled = kind, anyio.Event()

    async def run(self, goal: ServerGoal) -> ActionOutcome:
        for step in range(20):
            goal.feedback(position=0.1 - 0.004 * step)
            with anyio.move_on_after(0.1):
                await self._cancelled.wait()
                return ActionOutcome(GoalState.CANCELED, self._kind.result(position=0.06))
        return ActionOutcome(
            GoalState.SUCCEEDED, self._kind.result(position=0.02, reached_goal=True)
        )

    async def cancel(self) -> None:
        self._cancelled.set()


@pytest.fixture
async def gripper(node: Node) -> ActionServer:
    kind = node.context.interfaces.action(GRIP)

    async def accept(goal: Any) -> Closing:
        if goal.command.position < 0:
            raise GoalRejected("no opening is negative")
        return Closing(kind)

    return ActionServer(node, "~/gripper_cmd", Offer(kind, accept))


def command(position: float) -> str:
    return json.dumps({"command": {"position": position, "max_effort": 5.0}})


async def test_a_goal_of_theirs(dora: Open, gripper: ActionServer) -> None:
    async with dora("goal", gripper.name, GRIP, command(0.02), "0") as other:
        assert await other.said() == {"accepted": True}
        said = await other.said()
    assert (said["feedback"] > 0, said["status"]) == (True, "succeeded")
    assert (said["result"]["position"], said["result"]["reached_goal"]) == (0.02, True)
    assert [goal.state for goal in gripper.goals] == [GoalState.SUCCEEDED]


async def test_a_goal_of_theirs_is_refused(dora: Open, gripper: ActionServer) -> None:
    async with dora("goal", gripper.name, GRIP, command(-1.0), "0") as other:
        assert await other.said() == {"accepted": False}
    assert gripper.goals == []


async def test_a_goal_of_theirs_is_cancelled(dora: Open, gripper: ActionServer) -> None:
    async with dora("goal", gripper.name, GRIP, command(0.02), "3") as other:
        assert await other.said() == {"accepted": True}
        assert await other.said() == {"feedback": 3, "cancelled": Refusal.NONE}
        await until(lambda: [one.state for one in gripper.goals] == [GoalState.CANCELED])


@pytest.mark.parametrize("cancel", [False, True])
async def test_a_goal_for_theirs(dora: Open, node: Node, cancel: bool) -> None:
    told = {"position": 0.1, "effort": 1.0, "stalled": False, "reached_goal": False}
    words = (json.dumps(told), json.dumps({**told, "reached_goal": True}))
    client = ActionClient(node, "/theirs/gripper_cmd", GRIP)
    heard: list[Any] = []
    async with dora("act", "/theirs/gripper_cmd", GRIP, *words) as other:
        assert await other.said() == {"ready": True}
        await client.wait_for_server(20)
        wanted = node.context.interfaces.message("control_msgs/msg/GripperCommand")
        sent = client.type.goal(command=wanted(position=0.02, max_effort=5.0))
        goal = await client.send_goal(sent, heard.append, 20)
        assert (await other.said())["goal"]["command"]["position"] == 0.02
        await until(lambda: bool(heard))
        if cancel:
            assert await goal.cancel() is Refusal.NONE
        outcome = await goal.result(20)
    assert outcome.state is (GoalState.CANCELED if cancel else GoalState.SUCCEEDED)
    assert (outcome.result.reached_goal, heard[0].position) == (True, 0.1)
