"""Hands that are moved by topics of ROS 2, and what moves nothing."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from remote.serving import Served, until

from rtee.actions.library import ActionLibrary
from rtee.errors import MessageError
from rtee.hand.config_schema import Ros2Settings
from rtee.hand.model import Hand
from rtee.remote.client import connect
from rtee.ros2.endpoints import Publisher
from rtee.ros2.trajectory import VelocityCommand, jog_of, movable_joints, trajectory_of
from rtee.ros2.types import interfaces

from .facing import Robot, a_hand_in_ros

pytestmark = pytest.mark.anyio

COMMANDS = "std_msgs/msg/Float64MultiArray"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
JOG = "control_msgs/msg/JointJog"
KNOWN = interfaces("jazzy")


def trajectory(names: list[str], *points: tuple[float, list[float]], **fields: Any) -> Any:
    """Return a trajectory of points: a time from its start and the positions there."""
    point = KNOWN.message("trajectory_msgs/msg/JointTrajectoryPoint")
    made = KNOWN.message(TRAJECTORY)(joint_names=names)
    for seconds, positions in points:
        made.points.append(point(positions=positions, **fields))
        made.points[-1].time_from_start.sec = int(seconds // 1)
        made.points[-1].time_from_start.nanosec = int(seconds % 1 * 1e9)
    return made


def where(served: Served) -> list[float]:
    """Return the measured positions of the hand."""
    return served.loop.snapshot().position.tolist()


async def repeat(publisher: Publisher, message: Any, enough: Callable[[], bool]) -> None:
    """Publish a message 50 times a second until something is true."""
    while not enough():
        publisher.publish(message)
        await anyio.sleep(0.02)


async def ended(served: Served, positions: list[float], publish: Callable[[], None]) -> None:
    """Publish a trajectory, and wait for its end at some positions.

    Where a busy computer has let it run out of samples, the hand has braked: it is sent again.
    """
    while not near(served, positions):
        publish()
        await until(lambda: bool(served.loop.streams.stream) or near(served, positions))
        await until(lambda: not served.loop.streams.stream)


def near(served: Served, positions: list[float]) -> bool:
    return all(abs(a - b) < 0.01 for a, b in zip(where(served), positions, strict=True))


async def test_commands(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        publisher = await robot.talk("/small/commands", COMMANDS)
        message = publisher.type.message(data=[0.4, 0.3, 0.01])
        await repeat(publisher, message, lambda: near(served, [0.4, 0.3, 0.01]))
        await served.event("stream_paused")  # silence: the deadline of the hand's streams
        await until(lambda: not served.loop.streams.stream)  # and others may move it again
        async with connect("small") as client:
            assert (await client.open()).reached


async def test_trajectory(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        publisher = await robot.talk("/small/joint_trajectory", TRAJECTORY)
        # The mimic joint stands for its actuator: far = 0.5 near + 0.1.
        message = trajectory(["far", "thumb"], (0.2, [0.2, 0.1]), (0.4, [0.35, 0.2]))
        await ended(served, [0.5, 0.2, 0.0], lambda: publisher.publish(message))

        def twice() -> None:  # a newer message counts at once
            publisher.publish(trajectory(["thumb"], (30.0, [0.9])))
            publisher.publish(trajectory(["thumb"], (0.2, [-0.2])))

        await ended(served, [0.5, -0.2, 0.0], twice)


async def test_jog(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        publisher = await robot.talk("/small/joint_jog", JOG)
        jog = publisher.type.message
        message = jog(joint_names=["thumb"], velocities=[1.0])
        await repeat(publisher, message, lambda: where(served)[1] > 0.3)
        await until(lambda: not served.loop.streams.stream)

        async def step(by: float, **fields: float) -> None:
            to = where(served)[1] + by
            # Where a busy computer has let it run out of samples, the hand has braked.
            while abs(left := to - where(served)[1]) >= 0.005:
                publisher.publish(jog(joint_names=["thumb"], displacements=[left], **fields))
                await until(lambda: bool(served.loop.streams.stream))
                await until(lambda: not served.loop.streams.stream)

        await step(-0.1, duration=0.1)
        await step(-0.1)
        # Never beyond the limits.
        await repeat(
            publisher,
            jog(joint_names=["push"], velocities=[0.5]),
            lambda: abs(where(served)[2] - 0.04) < 1e-4,
        )
        assert where(served)[2] <= 0.04 + 1e-9


async def test_a_goal_of_another_client_is_not_disturbed(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings, caplog: pytest.LogCaptureFixture
) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        publisher = await robot.talk("/small/commands", COMMANDS)
        message = publisher.type.message(data=[0.4, 0.3, 0.01])
        async with connect("small") as client, client.lease():
            await repeat(publisher, message, lambda: bool(_refusals(caplog)))
            assert near(served, [0.0, 0.0, 0.0])
        assert "is held by" in _refusals(caplog)[0]
        await repeat(publisher, message, lambda: near(served, [0.4, 0.3, 0.01]))


def _refusals(caplog: pytest.LogCaptureFixture) -> list[str]:
    found = [one.getMessage() for one in caplog.records if one.levelno >= logging.WARNING]
    return [text for text in found if "is refused" in text]


async def test_what_moves_nothing(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings, caplog: pytest.LogCaptureFixture
) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        commands = await robot.talk("/small/commands", COMMANDS)
        for data in ([0.1, 0.2], [0.1] * 4, [], [math.nan, 0.1, 0.0], [0.1, 57.0, 0.0]):
            commands.publish(commands.type.message(data=data))
        trajectories = await robot.talk("/small/joint_trajectory", TRAJECTORY)
        for message in _bad_trajectories():
            trajectories.publish(message)
        jogs = await robot.talk("/small/joint_jog", JOG)
        jogs.publish(jogs.type.message(joint_names=["elbow"], velocities=[1.0]))
        await _settled(robot)
        await until(lambda: len(_refusals(caplog)) >= 3)
        assert near(served, [0.0, 0.0, 0.0])
        assert not served.watcher.goals
        assert "stream_ended" not in [event.kind for event in served.watcher.events]
        assert served.loop.streams.status().samples == 0
    told = _refusals(caplog)
    assert len(told) == 3, told  # one line a topic, however many messages
    assert "needs 3 numbers" in told[0]


async def _settled(robot: Robot) -> None:
    """Wait until the hand has looked at all that was published: services come after it."""
    await robot.call("/small/list_actions", "rtee_msgs/srv/ListActions")
    await anyio.sleep(0.1)


def _bad_trajectories() -> list[Any]:
    late = trajectory(["near"], (0.1, [0.5]))
    late.header.stamp.sec = int(time.time()) - 10
    return [
        trajectory(["elbow"], (0.1, [0.5])),
        trajectory([], (0.1, [])),
        trajectory(["near", "near"], (0.1, [0.5, 0.5])),
        trajectory(["near"]),
        trajectory(["near"], (0.1, [0.5]), (0.1, [0.6])),
        trajectory(["near"], (0.1, [0.5, 0.6])),
        trajectory(["near"], (0.1, [math.nan])),
        trajectory(["near"], (0.1, [99.0])),
        trajectory(["near"], (0.1, [0.5]), velocities=[math.inf]),
        trajectory(["near"], (0.1, [0.5]), velocities=[0.0, 0.0]),
        trajectory(["near"], (1e6, [0.5])),
        late,
    ]


def test_bad_trajectories(hand: Hand) -> None:
    joints = movable_joints(hand)
    assert list(joints) == ["near", "thumb", "push", "far"]
    for message in _bad_trajectories():
        with pytest.raises(MessageError):
            trajectory_of(message, joints, lambda _: 0.0, 100.0, time.time())


def test_the_way_of_a_trajectory(hand: Hand) -> None:
    joints = movable_joints(hand)
    straight = trajectory_of(
        trajectory(["near"], (1.0, [0.5]), (2.0, [1.0])), joints, lambda _: 0.1, 10.0, 0.0
    )
    assert straight.at(10.5).position["near"] == pytest.approx(0.3)
    assert straight.at(10.5).velocity["near"] == pytest.approx(0.4)
    assert straight.at(99.0) == ({"near": 1.0}, {"near": 0.0})
    smooth = trajectory_of(
        trajectory(["near"], (1.0, [1.0]), velocities=[0.0]), joints, lambda _: 0.0, 10.0, 0.0
    )
    assert smooth.at(10.5) == ({"near": pytest.approx(0.5)}, {"near": pytest.approx(1.5)})
    assert smooth.at(10.0).velocity["near"] == 0.0
    # What is over when it arrives is passed over, and the way begins where the joint is.
    begun = trajectory(["near"], (1.0, [0.5]), (3.0, [1.0]))
    begun.header.stamp.sec = 100
    later = trajectory_of(begun, joints, lambda _: 0.2, 10.0, 102.0)
    assert later.at(10.0).position["near"] == pytest.approx(0.2)
    assert later.at(10.5).position["near"] == pytest.approx(0.6)
    assert later.end == pytest.approx(11.0)
    at_once = trajectory_of(trajectory(["near"], (0.0, [0.5])), joints, lambda _: 0.2, 10.0, 0.0)
    assert at_once.at(10.0).position == {"near": 0.5}


def test_the_way_of_a_jog(hand: Hand) -> None:
    joints = movable_joints(hand)
    message = KNOWN.message(JOG)
    jog = jog_of(message(joint_names=["near"], velocities=[2.0]), joints, lambda _: 1.0, 10.0, 0.5)
    assert isinstance(jog, VelocityCommand)
    assert jog.at(10.1) == ({"near": pytest.approx(1.2)}, {"near": 2.0})
    assert jog.at(10.4) == ({"near": 1.5}, {"near": 0.0})  # its limit
    # A displacement without a duration takes as long as the joint needs: 3 rad/s.
    quick = message(joint_names=["near"], displacements=[0.9])
    jog = jog_of(quick, joints, lambda _: 0.1, 10.0, 0.5)
    assert (jog.end, jog.at(jog.end).position) == (10.3, {"near": pytest.approx(1.0)})
    follower = message(joint_names=["far"], displacements=[0.3])  # half as fast as its actuator
    assert jog_of(follower, joints, lambda _: 0.1, 10.0, 0.5).end == pytest.approx(10.2)
    wrong = [
        SimpleNamespace(joint_names=["near"], displacements=d, velocities=v, duration=t)
        for d, v, t in (
            ([], [], 0.0),
            ([1.0], [1.0], 0.0),
            ([], [1.0, 2.0], 0.0),
            ([], [math.nan], 0.0),
            ([], [1.0], -1.0),
            ([], [1.0], math.nan),
        )
    ]
    for each in wrong:
        with pytest.raises(MessageError):
            jog_of(each, joints, lambda _: 0.0, 10.0, 0.5)
