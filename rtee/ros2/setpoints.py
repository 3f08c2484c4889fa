"""Trajectories and jogs: the action ``control_msgs/action/FollowJointTrajectory``, and topics.

The action behaves like that of ros2_control's joint_trajectory_controller, with its error codes. A
refused goal has no result there either, so the log has the reason, beginning with the code's name.
A trajectory may omit joints. Without points, it stops the hand where it is, as in ROS 1.
"""

from __future__ import annotations

import asyncio
import bisect
import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from itertools import count
from typing import Any, Final, NamedTuple

import anyio

from rtee import monotonic
from rtee.errors import GoalRejected, LeaseHeld, MessageError, NoHand, RequestRejected, RteeError
from rtee.loop.streams.player import LAG_CHANNEL
from rtee.messages.state import State
from rtee.remote.stream import Stream
from rtee.ros2.action_server import ActionServer, Job, Offer, ServerGoal
from rtee.ros2.actions import ActionOutcome, GoalState, time_fields
from rtee.ros2.message import Message
from rtee.ros2.parameters import Parameter
from rtee.ros2.served_hand import Part, ServedHand
from rtee.ros2.trajectory import (
    JointMotion,
    OldTrajectory,
    SetPoint,
    TimedPosture,
    VelocityCommand,
    checked_names,
    checked_position,
    jog_of,
    movable_joints,
    seconds,
    trajectory_of,
)

STREAM_RATE = "stream_rate"
"""Name of the parameter for the rate of the stream."""

SETTLED = 0.3
"""Time for which the last set-point of a motion is repeated [s]: a stream plays its samples with a
lag, and brakes where it is when it ends."""

LINGER = 0.5
"""Time without set-points after which the stream ends [s], so that others may move the hand."""


@dataclass(eq=False, slots=True)
class Play:
    """A motion for the hand to follow, from a source such as a topic.

    Attributes:
        until: Time until which to send set-points [s]; after its end, the last one is repeated.
        failed: Called with the reason if the hand refuses or stops following the motion.
        replaced: Called with the source of another motion that replaces this one.
        begun: Whether one of its set-points has been sent.
    """

    motion: JointMotion
    source: str
    until: float
    failed: Callable[[str], None]
    replaced: Callable[[str], None] | None = None
    begun: bool = False


class MotionPlayer:
    """Streams motions to the hand; the newest replaces any other, whatever its source.

    Attributes:
        joints: The joints that motions may move.
        last: The motion that began last, unless the hand refused to follow it.
    """

    def __init__(self, served: ServedHand) -> None:
        self.joints = movable_joints(served.model)
        self.last: Play | None = None
        self._served = served
        self._current: Play | None = None
        self._wake = anyio.Event()

    def play(self, play: Play) -> None:
        """Follow a motion from now on, instead of the present one."""
        before, self._current = self._current, play
        self.last = play
        self._wake.set()
        if before is not None and before.replaced is not None:
            before.replaced(play.source)

    def hold(self, names: Iterable[str], source: str, failed: Callable[[str], None]) -> None:
        """Hold joints at measured positions; ``failed`` gets the reason if the hand refuses."""
        now = monotonic.now()
        self.play(Play(self.here(names), source, now + SETTLED, failed))

    def here(self, names: Iterable[str]) -> TimedPosture:
        """Return the measured positions of joints, clamped to their limits, as a set-point."""
        position = {name: self.joints[name].clamped(self.where(name)) for name in names}
        return TimedPosture(position, monotonic.now())

    def where(self, name: str) -> float:
        """Return the measured position of a joint [rad | m]."""
        state = self._served.latest
        position = state.positions.get(name)
        return state.joints[name] if position is None else position

    def parameter(self) -> Parameter:
        """Return the parameter for the rate of the stream."""
        return Parameter(
            STREAM_RATE,
            100.0,
            "Rate of the set-points that trajectories and jogs become, and the highest rate of"
            " ~/commands [Hz]; a change takes effect with the next stream.",
            lower=20.0,
            upper=500.0,
        )

    async def run(self) -> None:
        """Stream while there are set-points, until the hand ends."""
        while True:
            await self._wake.wait()
            begun = self._current
            if begun is None:
                self._wake = anyio.Event()
                continue
            try:
                async with self._served.hand.stream(
                    rate=self._served.number(STREAM_RATE)
                ) as stream:
                    await self._follow(stream)
            except NoHand:
                # The hand has ended, and with it the node: this ends all parts.
                raise
            except (RequestRejected, GoalRejected, LeaseHeld) as error:
                # A pre-empted stream ends here, too; the rest of its motion is not sent.
                failed = self._current or self.last or begun
                self._current = self.last = None
                failed.failed(str(error))

    async def _follow(self, stream: Stream) -> None:
        """Send set-points until none have come for `LINGER`."""
        period = 1.0 / self._served.number(STREAM_RATE)
        while True:
            # A new event before anything is awaited, so that no later motion is missed.
            play, self._wake = self._current, anyio.Event()
            if play is None:
                with anyio.move_on_after(LINGER) as waiting:
                    await self._wake.wait()
                # The end of a stream at rest must not make the next motion fail.
                if waiting.cancelled_caught or stream.ended:
                    return
                continue
            now = monotonic.now()
            targets, velocity = play.motion.at(now)
            # Stamped with the set-point's time, so that a late sample keeps the motion's shape.
            await stream.send(targets, velocity, stamp=now)
            play.begun = True
            # Another motion may have replaced it while the sample was sent.
            if now >= play.until and play is self._current:
                self._current = None
                continue
            with anyio.move_on_after(period):
                await self._wake.wait()


ACTION = "~/follow_joint_trajectory"
GOAL_TIME = "constraints.goal_time"
"""Name of the parameter for the time that a hand may be late, as in ros2_control."""

STOPPED = "constraints.stopped_velocity_tolerance"
"""Name of the parameter for the speed below which a joint has stopped, as in ros2_control."""

_RATE = 50.0
"""Rate of the checks of tolerances [Hz]: more often than the 20 Hz of ros2_control's feedback."""

_EVERY = 2
"""Number of checks per feedback: 25 Hz, where ros2_control has 20 Hz by default."""

_NOISE = 0.02
"""Share of its velocity limit below which an actuator counts as still, too: the default of the
hand's own `rtee.hand.config_schema.StallSettings.speed`."""

_ERASED = -1.0
"""Value of a tolerance that disables it, whatever the default."""

_ANSWERED_WITHIN = 1.0
"""Longest time to abort the goals when the hand ends [s]."""

_TOLD_WITHIN = 0.05
"""Time to send the results of aborted goals to the clients that wait for them [s]."""

_Joints = dict[str, tuple[float, float]]
"""Positions [rad | m] and velocities [rad/s | m/s] by joint."""


class Code(IntEnum):
    """Error codes of the action's results."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class Tolerance(NamedTuple):
    """Largest errors of position [rad | m] and velocity [rad/s | m/s]; infinite: any error."""

    position: float
    velocity: float


def tolerances_of(given: Iterable[Any], names: Sequence[str]) -> dict[str, Tolerance]:
    """Return the tolerances in ``control_msgs/msg/JointTolerance`` messages, by joint.

    Ignores tolerances of accelerations, which are not measured. Raises `MessageError` if a
    tolerance is invalid; its text begins with the name of the error code.
    """
    tolerances = {}
    for tolerance in given:
        name = tolerance.name
        if name not in names:
            raise _refusal(
                Code.INVALID_JOINTS,
                f"there is a tolerance for '{name[:100]}', which is not in the trajectory",
            )
        values = float(tolerance.position), float(tolerance.velocity)
        for value in values:
            # In this form, the condition refuses NaN, too.
            if not (value >= 0.0 or value == _ERASED):
                raise _refusal(
                    Code.INVALID_GOAL,
                    f"a tolerance of '{name}' is {value:g}; it should be positive, 0 for the"
                    " default, or -1 for none",
                )
        # 0 means the default: no tolerance of positions, as in ros2_control.
        if max(values) > 0.0:
            tolerances[name] = Tolerance(*(value if value > 0.0 else math.inf for value in values))
    return tolerances


class TrajectoryAction:
    """Serves the action; the player also streams the trajectories of topics to the hand."""

    def __init__(self, served: ServedHand, player: MotionPlayer) -> None:
        self.served, self.player = served, player
        self.type: Final = served.node.context.interfaces.action(
            "control_msgs/action/FollowJointTrajectory"
        )
        self.point = served.message("trajectory_msgs/msg/JointTrajectoryPoint")
        self.duration = served.message("builtin_interfaces/msg/Duration")
        self._server = ActionServer(served.node, ACTION, Offer(self.type, self._accept))
        self._following: set[_Following] = set()

    def parameters(self) -> Iterable[Parameter]:
        """Return the parameters `GOAL_TIME` and `STOPPED`."""
        yield Parameter(
            STOPPED,
            0.01,
            f"Speed below which a joint has stopped, so that a goal of {ACTION} may end [rad/s |"
            " m/s]; 2 % of its velocity limit if that is higher.",
            lower=1e-4,
            upper=10.0,
        )
        yield Parameter(
            GOAL_TIME,
            2.0,
            f"Time after the end of a trajectory of {ACTION} to reach its goal tolerance [s],"
            " unless the goal gives one.",
            lower=0.01,
            upper=600.0,
        )

    async def end(self, reason: str) -> None:
        """Abort all goals, wait until their clients have the results, and leave the graph."""
        for job in tuple(self._following):
            job.fail(reason)
        with anyio.move_on_after(_ANSWERED_WITHIN, shield=True):
            for goal in self._server.goals:
                # Shielded, so that the time limit does not cancel the future of the clients.
                await asyncio.shield(goal.ended)
            await anyio.sleep(_TOLD_WITHIN)
        self._server.close()

    async def _accept(self, message: Any) -> Job:
        job = self._checked(message)
        # From now on and not only from `run`, since the hand may end before that.
        self._following.add(job)
        return job

    def forget(self, job: _Following) -> None:
        """Forget a goal that has ended."""
        self._following.discard(job)

    def _checked(self, message: Any) -> _Following:
        """Return the job of a goal; raise `MessageError` with the error code first."""
        multi, names = message.multi_dof_trajectory, list(message.trajectory.joint_names)
        parts = (
            multi.joint_names,
            message.component_path_tolerance,
            message.component_goal_tolerance,
        )
        if any(map(len, parts)) or multi.points:
            raise _refusal(Code.INVALID_GOAL, "a hand has no joints of several degrees of freedom")
        goal_time = seconds(message.goal_time_tolerance)
        moving_time = goal_time if goal_time > 0.0 else math.inf
        if goal_time == 0.0:
            goal_time = self.served.number(GOAL_TIME)
        elif goal_time < 0.0:
            if goal_time != _ERASED:
                raise _refusal(
                    Code.INVALID_GOAL,
                    f"the goal time tolerance is {goal_time:g} s; it should be positive, 0 for the"
                    " default, or -1 for any time",
                )
            goal_time = math.inf
        # Without points and names, all actuators stop where they are.
        if not message.trajectory.points:
            names = names or list(self.served.actuators)
        self._check_joints(names)
        limits = _Limits(
            tolerances_of(message.path_tolerance, names),
            tolerances_of(message.goal_tolerance, names),
            self._stopped(names, message.goal_tolerance),
            goal_time,
            moving_time,
        )
        times = [seconds(point.time_from_start) for point in message.trajectory.points]
        if not times:
            return _Following(self, self.player.here(names), names, limits, times)
        now, ros_now = monotonic.now(), time.time()
        try:
            motion = trajectory_of(
                message.trajectory, self.player.joints, self.player.where, now, ros_now
            )
        except OldTrajectory as error:
            raise _refusal(Code.OLD_HEADER_TIMESTAMP, str(error)) from None
        except MessageError as error:
            raise _refusal(Code.INVALID_GOAL, str(error)) from None
        return _Following(self, motion, names, limits, times)

    def _stopped(self, names: Sequence[str], given: Iterable[Any]) -> dict[str, float]:
        """Return the speeds below which joints have stopped, for those without one in the goal."""
        own = {tolerance.name for tolerance in given if tolerance.velocity != 0.0}
        least, joints = self.served.number(STOPPED), self.player.joints
        return {name: max(least, _NOISE * joints[name].speed) for name in names if name not in own}

    def _check_joints(self, names: Sequence[str]) -> None:
        try:
            checked_names(names, self.player.joints)
        except MessageError as error:
            raise _refusal(Code.INVALID_JOINTS, str(error)) from None
        model, by_actuator = self.served.model, dict[int | None, str]()
        for name in names:
            if name in self.served.actuators:
                actuator: int | None = self.served.actuators.index(name)
            else:
                actuator = model.transmission.moves(model.joint_names.index(name))
            other = by_actuator.setdefault(actuator, name)
            if other != name:
                raise _refusal(
                    Code.INVALID_JOINTS, f"'{other}' and '{name}' are moved by the same actuator"
                )

    def measured(self, state: State) -> _Joints:
        """Return the measured positions and velocities of joints and actuators."""
        rates = self.served.model.transmission.velocities(state.position, state.velocity)
        names = self.served.model.joint_names
        joints = {
            name: (state.joints[name], rate)
            for name, rate in zip(names, rates.tolist(), strict=True)
        }
        pairs = zip(state.position.tolist(), state.velocity.tolist(), strict=True)
        return joints | dict(zip(state.names, pairs, strict=True))


class _Limits(NamedTuple):
    """Conditions for reaching and for violating a goal.

    Attributes:
        path: Tolerances along the path, by joint.
        goal: Tolerances at the end, by joint.
        stopped: Speeds below which joints have stopped, by joint [rad/s | m/s].
        time: Longest time after its end to be inside ``goal`` [s].
        moving_time: Longest time after its end to stop [s].
    """

    path: Mapping[str, Tolerance]
    goal: Mapping[str, Tolerance]
    stopped: Mapping[str, float]
    time: float
    moving_time: float


class _Following:
    """Job of a goal: streams a trajectory to the hand and checks its tolerances."""

    def __init__(
        self,
        action: TrajectoryAction,
        motion: JointMotion,
        names: Sequence[str],
        limits: _Limits,
        times: Sequence[float],
    ) -> None:
        self._action, self._motion, self._names, self._limits = action, motion, names, limits
        self._times = times
        # Times in feedback count from the beginning of the points, which a stamp may set.
        self._begin = motion.end - (times[-1] if times else 0.0)
        self._outcome: ActionOutcome | None = None
        self._changed = anyio.Event()
        self._played = math.inf  # when the hand was first seen to play it
        self._passed = False  # its end has been checked
        self._after = 0  # states since the hand played its end
        self._play = Play(
            motion, f"a goal of {ACTION}", math.inf, failed=self.fail, replaced=self._replaced
        )

    async def run(self, goal: ServerGoal) -> ActionOutcome:
        """Follow the trajectory to the end of the goal."""
        try:
            # The hand may have ended, or the goal been cancelled, before this task began.
            if self._outcome is None:
                self._action.player.play(self._play)
                async with anyio.create_task_group() as group:
                    group.start_soon(self._watch, goal)
                    await self._changed.wait()
                    group.cancel_scope.cancel()
            if self._outcome is None:
                raise RuntimeError("a goal has ended without an outcome")
            return self._outcome
        finally:
            # Otherwise the player would repeat the last set-point for ever and keep the lease.
            if math.isinf(self._play.until):
                self._play.until = monotonic.now()
            self._action.forget(self)

    async def cancel(self) -> None:
        """Hold the joints at their present positions."""
        if self._end(GoalState.CANCELED, Code.SUCCESSFUL, "it was cancelled"):
            self._hold()

    def fail(self, reason: str) -> None:
        """Abort the goal, which the hand refuses or stops following."""
        self._end(GoalState.ABORTED, Code.INVALID_GOAL, reason)

    def _replaced(self, source: str) -> None:
        self.fail(f"it was pre-empted by {source}")

    def _hold(self) -> None:
        def failed(reason: str) -> None:
            self._action.served.node.context.log.warning("%s is not held: %s", ACTION, reason)

        self._action.player.hold(self._names, f"the end of a goal of {ACTION}", failed)

    def _violated(self, code: Code, text: str) -> None:
        if self._end(GoalState.ABORTED, code, text):
            self._hold()

    def _end(self, state: GoalState, code: Code, text: str) -> bool:
        """End the goal; return whether the hand was still following it."""
        first = self._outcome is None
        if first:
            result = self._action.type.result(error_code=code, error_string=text)
            reason = f"{code.name}: {text}" if state is GoalState.ABORTED else ""
            # The first outcome stays, whatever else ends the goal.
            self._outcome = ActionOutcome(state, result, reason)
            self._changed.set()
        return first

    async def _watch(self, goal: ServerGoal) -> None:
        """Check the hand's states until the goal is reached or a tolerance violated."""
        try:
            for_feedback = partial(next, count())
            async for state in self._action.served.hand.states(_RATE):
                now = monotonic.now()
                lag = state.channels.get(LAG_CHANNEL)
                # The lag may be that of a stream that has just ended.
                if lag is not None and self._play.begun:
                    self._played = min(self._played, now)
                # The stream plays set-points with a lag.
                at = now - (0.0 if lag is None else float(lag[0]))
                desired, actual = self._motion.at(at), self._action.measured(state)
                if for_feedback() % _EVERY == 0 and goal.heard:
                    self._publish(goal, at, desired, actual)
                # Without a lag, the stream does not play yet, and there is nothing to compare.
                if lag is not None or now > self._motion.end:
                    self._judge(now, at, desired, actual)
        except RteeError as error:
            self.fail(str(error))

    def _judge(self, now: float, at: float, desired: SetPoint, actual: _Joints) -> None:
        """End the goal if it is reached or a tolerance is violated."""
        end, limits = self._motion.end, self._limits
        # Also check the first state after the end: a short trajectory may have no earlier one.
        played = self._played <= now
        if played and not self._passed:
            self._passed = at >= end
            if outside := _outside(limits.path, desired, actual):
                self._violated(Code.PATH_TOLERANCE_VIOLATED, f"on its way {outside}")
                return
        if at < end:
            return
        outside, moving = _outside(limits.goal, desired, actual), _moving(limits.stopped, actual)
        if not played:
            # Joints that have not set off yet do not move, either.
            moving = moving or "the hand had not played it"
        else:
            self._after += 1
        # Without goal tolerances, the goal is reached only after a time to settle, counted in
        # states: a measurement may be older than the end, and on a busy computer the hand may play
        # nothing for some time.
        if not (outside or moving) and (limits.goal or self._after >= SETTLED * _RATE):
            # The stream went on until now, for a hand that is slower than the trajectory.
            self._play.until = max(now, end + SETTLED)
            self._end(GoalState.SUCCEEDED, Code.SUCCESSFUL, _farthest(desired, actual))
        elif (outside and now > end + limits.time) or (moving and now > end + limits.moving_time):
            late = f"{now - end:.3g} s after its end {outside or moving}"
            self._violated(Code.GOAL_TOLERANCE_VIOLATED, late)

    def _publish(self, goal: ServerGoal, at: float, desired: SetPoint, actual: _Joints) -> None:
        """Publish feedback."""
        wanted = [desired.position[name] for name in self._names]
        speeds = [desired.velocity.get(name, 0.0) for name in self._names]
        measured = [actual[name] for name in self._names]
        since = at - self._begin
        duration = self._action.duration(**time_fields(round(max(0.0, since) * 1e9)))

        def point(positions: list[float], velocities: list[float]) -> Message:
            return self._action.point(
                positions=positions, velocities=velocities, time_from_start=duration
            )

        goal.feedback(
            header=self._action.served.header(time.time_ns()),
            joint_names=list(self._names),
            desired=point(wanted, speeds),
            actual=point([p for p, _ in measured], [v for _, v in measured]),
            error=point(
                [p - q for p, (q, _) in zip(wanted, measured, strict=True)],
                [v - w for v, (_, w) in zip(speeds, measured, strict=True)],
            ),
            index=max(0, bisect.bisect_right(self._times, since) - 1),
        )


def _outside(
    tolerances: Mapping[str, Tolerance],
    desired: SetPoint,
    actual: Mapping[str, tuple[float, float]],
) -> str:
    """Return a sentence about a joint outside its tolerance; ``""`` if there is none."""
    for name, tolerance in tolerances.items():
        position, velocity = actual[name]
        error = abs(desired.position[name] - position)
        # `not <=` instead of `>`, so that NaN counts as outside.
        if not error <= tolerance.position:
            return f"'{name}' was off by {error:.3g}, more than {tolerance.position:g}"
        error = abs(desired.velocity.get(name, 0.0) - velocity)
        if not error <= tolerance.velocity:
            return (
                f"the velocity of '{name}' was off by {error:.3g}, more than {tolerance.velocity:g}"
            )
    return ""


def _moving(stopped: Mapping[str, float], actual: _Joints) -> str:
    """Return a sentence about a joint that moves; unmeasured speeds count as 0."""
    for name, limit in stopped.items():
        speed = abs(actual[name][1])
        if speed > limit:
            return f"'{name}' moved at {speed:.3g}, more than {limit:g}"
    return ""


def _farthest(desired: SetPoint, actual: Mapping[str, tuple[float, float]]) -> str:
    """Return a sentence about the joint with the largest error."""
    error, name = max((abs(q - actual[name][0]), name) for name, q in desired.position.items())
    return f"the goal is reached; '{name}' is off by {error:.3g}"


def _refusal(code: Code, reason: str) -> MessageError:
    return MessageError(f"{code.name}: {reason}")


log = logging.getLogger(__name__)

COMMANDS, TRAJECTORY, JOG = "~/commands", "~/joint_trajectory", "~/joint_jog"

_LOGGED_AGAIN = 10.0
"""Time until refused messages of a topic are logged again [s]: a sender may send them at 100 Hz."""

_JOGGED_FOR = 0.1
"""Duration of a jog by velocities whose message gives none [s]: input devices send at least every
0.1 s."""


class Setpoints(Part):
    """Moves the hand by the topics and the action of trajectories; the newest command wins."""

    def __init__(self, served: ServedHand) -> None:
        self._served = served
        self._player = MotionPlayer(served)
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
            await self._action.end("the hand has left ROS 2")

    # --- messages of the topics

    def _take(self, topic: str, read: Callable[[Any], JointMotion], message: Any) -> None:
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
        """Log why a message is refused, at most once per `_LOGGED_AGAIN` and topic."""
        now = monotonic.now()
        logged, unlogged = self._refused.get(topic, (-math.inf, 0))
        if now < logged + _LOGGED_AGAIN:
            self._refused[topic] = logged, unlogged + 1
            return
        name = self._served.node.name.resolve(topic)
        more = f" ({unlogged} more were refused before)" if unlogged else ""
        log.warning("a message on %s is refused: %s%s", name, reason, more)
        self._refused[topic] = now, 0

    def _commands(self, message: Any) -> JointMotion:
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

    def _trajectory(self, message: Any) -> JointMotion:
        now, ros_now = monotonic.now(), time.time()
        return trajectory_of(message, self._player.joints, self._player.where, now, ros_now)

    def _jog(self, message: Any) -> JointMotion:
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
