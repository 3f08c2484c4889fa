"""Set-points from ROS 2: postures, trajectories and jogging that a hand follows as a stream."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from rtee.errors import MessageError
from rtee.ros2.face import Face
from rtee.ros2.parameters import Parameter
from rtee.ros2.player import LINGER, SETTLED, Play, Player
from rtee.ros2.trajectory import Jog, Motion, Posture, checked_position, jog_of, trajectory_of
from rtee.ros2.trajectory_action import TrajectoryAction

log = logging.getLogger(__name__)

COMMANDS, TRAJECTORY, JOG = "~/commands", "~/joint_trajectory", "~/joint_jog"

_TOLD_AGAIN = 10.0
"""Time until a topic's refusals are told again [s]: who is wrong is wrong a hundred times a
second."""

_JOGGED_FOR = 0.1
"""How long the velocities of a message without a duration count [s]: so often does a person's
device send at least."""


class Setpoints:
    """Moves the hand as topics and the action of trajectories ask for; the newest counts.

    Args:
        face: The hand and its node.
    """

    def __init__(self, face: Face) -> None:
        self._face = face
        self._player = Player(face)
        self._action = TrajectoryAction(face, self._player)
        self._refused: dict[str, tuple[float, int]] = {}
        for topic, kind, read in (
            (COMMANDS, "std_msgs/msg/Float64MultiArray", self._commands),
            (TRAJECTORY, "trajectory_msgs/msg/JointTrajectory", self._trajectory),
            (JOG, "control_msgs/msg/JointJog", self._jog),
        ):
            face.node.subscription(topic, kind, partial(self._take, topic, read))

    def parameters(self) -> Iterable[Parameter]:
        """Return the order of the commands, and the rate of the stream."""
        yield Parameter(
            "joints",
            list(self._face.actuators),
            f"The actuators in the order of {COMMANDS}.",
            read_only=True,
        )
        yield self._player.parameter()
        yield from self._action.parameters()

    async def run(self) -> None:
        """Have the hand follow what comes, until it goes."""
        try:
            await self._player.run()
        finally:
            await self._action.end("the hand has gone from ROS 2")

    # --- what the topics send

    def _take(self, topic: str, read: Callable[[Any], Motion], message: Any) -> None:
        try:
            motion = read(message)
        except MessageError as error:
            self._refuse(topic, str(error))
            return
        # A posture is sent once: when its sender falls silent, the stream's deadline applies.
        until = motion.end if isinstance(motion, Posture) else motion.end + SETTLED
        self._player.play(
            Play(motion, f"a message on {topic}", until, partial(self._refuse, topic))
        )

    def _refuse(self, topic: str, reason: str) -> None:
        """Tell why a message moves nothing, at most once in a while for each topic."""
        now = time.monotonic()
        told, untold = self._refused.get(topic, (-math.inf, 0))
        if now < told + _TOLD_AGAIN:
            self._refused[topic] = told, untold + 1
            return
        name = self._face.node.name.resolve(topic)
        more = f" ({untold} more were refused before)" if untold else ""
        log.warning("a message on %s is refused: %s%s", name, reason, more)
        self._refused[topic] = now, 0

    def _commands(self, message: Any) -> Motion:
        actuators = self._face.actuators
        values = [float(value) for value in message.data]
        if len(values) != len(actuators):
            raise MessageError(
                f"it needs {len(actuators)} numbers, in the order of the parameter 'joints', not"
                f" {len(values)}"
            )
        pairs = zip(actuators, values, strict=True)
        return Posture(
            {
                name: checked_position(name, value, self._player.joints[name])
                for name, value in pairs
            },
            time.monotonic(),
        )

    def _trajectory(self, message: Any) -> Motion:
        now, ros_now = time.monotonic(), time.time()
        return trajectory_of(message, self._player.joints, self._player.where, now, ros_now)

    def _jog(self, message: Any) -> Motion:
        now = time.monotonic()

        def where(name: str) -> float:
            # A jog that goes on continues where the last one was to bring the joint, else the lag
            # of the measurement would hold it back at every message.
            last = self._player.last
            if last is not None and isinstance(last.motion, Jog) and now < last.motion.end + LINGER:
                at = last.motion.at(now).position.get(name)
                if at is not None:
                    return at
            return self._player.where(name)

        return jog_of(message, self._player.joints, where, now, _JOGGED_FOR)
