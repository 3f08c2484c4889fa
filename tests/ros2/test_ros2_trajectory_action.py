"""Goals of FollowJointTrajectory: reached, violated, cancelled, pre-empted, refused."""

from __future__ import annotations

import asyncio
import logging
import math
import re
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import numpy as np
import pytest
from remote.serving import Served, serving, until

from rtee.actions.library import ActionLibrary
from rtee.errors import GoalRejected
from rtee.hand.config_schema import Ros2Settings
from rtee.hand.model import Hand
from rtee.remote.client import connect
from rtee.ros2.action_client import ActionClient
from rtee.ros2.actions import ActionOutcome, GoalState
from rtee.ros2.serving import Shown
from rtee.ros2.setpoints import SETTLED, Code, MotionPlayer, Play

from .facing import Robot, a_hand_in_ros, facing
from .facing import robot as robot_of
from .test_ros2_setpoints import KNOWN, TRAJECTORY, near, trajectory, where

pytestmark = pytest.mark.anyio

ACTION = "/small/follow_joint_trajectory"
KIND = KNOWN.action("control_msgs/action/FollowJointTrajectory")
TOLERANCE = KNOWN.message("control_msgs/msg/JointTolerance")
DURATION = KNOWN.message("builtin_interfaces/msg/Duration")


def goal(names: list[str], *points: tuple[float, list[float]], **fields: Any) -> Any:
    """Return a goal with a trajectory of points, and other fields."""
    return KIND.goal(trajectory=trajectory(names, *points), **fields)


def within(**distance: float) -> list[Any]:
    """Return tolerances of joints."""
    return [TOLERANCE(name=name, position=value) for name, value in distance.items()]


LONG = goal(["near", "thumb"], (20.0, [1.5, 0.9]))


@asynccontextmanager
async def acting(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> AsyncIterator[tuple[Served, Robot, ActionClient]]:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        client = ActionClient(robot.node, ACTION, KIND)
        await client.wait_for_server(300.0)
        yield served, robot, client


async def done(client: ActionClient, message: Any) -> ActionOutcome:
    return await (await client.send_goal(message)).result(300.0)


def told(outcome: ActionOutcome) -> tuple[GoalState, Code, str]:
    result: Any = outcome.result
    return outcome.state, Code(result.error_code), result.error_string


async def test_reached(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with acting(hand, library, settings) as (served, _, client):
        heard: list[Any] = []
        # The mimic joint stands for its actuator: far = 0.5 near + 0.1.
        message = goal(
            ["thumb", "far"],
            (0.2, [0.1, 0.2]),
            (0.5, [0.3, 0.35]),
            path_tolerance=within(thumb=1.0, far=1.0),  # a busy loop is late
            goal_tolerance=[TOLERANCE(name="far", position=0.01, velocity=0.05)],
        )
        made = await client.send_goal(message, heard.append)
        state, code, text = told(await made.result(300.0))
        assert (state, code) == (GoalState.SUCCEEDED, Code.SUCCESSFUL), text
        await until(lambda: near(served, [0.5, 0.3, 0.0]))
        assert len(heard) > 3
        for one in heard:
            assert one.joint_names == ["thumb", "far"]
            for wanted, actual, error in zip(
                one.desired.positions, one.actual.positions, one.error.positions, strict=True
            ):
                assert wanted - actual == pytest.approx(error)
            # A busy loop is late, so that its distance is no measure: where it ought to be, is.
            since = one.desired.time_from_start.sec + one.desired.time_from_start.nanosec * 1e-9
            assert one.desired.positions == pytest.approx(
                [np.interp(since, (0.0, 0.2, 0.5), at) for at in ((0, 0.1, 0.3), (0.1, 0.2, 0.35))],
                abs=1e-3,
            )
        assert heard[-1].actual.positions[1] > heard[0].actual.positions[1]
        assert heard[-1].desired.time_from_start.nanosec > 0
        # Nothing is enforced unless it is asked for.
        assert told(await done(client, goal(["push"], (0.1, [0.02]))))[1] is Code.SUCCESSFUL
        await until(lambda: near(served, [0.5, 0.3, 0.02]))
        await until(lambda: not served.loop.streams.stream)  # others may move it again


async def test_feedback_counts_from_the_stamp(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with acting(hand, library, settings) as (_, _, client):
        message = goal(["thumb"], (1.0, [0.1]), (2.0, [0.2]), (5.0, [0.3]))
        message.trajectory.header.stamp.sec = int(time.time()) - 4
        heard: list[Any] = []
        made = await client.send_goal(message, heard.append)
        await until(lambda: bool(heard))
        # More than three seconds of it were over when it came.
        assert heard[0].desired.time_from_start.sec >= 3
        assert told(await made.result(300.0))[1] is Code.SUCCESSFUL


async def test_violated(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with acting(hand, library, settings) as (served, _, client):
        # The hand needs half a second for it.
        fast = goal(["near"], (0.1, [1.5]), path_tolerance=within(near=0.05))
        state, code, text = told(await done(client, fast))
        assert (state, code) == (GoalState.ABORTED, Code.PATH_TOLERANCE_VIOLATED)
        assert "'near' was off by" in text
        await until(lambda: not served.loop.streams.stream)
        assert where(served)[0] < 1.4
        late = goal(
            ["push"],
            (0.05, [0.04]),
            goal_tolerance=within(push=0.001),
            goal_time_tolerance=DURATION(nanosec=10_000_000),
        )
        state, code, text = told(await done(client, late))
        assert (state, code) == (GoalState.ABORTED, Code.GOAL_TOLERANCE_VIOLATED)
        assert "after its end 'push'" in text
        await until(lambda: not served.loop.streams.stream)
        assert where(served)[2] < 0.039
        # The same is reached if it may be late, by default too.
        late = goal(["push"], (0.05, [0.04]), goal_tolerance=within(push=0.001))
        assert told(await done(client, late))[0] is GoalState.SUCCEEDED


async def test_it_ends_when_the_hand_has_stopped(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without tolerances it ended while the hand, slower than it, was far from its end."""
    async with acting(hand, library, settings) as (served, _, client):
        # On a busy computer, a stream may begin when the trajectory is long over.
        play = MotionPlayer.play

        def play_late(player: MotionPlayer, motion: Play) -> None:
            asyncio.get_running_loop().call_later(3 * SETTLED, play, player, motion)

        with monkeypatch.context() as late:
            late.setattr(MotionPlayer, "play", play_late)
            state, code, text = told(await done(client, goal(["push"], (0.05, [0.02]))))
        assert (state, code) == (GoalState.SUCCEEDED, Code.SUCCESSFUL), text
        assert near(served, [0.0, 0.0, 0.02])
        assert where(served)[2] > 0.01
        # The stream of that goal still goes on when the next one begins late.
        with monkeypatch.context() as late:
            late.setattr(MotionPlayer, "play", play_late)
            state, code, text = told(await done(client, goal(["push"], (0.05, [0.03]))))
        assert (state, code) == (GoalState.SUCCEEDED, Code.SUCCESSFUL), text
        assert near(served, [0.0, 0.0, 0.03])
        assert where(served)[2] > 0.025
        await until(lambda: not served.loop.streams.stream)
        state, code, text = told(await done(client, goal(["push"], (0.05, [0.04]))))
        assert (state, code) == (GoalState.SUCCEEDED, Code.SUCCESSFUL), text
        assert "the goal is reached" in text
        assert near(served, [0.0, 0.0, 0.04])
        hurried = goal(["push"], (0.05, [0.0]), goal_time_tolerance=DURATION(nanosec=10_000_000))
        state, code, text = told(await done(client, hurried))
        assert (state, code) == (GoalState.ABORTED, Code.GOAL_TOLERANCE_VIOLATED)
        assert "'push' moved at" in text


def test_the_codes_are_those_of_the_definition() -> None:
    constants = {code.name: code.value for code in Code}
    text = KNOWN.texts["control_msgs/action/FollowJointTrajectory"]
    found = re.findall(r"^int32 (\w+) *= *(-?\d+)", text, re.M)
    assert {name: int(number) for name, number in found} == constants


async def stands(served: Served) -> list[float]:
    """Wait until nothing is streamed; return where the hand stands, short of the end of `LONG`."""
    await until(lambda: not served.loop.streams.stream)
    found, ticks = where(served), served.watcher.ticks
    await until(lambda: served.watcher.ticks >= ticks + 40)  # on its way, 0.015 rad
    assert near(served, found)
    assert found[0] < 1.4
    return found


async def test_cancelled(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with acting(hand, library, settings) as (served, _, client):
        made = await client.send_goal(LONG)
        await until(lambda: where(served)[1] > 0.05)
        await made.cancel()
        assert (await made.result(300.0)).state is GoalState.CANCELED
        before = await stands(served)
        # A trajectory without points stops, too.
        made = await client.send_goal(LONG)
        await until(lambda: where(served)[1] > before[1] + 0.05)
        assert told(await done(client, goal([])))[0] is GoalState.SUCCEEDED
        assert told(await made.result(300.0))[0] is GoalState.ABORTED
        await stands(served)


async def test_preempted(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with acting(hand, library, settings) as (served, robot, client):
        publisher = await robot.talk("/small/joint_trajectory", TRAJECTORY)
        first = await client.send_goal(LONG)
        second = await client.send_goal(LONG)
        state, code, text = told(await first.result(300.0))
        assert (state, code) == (GoalState.ABORTED, Code.INVALID_GOAL)
        assert "pre-empted by a goal" in text
        publisher.publish(trajectory(["thumb"], (0.2, [-0.2])))
        state, _, text = told(await second.result(300.0))
        assert state is GoalState.ABORTED
        assert "pre-empted by a message on ~/joint_trajectory" in text
        await until(lambda: abs(where(served)[1] + 0.2) < 0.01)
        # So does whatever else the hand is asked for, as it pre-empts any stream.
        third = await client.send_goal(LONG)
        await until(lambda: bool(served.loop.streams.stream))
        assert (await robot.call("/small/open", "std_srvs/srv/Trigger")).success
        state, code, text = told(await third.result(300.0))
        assert (state, code) == (GoalState.ABORTED, Code.INVALID_GOAL)
        # A sample on its way may learn of it before the goal does.
        assert "the stream ended" in text or "it may have ended" in text
        third = await client.send_goal(LONG)
        await until(lambda: bool(served.loop.streams.stream))
        async with connect("small") as other:
            await other.stop()
            state, _, text = told(await third.result(300.0))
            assert (state, bool(text)) == (GoalState.ABORTED, True)


async def test_held_by_another(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with acting(hand, library, settings) as (served, _, client):
        async with connect("small") as other, other.lease():
            state, _, text = told(await done(client, LONG))
            assert state is GoalState.ABORTED
            assert "is held by" in text
        assert near(served, [0.0, 0.0, 0.0])


async def test_the_hand_goes(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with (
        facing(Shown(hand.name, settings, configured=hand)),
        robot_of(settings) as robot,
    ):
        client = ActionClient(robot.node, ACTION, KIND)
        async with serving(hand, library) as served:
            await client.wait_for_server(300.0)
            made = await client.send_goal(LONG)
            await until(lambda: where(served)[1] > 0.01)
            waiting = asyncio.ensure_future(made.result(300.0))
            await anyio.sleep(0.1)  # the server knows that somebody waits
        state, code, text = told(await waiting)
        assert (state, code) == (GoalState.ABORTED, Code.INVALID_GOAL)
        assert "has ended or no longer answers" in text


async def test_refused(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings, caplog: pytest.LogCaptureFixture
) -> None:
    old = goal(["near"], (0.1, [0.5]))
    old.trajectory.header.stamp.sec = int(time.time()) - 10
    way = (0.1, [0.5])
    multi = KNOWN.message("trajectory_msgs/msg/MultiDOFJointTrajectory")(joint_names=["base"])
    wrong: list[tuple[Any, str]] = [
        (goal(["elbow"], way), "INVALID_JOINTS: there is no joint 'elbow'"),
        (
            goal(["near", "far"], (0.1, [0.5, 0.35])),
            "INVALID_JOINTS: 'near' and 'far' are moved by",
        ),
        (goal([], way), "INVALID_JOINTS: the message names no joints"),
        (old, "OLD_HEADER_TIMESTAMP: it ended"),
        (goal(["near"], way, way), "INVALID_GOAL: the times of its points"),
        (goal(["near"], (0.1, [math.nan])), "INVALID_GOAL: position nan of 'near'"),
        (goal(["near"], (0.1, [0.5, 0.6])), "INVALID_GOAL: each point needs 1 positions"),
        (
            KIND.goal(trajectory=trajectory(["near"], way, velocities=[1.0])),
            "INVALID_GOAL: its last point must have velocity 0",
        ),
        (goal(["near"], way, path_tolerance=within(push=0.1)), "INVALID_JOINTS: there is a toler"),
        (goal(["near"], way, goal_tolerance=within(near=-0.5)), "INVALID_GOAL: a tolerance of 'ne"),
        (goal(["near"], way, goal_tolerance=within(near=math.nan)), "of 'near' is nan"),
        (goal(["near"], way, goal_time_tolerance=DURATION(sec=-2)), "INVALID_GOAL: the goal time"),
        (goal(["near"], way, multi_dof_trajectory=multi), "INVALID_GOAL: a hand has no joints of"),
    ]
    async with acting(hand, library, settings) as (served, _, client):
        for message, reason in wrong:
            with pytest.raises(GoalRejected):
                await client.send_goal(message)
            assert any(reason in text for text in _warnings(caplog)), reason
            await anyio.sleep(0.2)  # at most five refusals a second are logged
        assert served.loop.streams.status().samples == 0


def _warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [one.getMessage() for one in caplog.records if one.levelno >= logging.WARNING]
