"""Commands to a hand's controller, other than goals.

Goals, commands and measurements determine every reference: a recording of them replays the hand
bit for bit. Units are SI; actuators are named as in the URDF.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from rtee.values import Value


@dataclass(frozen=True, slots=True)
class Cancel:
    """End a goal as cancelled; the hand brakes and holds the measured posture.

    Attributes:
        goal_id: The goal; empty: the running one. If another goal runs, nothing happens.
    """

    goal_id: str = ""


@dataclass(frozen=True, slots=True)
class Hold:
    """Brake and hold the measured posture; blocked fingers keep pressing.

    Attributes:
        reason: Why, in words, for the result of the goal that ends.
    """

    reason: str = ""


@dataclass(frozen=True, slots=True)
class Freeze:
    """Restart the references from the measured positions, after devices have stopped.

    Attributes:
        reason: Why, in words, for the result of the goal that ends.
        actuators: Actuators concerned; empty: all. Goals and streams of other actuators continue: a
            device that refuses its references does not end them.
    """

    reason: str = ""
    actuators: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Jog:
    """Move some actuators to positions; a running goal is pre-empted.

    Attributes:
        positions: Target positions by actuator [rad | m].
        max_velocity: Velocity limit [rad/s | m/s]; ``inf``: the actuators' own.
    """

    positions: Mapping[str, float]
    max_velocity: float = math.inf


@dataclass(frozen=True, slots=True)
class SetGripEffort:
    """Change the effort kept on a held object.

    Attributes:
        fraction: Fraction of the effort limit, 0 to 1.
    """

    fraction: float


@dataclass(frozen=True, slots=True)
class SetActive:
    """Set which actuators may move from now on, according to the state of their devices.

    Attributes:
        active: Whether each actuator may move, by name.
    """

    active: Mapping[str, bool]


@dataclass(frozen=True, slots=True)
class SetAcceptsEffort:
    """Set which actuators' devices take effort limits; for others, a set-point lowers the effort.

    Attributes:
        accepts: Whether each actuator's device takes effort limits, by name.
    """

    accepts: Mapping[str, bool]


@dataclass(frozen=True, slots=True)
class Abort:
    """End the running goal as aborted if it involves any of the given actuators.

    Attributes:
        reason: Why, in words, for the goal's result.
        actuators: Actuators concerned; empty: all.
    """

    reason: str
    actuators: tuple[str, ...] = ()


STREAM_ENDED = "stream_ended"
"""Kind of the event that reports the end of a stream; its source is the stream."""


@dataclass(frozen=True, slots=True)
class BeginStream:
    """Prepare for the samples of a stream; nothing moves before the first one.

    Attributes:
        stream: Its identifier, without spaces.
        rate: Samples per second that its client intends to send [Hz].
        deadline: Time without a sample after which the hand brakes and holds [s].
        max_lag: Longest lag [s]; ``inf``: the default, 1.2 periods plus 5 ms.
        effort: Effort limits by actuator [N·m | N]; other actuators keep the hand's own.
    """

    stream: str
    rate: float
    deadline: float
    max_lag: float = math.inf
    effort: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StreamSample(Value):
    """A sample of a stream, as sent and as resolved for the actuators.

    Attributes:
        stream: The stream.
        stamp: Time of the sample in the stream's time base [s]: the client's clock until it jumps.
        arrival: Time of its arrival, CLOCK_MONOTONIC of the hand's computer [s].
        targets: Targets as sent, by actuator or joint [rad | m] or by action with its elements
            [intensity].
        velocity: Velocities as sent, by the same names [rad/s | m/s | 1/s].
        positions: Positions by actuator [rad | m].
        velocities: Velocities by actuator [rad/s | m/s]; ``NaN``: not given.
    """

    stream: str
    stamp: float
    arrival: float
    targets: Mapping[str, float]
    velocity: Mapping[str, float]
    positions: Mapping[str, float]
    velocities: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class EndStream:
    """End a stream: its actuators brake and hold. If another stream runs, nothing happens.

    Attributes:
        stream: The stream.
        reason: Why, in words.
    """

    stream: str
    reason: str = ""


Command = (
    Cancel
    | Hold
    | Freeze
    | Jog
    | SetGripEffort
    | SetActive
    | SetAcceptsEffort
    | Abort
    | BeginStream
    | StreamSample
    | EndStream
)
"""A command to the controller, other than a goal."""


@dataclass(frozen=True, slots=True)
class CommandRecord(Value):
    """A command with the tick at which it took effect, before the tick's reference.

    Attributes:
        tick: Number of the tick.
        stamp: Due time of the tick, CLOCK_MONOTONIC [s].
        command: The command.
    """

    tick: int
    stamp: float
    command: Command


@dataclass(frozen=True, slots=True)
class StreamTargets:
    """A sample of a stream of set-points, as its client sends it.

    Attributes:
        stream: The stream's identifier.
        stamp: Time of the sample, by a clock of the client that never jumps [s].
        targets: Positions by actuator or joint [rad | m], or intensities, 0 to 1, by action with
            its elements, such as ``PinchTight index thumb``.
        velocity: Velocities of some of these targets [rad/s | m/s], of actions [1/s].
        client: The client that sends it.
    """

    stream: str
    stamp: float
    targets: Mapping[str, float]
    velocity: Mapping[str, float] = field(default_factory=dict)
    client: str = ""


@dataclass(frozen=True, slots=True)
class StreamStatus(Value):
    """Status of a stream of set-points.

    Attributes:
        stream: Its identifier; empty: none is open.
        rate: Measured rate of its samples [Hz].
        lag: Time from a sample's stamp, plus the shortest delay of the network, to its set-point
            [s].
        jitter: Mean deviation of the samples' delays [s].
        samples: Samples taken.
        duplicates: Samples dropped because they had the stamp of the newest one.
        out_of_order: Samples dropped because they were older than the newest one.
        outliers: Samples dropped because they were too far from the newest one.
        late: Samples taken that arrived after the time at which they were due to be played.
        thinned: Samples dropped unread because they exceeded the stream's rate.
        refused: Samples refused for their names, numbers or stamps.
        pauses: Number of times that no sample arrived within the deadline.
    """

    stream: str = ""
    rate: float = 0.0
    lag: float = 0.0
    jitter: float = 0.0
    samples: int = 0
    duplicates: int = 0
    out_of_order: int = 0
    outliers: int = 0
    late: int = 0
    thinned: int = 0
    refused: int = 0
    pauses: int = 0
