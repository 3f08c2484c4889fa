"""Motions from messages of ROS 2: trajectories of joints, jogging, single postures.

Time is CLOCK_MONOTONIC of this computer [s]; stamps of messages, by ROS's clock, are converted when
a message arrives.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np

from rtee.errors import MessageError, suggestion
from rtee.hand.model import Hand

BEYOND = 0.01
"""Share of a range by which a position may exceed its ends, since planners round."""

_LONGEST = 600.0
"""Longest trajectory or jog accepted [s]: no hand moves for ten minutes."""

_MOST_POINTS = 10_000
"""Most points of a trajectory: far more than a planner sends."""

_QUICKEST = 0.05
"""Least time of a jog's displacement [s]: a step would be limited, not followed."""

_STILL = 1e-6
"""Velocity at the end of a trajectory that counts as 0 [rad/s | m/s], since planners round."""

Where = Callable[[str], float]
"""Returns the position of a joint [rad | m]."""


class OldTrajectory(MessageError):
    """A trajectory that ended before it arrived."""


class SetPoint(NamedTuple):
    """Positions [rad | m] and, where known, velocities [rad/s | m/s] by joint at a time."""

    position: Mapping[str, float]
    velocity: Mapping[str, float]


class JointMotion(Protocol):
    """Set-points over time."""

    @property
    def end(self) -> float:
        """Time of the last set-point [s]."""

    def at(self, now: float) -> SetPoint:
        """Return the set-point at a time [s]; after the end, the last one."""


class Range(NamedTuple):
    """Lower and upper limit of a joint [rad | m], infinite for none, and its greatest speed."""

    lower: float
    upper: float
    speed: float

    def clamped(self, value: float) -> float:
        """Return a position clamped to the limits."""
        return min(max(value, self.lower), self.upper)


def movable_joints(model: Hand) -> dict[str, Range]:
    """Return the joints that set-points may name: actuators, and joints that follow one."""
    ranges = {each.name: Range(each.lower, each.upper, each.velocity) for each in model.actuators}
    # For all joints at once: a joint may be faster or slower than the actuator that it follows.
    speeds = np.array([each.velocity for each in model.actuators])
    follow = model.transmission.velocities(model.rest, speeds)
    for row, joint in enumerate(model.joints):
        if joint.name not in ranges and model.transmission.moves(row) is not None:
            ranges[joint.name] = Range(joint.lower, joint.upper, abs(float(follow[row])))
    return ranges


def checked_names(names: Sequence[str], joints: Mapping[str, Range]) -> None:
    """Check the names of joints in a message.

    Raises `MessageError` if there are none, or a name is unknown or occurs twice.
    """
    if not names:
        raise MessageError("the message names no joints")
    for name in names:
        if name not in joints:
            raise MessageError(f"there is no joint '{name[:100]}'; {suggestion(name, joints)}")
    if len(set(names)) < len(names):
        raise MessageError("the message names a joint twice")


def checked_position(name: str, value: float, limits: Range) -> float:
    """Return a position clamped to the limits; raise `MessageError` if it is NaN or far beyond."""
    slack = limits.upper - limits.lower
    # In a range with a single limit, an infinite slack would remove that limit, too.
    slack = BEYOND * slack if math.isfinite(slack) else 0.0
    if not limits.lower - slack <= value <= limits.upper + slack:  # NaN compares as false
        raise MessageError(
            f"position {value:g} of '{name}' is outside its limits, {limits.lower:g} to "
            f"{limits.upper:g}"
        )
    return limits.clamped(value)


def seconds(duration: Any) -> float:
    """Return a ``builtin_interfaces/Duration`` or ``Time`` in seconds."""
    return float(duration.sec) + 1e-9 * float(duration.nanosec)


def began(stamp: Any, now: float, ros_now: float) -> float:
    """Return the time of a header's stamp by CLOCK_MONOTONIC [s]; without a stamp, ``now``.

    ``ros_now`` is the time since 1970 [s] at the same moment as ``now``.
    """
    stamped = seconds(stamp)
    return now if stamped == 0.0 else now + (stamped - ros_now)


@dataclass(frozen=True, slots=True)
class TimedPosture:
    """Positions by joint [rad | m], to be reached at a time [s], as fast as the limits allow."""

    position: Mapping[str, float]
    end: float

    def at(self, now: float) -> SetPoint:
        """Return the set-point, which is the same at any time."""
        return SetPoint(self.position, {})


class Trajectory:
    """A trajectory through points, whose first one is the present position.

    Between two points, a joint follows the cubic polynomial through their positions and velocities,
    or a straight line if the points have no velocities, as the joint_trajectory_controller of
    ros2_control does.

    The times [s] increase; positions [rad | m] and velocities [rad/s | m/s] are lists of one list
    per point, with one number per joint.
    """

    def __init__(
        self,
        names: Sequence[str],
        times: Sequence[float],
        positions: Sequence[Sequence[float]],
        velocities: Sequence[Sequence[float]] | None,
    ) -> None:
        self.names, self._times = tuple(names), list(times)
        self._positions, self._velocities = positions, velocities

    @property
    def begin(self) -> float:
        """Time of the first point [s]."""
        return self._times[0]

    @property
    def end(self) -> float:
        """Time of the last point [s]."""
        return self._times[-1]

    @property
    def goal(self) -> dict[str, float]:
        """The positions of the last point, by joint [rad | m]."""
        return dict(zip(self.names, self._positions[-1], strict=True))

    def at(self, now: float) -> SetPoint:
        """Return the set-point at a time [s]; before the first point or after the last, that point.

        After the end all velocities are 0, whatever the last point has, since the hand stays there.
        """
        if now >= self.end:
            return SetPoint(self.goal, dict.fromkeys(self.names, 0.0))
        after = bisect.bisect_right(self._times, now)
        if after == 0:
            first = dict(zip(self.names, self._positions[0], strict=True))
            return SetPoint(first, dict.fromkeys(self.names, 0.0))
        before = after - 1
        span = self._times[after] - self._times[before]
        s = (now - self._times[before]) / span
        position, velocity = {}, {}
        for k, name in enumerate(self.names):
            p, q = self._positions[before][k], self._positions[after][k]
            if self._velocities is None:
                position[name], velocity[name] = p + s * (q - p), (q - p) / span
                continue
            # Cubic Hermite polynomial in s from 0 to 1, hence velocities per unit of s.
            v, w = self._velocities[before][k] * span, self._velocities[after][k] * span
            b, c = 3.0 * (q - p) - 2.0 * v - w, 2.0 * (p - q) + v + w
            position[name] = p + s * (v + s * (b + s * c))
            velocity[name] = (v + s * (2.0 * b + s * 3.0 * c)) / span
        return SetPoint(position, velocity)


def trajectory_of(
    message: Any, joints: Mapping[str, Range], where: Where, now: float, ros_now: float
) -> Trajectory:
    """Return the trajectory in a ``trajectory_msgs/msg/JointTrajectory``.

    Skips points in the past, as ros2_control does. Ignores accelerations and efforts.

    Args:
        message: The message.
        joints: The joints that the message may name.
        where: Function that returns the present position of a joint [rad | m].
        now: CLOCK_MONOTONIC [s].
        ros_now: The time since 1970 at the same moment [s].

    Raises:
        OldTrajectory: if the trajectory ended before it arrived.
        MessageError: if the hand cannot follow it, with the reason.
    """
    names = list(message.joint_names)
    checked_names(names, joints)
    points = message.points
    if not 0 < len(points) <= _MOST_POINTS:
        raise MessageError(f"a trajectory has 1 to {_MOST_POINTS} points, not {len(points)}")
    begin = began(message.header.stamp, now, ros_now)
    times = [seconds(point.time_from_start) for point in points]
    if times[0] < 0.0 or any(b <= a for a, b in pairwise(times)):
        raise MessageError("the times of its points must increase from 0")
    if times[-1] > _LONGEST or begin - now > _LONGEST:
        raise MessageError(f"it must begin within {_LONGEST:g} s and take at most {_LONGEST:g} s")
    if begin + times[-1] < now:
        raise OldTrajectory(f"it ended {now - begin - times[-1]:.3g} s ago")
    positions, velocities = [], []
    for point in points:
        if len(point.positions) != len(names) or len(point.velocities) not in (0, len(names)):
            raise MessageError(
                f"each point needs {len(names)} positions, and as many velocities or none; one has"
                f" {len(point.positions)} and {len(point.velocities)}"
            )
        pairs = zip(names, map(float, point.positions), strict=True)
        positions.append([checked_position(name, value, joints[name]) for name, value in pairs])
        velocities.append([float(value) for value in point.velocities])
        if not all(map(math.isfinite, velocities[-1])):
            raise MessageError("its velocities must be finite")
    given = all(velocities)
    if not given and any(velocities):
        raise MessageError("either all or none of its points must have velocities")
    if any(abs(value) > _STILL for value in velocities[-1]):
        raise MessageError("its last point must have velocity 0: the hand stops there")
    # Begin at rest at the present position, and move from there to the first point in the future.
    first = next((k for k, time in enumerate(times) if begin + time > now), len(times) - 1)
    start = max(begin, now)
    if begin + times[first] <= start:  # a point for now, reached as fast as the limits allow
        # 1 ms earlier, since the polynomial divides by the time between its two points.
        start = begin + times[first] - 1e-3
    moments = [start, *(begin + time for time in times[first:])]
    # A measured position may exceed the limits slightly; a set-point must not.
    here = [joints[name].clamped(where(name)) for name in names]
    rest = [0.0] * len(names)
    return Trajectory(
        names,
        moments,
        [here, *positions[first:]],
        [rest, *velocities[first:]] if given else None,
    )


class VelocityCommand:
    """Joints that move at constant velocities for a time, inside their limits.

    They start at positions [rad | m] and move at velocities [rad/s | m/s] from ``begin`` to ``end``
    [s].
    """

    def __init__(
        self,
        begin: float,
        end: float,
        start: Mapping[str, float],
        velocity: Mapping[str, float],
        joints: Mapping[str, Range],
    ) -> None:
        self.end = end
        self._begin, self._start, self._velocity, self._joints = begin, start, velocity, joints

    def at(self, now: float) -> SetPoint:
        """Return the set-point at a time [s]."""
        moving = now < self.end
        time = min(max(now, self._begin), self.end) - self._begin
        position, velocity = {}, {}
        for name, start in self._start.items():
            limits, wanted = self._joints[name], start + self._velocity[name] * time
            position[name] = limits.clamped(wanted)
            # With a velocity at a limit, the stream would extrapolate beyond it.
            inside = moving and position[name] == wanted
            velocity[name] = self._velocity[name] if inside else 0.0
        return SetPoint(position, velocity)


def jog_of(
    message: Any,
    joints: Mapping[str, Range],
    where: Where,
    now: float,
    unsaid: float,
) -> VelocityCommand:
    """Return the motion in a ``control_msgs/msg/JointJog``.

    The message has velocities for its duration, or displacements, which take the shortest time
    unless it has a duration. Raises `MessageError` if the hand cannot follow it, with the reason.

    Args:
        message: The message.
        joints: The joints that the message may name.
        where: Function that returns the position of a joint, or its last set-point [rad | m].
        now: CLOCK_MONOTONIC [s].
        unsaid: Duration of a message with velocities but without a duration [s].
    """
    names, duration = list(message.joint_names), float(message.duration)
    checked_names(names, joints)
    if not 0.0 <= duration <= _LONGEST:
        raise MessageError(f"its duration should be 0 to {_LONGEST:g} s, not {duration:g}")
    moves, speeds = list(message.displacements), list(message.velocities)
    if bool(moves) == bool(speeds):
        raise MessageError("it needs either displacements or velocities")
    values = [float(value) for value in moves or speeds]
    if len(values) != len(names) or not all(map(math.isfinite, values)):
        raise MessageError(f"it needs {len(names)} finite numbers, one for each of its joints")
    start = {name: joints[name].clamped(where(name)) for name in names}
    if moves and not duration:
        # A joint that cannot move at its rest posture has no speed there.
        limits = [joints[name].speed or math.inf for name in names]
        duration = max(abs(value) / limit for value, limit in zip(values, limits, strict=True))
        duration = min(max(duration, _QUICKEST), _LONGEST)
    duration = duration or unsaid
    scale = duration if moves else 1.0
    velocity = {name: value / scale for name, value in zip(names, values, strict=True)}
    return VelocityCommand(now, now + duration, start, velocity, joints)
