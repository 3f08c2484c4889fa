"""Topics with set-points for a hand: postures, trajectories and jogging, followed as a stream."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from rtee import monotonic
from rtee.errors import MessageError
from rtee.ros2.parameters import Parameter
from rtee.ros2.player import LINGER, SETTLED, Play, Player
from rtee.ros2.served_hand import Part, ServedHand
from rtee.ros2.trajectory import (
    Motion,
    TimedPosture,
    VelocityCommand,
    checked_position,
    jog_of,
    trajectory_of,
)
from rtee.ros2.trajectory_action import TrajectoryAction

log = logging.getLogger(__name__)

COMMANDS, TRAJECTORY, JOG = "~/commands", "~/joint_trajectory", "~/joint_jog"

_LOGGED_AGAIN = 10.0
"""Time until refusals of a topic are logged again [s]: a sender may repeat them at 100 Hz."""

_JOGGED_FOR = 0.1
"""Duration of the velocities of a message without one [s]: input devices send at least every
0.1 s."""


class Setpoints(Part):
    """Moves the hand by the topics and the action of trajectories; the newest command counts."""

    def __init__(self, served: ServedHand) -> None:
        self._served = served
        self._player = Player(served)
        self._action = TrajectoryAction(served, self._player)
        self._refused: dict[str, tuple[float, int]] = {}
        for topic, kind, read in (
            (COMMANDS, "std_msgs/msg/Float64MultiArray", self._commands),
            (TRAJECTORY, "trajectory_msgs/msg/JointTrajectory", self._trajectory),
            (JOG, "control_msgs/msg/JointJog", self._jog),
        ):
            served.node.subscription(topic, kind, partial(self._take, topic, read))

    def parameters(self) -> Iterable[Parameter]:
        """Return the parameters for the order of commands, the stream's rate and the action."""
        yield Parameter(
            "joints",
            list(self._served.actuators),
            f"The actuators in the order of {COMMANDS}.",
            read_only=True,
        )
        yield self._player.parameter()
        yield from self._action.parameters()

    async def run(self) -> None:
        """Stream set-points to the hand until it ends."""
        try:
            await self._player.run()
        finally:
            await self._action.end("the hand has gone from ROS 2")

    # --- messages of the topics

    def _take(self, topic: str, read: Callable[[Any], Motion], message: Any) -> None:
        try:
            motion = read(message)
        except MessageError as error:
            self._refuse(topic, str(error))
            return
        # A posture is sent once, so that the stream's deadline applies when its sender stops.
        until = motion.end if isinstance(motion, TimedPosture) else motion.end + SETTLED
        self._player.play(
            Play(motion, f"a message on {topic}", until, partial(self._refuse, topic))
        )

    def _refuse(self, topic: str, reason: str) -> None:
        """Log the reason for a refused message, at most every `_LOGGED_AGAIN` for each topic."""
        now = monotonic.now()
        logged, unlogged = self._refused.get(topic, (-math.inf, 0))
        if now < logged + _LOGGED_AGAIN:
            self._refused[topic] = logged, unlogged + 1
            return
        name = self._served.node.name.resolve(topic)
        more = f" ({unlogged} more were refused before)" if unlogged else ""
        log.warning("a message on %s is refused: %s%s", name, reason, more)
        self._refused[topic] = now, 0

    def _commands(self, message: Any) -> Motion:
        actuators = self._served.actuators
        values = [float(value) for value in message.data]
        if len(values) != len(actuators):
            raise MessageError(
                f"it needs {len(actuators)} numbers, in the order of the parameter 'joints', not"
                f" {len(values)}"
            )
        pairs = zip(actuators, values, strict=True)
        return TimedPosture(
            {
                name: checked_position(name, value, self._player.joints[name])
                for name, value in pairs
            },
            monotonic.now(),
        )

    def _trajectory(self, message: Any) -> Motion:
        now, ros_now = monotonic.now(), time.time()
        return trajectory_of(message, self._player.joints, self._player.where, now, ros_now)

    def _jog(self, message: Any) -> Motion:
        now = monotonic.now()

        def where(name: str) -> float:
            # A jog continues from the set-point of the last one; from the measured position, the
            # lag of the measurement would slow it down with every message.
            last = self._player.last
            if (
                last is not None
                and isinstance(last.motion, VelocityCommand)
                and now < last.motion.end + LINGER
            ):
                at = last.motion.at(now).position.get(name)
                if at is not None:
                    return at
            return self._player.where(name)

        return jog_of(message, self._player.joints, where, now, _JOGGED_FOR)
