"""Hands and routers that come and go, and runs that are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import anyio
import pytest
from msgspec import structs
from remote.serving import make_hand, make_library, serving, until
from rtee_process import RTEE

import rtee.ros2.serving
from rtee.actions.library import ActionLibrary
from rtee.hand.config_schema import Ros2Settings
from rtee.hand.model import Hand
from rtee.loop import shutdown_signals
from rtee.loop.shutdown_signals import companion
from rtee.remote.directory import hands_running
from rtee.ros2.action_client import ActionClient
from rtee.ros2.actions import GoalState
from rtee.ros2.keys import Kind
from rtee.ros2.qos import LATCHED
from rtee.ros2.served_hand import ServedHand
from rtee.ros2.serving import Shown

from .conftest import free_endpoint, open_router
from .facing import a_hand_in_ros, facing, robot
from .test_ros2_setpoints import KNOWN, trajectory

pytestmark = pytest.mark.anyio

JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"


async def test_a_hand_that_goes_and_comes_back(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    shown = Shown(hand.name, settings, configured=hand)
    async with facing(shown), robot(settings) as others:
        for _ in range(2):
            async with serving(hand, library):
                await others.sees(shown.node)
                assert await others.listen("/joint_states", JOINT_STATE)
            await others.sees(shown.node, there=False)
            assert not others.names(Kind.PUBLISHER)
            assert not others.names(Kind.SERVICE)


async def test_two_hands_are_two_nodes_of_one_session(
    settings: Ros2Settings, tmp_path: Path
) -> None:
    hands = [make_hand(tmp_path, name) for name in ("one", "two")]
    shown = [
        Shown(h.name, Ros2Settings(router=settings.router, namespace=h.name), configured=h)
        for h in hands
    ]
    one, two = hands
    async with serving(one, make_library(one)), facing(*shown), robot(settings) as others:
        async with serving(two, make_library(two)):
            for each in shown:
                await others.sees(each.node)
            found = [e for e in others.context.graph.entities() if e.kind is Kind.NODE]
            sessions = {e.session for e in found if e.node.full in {s.node for s in shown}}
            assert len(sessions) == 1
            for name in ("one", "two"):
                assert await others.listen(f"/{name}/joint_states", JOINT_STATE)
        await others.sees(shown[1].node, there=False)
        assert await others.listen("/one/joint_states", JOINT_STATE)


async def test_a_router_that_comes_late_and_goes(
    hand: Hand, library: ActionLibrary, caplog: pytest.LogCaptureFixture
) -> None:
    settings = Ros2Settings(router=free_endpoint())
    shown = Shown(hand.name, settings, configured=hand)
    async with serving(hand, library) as served, facing(shown):
        await until(lambda: "no router of ROS 2" in caplog.text)
        ticks = served.watcher.ticks
        await until(lambda: served.watcher.ticks > ticks + 5)
        for _ in range(2):
            with await anyio.to_thread.run_sync(open_router, settings.router):
                async with robot(settings) as others:
                    await others.sees(shown.node)
                    told = await others.listen("/robot_description", STRING, LATCHED)
                    assert told[0].data == hand.urdf.text


class Broken:
    """A part of one hand's node that fails in a way nobody has thought of, once."""

    failed = 0

    def __init__(self, served: ServedHand) -> None:
        self._fails = served.hand.name == "one" and not Broken.failed

    def parameters(self) -> tuple[()]:
        return ()

    async def run(self) -> None:
        if self._fails:
            Broken.failed += 1
            raise ZeroDivisionError("nobody has thought of this")
        await anyio.sleep_forever()


async def test_a_node_that_fails_is_made_anew_and_others_go_on(
    settings: Ros2Settings,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    Broken.failed = 0
    monkeypatch.setattr(rtee.ros2.serving, "PARTS", (*rtee.ros2.serving.PARTS, Broken))
    monkeypatch.setattr(rtee.ros2.serving, "_AFTER_FAILURE", 0.1)
    hands = [make_hand(tmp_path, name) for name in ("one", "two")]
    shown = [
        Shown(h.name, structs.replace(settings, namespace=h.name), configured=h) for h in hands
    ]
    one, two = hands
    async with (
        serving(one, make_library(one)),
        serving(two, make_library(two)),
        facing(*shown),
        robot(settings) as others,
    ):
        await until(lambda: Broken.failed == 1)
        for name in ("two", "one"):
            assert await others.listen(f"/{name}/joint_states", JOINT_STATE)
    assert "the node of one has failed" in caplog.text


async def test_a_companion_that_ends_is_told(caplog: pytest.LogCaptureFixture) -> None:
    await companion((sys.executable, "-c", "raise SystemExit(2)"))
    assert "has ended with status 2; the hand goes on" in caplog.text
    caplog.clear()
    await companion((sys.executable, "-c", ""))
    assert not caplog.text


async def test_a_goal_goes_on_without_the_router(hand: Hand, library: ActionLibrary) -> None:
    """Sessions on one computer exchange messages directly once they know each other."""
    settings = Ros2Settings(router=free_endpoint())
    router = await anyio.to_thread.run_sync(open_router, settings.router)
    with router:
        async with a_hand_in_ros(hand, library, settings) as (served, others):
            client = ActionClient(others.node, "/small/grasp", "rtee_msgs/action/Grasp")
            await client.wait_for_server(20)
            goal = await client.send_goal(client.type.goal(action="fist", speed=0.2))
            await until(lambda: bool(served.watcher.goals))
            await anyio.to_thread.run_sync(router.close)
            assert (await goal.result(30)).state is GoalState.SUCCEEDED


def configured(folder: Path, router: str) -> Path:
    """Write a small hand that is a node of ROS 2; return its folder."""
    folder.mkdir(parents=True)
    hand = make_hand(folder)
    make_library(hand, folder / "actions")
    (folder / "hand.yaml").write_text(
        "name: small\nurdf: small.urdf\nsrdf: small.srdf\n"
        f"ros2: {{enabled: true, router: {router}, namespace: left}}\n"
    )
    return folder


@pytest.mark.heavy
async def test_a_trajectory_survives_a_stall_of_the_hand(
    settings: Ros2Settings, tmp_path: Path
) -> None:
    """The set-points of half a second came at once, and were refused as too many."""
    folder = configured(tmp_path / "config" / "small", settings.router)
    run = await anyio.open_process([*RTEE, "run", str(folder), "--no-log"])
    async with run, robot(settings) as others:
        client = ActionClient(
            others.node,
            "/left/small/follow_joint_trajectory",
            KNOWN.action("control_msgs/action/FollowJointTrajectory"),
        )
        await client.wait_for_server(300)
        message = client.type.goal(trajectory=trajectory(["thumb"], (1.5, [0.8])))
        goal = await client.send_goal(message)
        await anyio.sleep(0.5)
        hand = hands_running()["small"].pid
        os.kill(hand, signal.SIGSTOP)
        await anyio.sleep(0.4)
        os.kill(hand, signal.SIGCONT)
        outcome = await goal.result(30)
        os.kill(hand, signal.SIGTERM)
    result: Any = outcome.result
    assert outcome.state is GoalState.SUCCEEDED, result.error_string


async def test_a_run_that_is_killed_leaves_nothing(settings: Ros2Settings, tmp_path: Path) -> None:
    folder = configured(tmp_path / "config" / "small", settings.router)
    command = [*RTEE, "run", str(folder), "--no-log"]
    run = await anyio.open_process(command, stderr=subprocess.PIPE)
    async with run, robot(settings) as others:
        await others.sees("/left/small")
        assert await others.listen("/left/joint_states", JOINT_STATE)
        os.kill(run.pid, signal.SIGKILL)
        await others.sees("/left/small", there=False)
        assert not others.names(Kind.SERVICE)
        # Read to its end: the companion has ended, too, or it would hold the pipe open.
        said = b"".join([part async for part in run.stderr]).decode()
    assert "ROS 2 does not check identities" in said


async def test_a_companion_that_does_not_listen_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(shutdown_signals, "_END_WITHIN", 0.2)
    ready = tmp_path / "ready"
    code = f"import signal, time; signal.signal(15, signal.SIG_IGN); open({str(ready)!r}, 'w')"
    with anyio.fail_after(300):
        async with anyio.create_task_group() as group:
            group.start_soon(companion, (sys.executable, "-c", f"{code}; time.sleep(600)"))
            while not ready.exists():  # noqa: ASYNC110
                await anyio.sleep(0.01)
            group.cancel_scope.cancel()
