"""The commands that steer a hand's controller beside its goals.

Goals, commands and measurements determine every reference: a recording of them replays the hand
bit for bit. Units are SI; actuators are named as in the URDF.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Cancel:
    """End a goal as cancelled; the hand brakes and holds the measured posture.

    Attributes:
        goal_id: The goal; empty: whichever runs. If another one runs, nothing happens.
    """

    goal_id: str = ""


@dataclass(frozen=True, slots=True)
class Hold:
    """Brake and hold the measured posture, but for blocked fingers: those keep pressing.

    Attributes:
        reason: Why, in words; the result of the goal that ends says so.
    """

    reason: str = ""


@dataclass(frozen=True, slots=True)
class Freeze:
    """Begin again from the measured positions: the devices have stopped, whatever was sent.

    Attributes:
        reason: Why, in words; the result of the goal that ends says so.
        actuators: Actuators concerned; empty: all.
    """

    reason: str = ""
    actuators: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Jog:
    """Move some actuators to positions; a running goal is pre-empted.

    Attributes:
        positions: Where to, by actuator [rad | m].
        max_velocity: Velocity not to be exceeded [rad/s | m/s]; ``inf``: the actuators' own limits.
    """

    positions: Mapping[str, float]
    max_velocity: float = math.inf


@dataclass(frozen=True, slots=True)
class SetGripEffort:
    """Change the effort kept on what is held.

    Attributes:
        fraction: Fraction of the effort limit, 0 to 1.
    """

    fraction: float


@dataclass(frozen=True, slots=True)
class SetActive:
    """Note whose device may be moved from now on, and whose not.

    Attributes:
        active: Whether the actuator may be moved, by actuator.
    """

    active: Mapping[str, bool]


@dataclass(frozen=True, slots=True)
class SetAcceptsEffort:
    """Note whose device takes effort limits; the others are eased off by their position.

    Attributes:
        accepts: Whether the actuator's device takes them, by actuator.
    """

    accepts: Mapping[str, bool]


@dataclass(frozen=True, slots=True)
class Abort:
    """End the running goal as aborted if it involves one of some actuators.

    Attributes:
        reason: Why, in words; the goal's result says so.
        actuators: Actuators concerned; empty: all.
    """

    reason: str
    actuators: tuple[str, ...] = ()


STREAM_ENDED = "stream_ended"
"""The kind of the event that a stream has ended; its source is the stream."""


@dataclass(frozen=True, slots=True)
class BeginStream:
    """Be ready for the samples of a stream; nothing moves before the first one.

    Attributes:
        stream: Its identifier, without spaces.
        rate: Samples per second that its client means to send [Hz].
        deadline: Without a sample for this long it brakes and holds [s].
        max_lag: Longest lag [s]; ``inf``: the default, 1.2 periods and 5 ms.
        effort: Effort limits by actuator [N·m | N]; the others have the hand's own.
    """

    stream: str
    rate: float
    deadline: float
    max_lag: float = math.inf
    effort: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StreamSample:
    """A sample of a stream, as it was sent and what that comes to.

    Attributes:
        stream: The stream.
        stamp: When it was meant, by the client's clock [s].
        arrival: When it arrived, CLOCK_MONOTONIC of the hand's computer [s].
        targets: As sent: actuator or joint [rad | m], action with its elements [intensity].
        velocity: As sent, by the same names [rad/s | m/s | 1/s].
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
"""A call that steers the controller, other than a goal."""


@dataclass(frozen=True, slots=True)
class CommandRecord:
    """A command with the tick at which it took effect, before that tick's set-points.

    Attributes:
        tick: Number of the tick.
        stamp: When that tick was due, CLOCK_MONOTONIC [s].
        command: The command.
    """

    tick: int
    stamp: float
    command: Command


@dataclass(frozen=True, slots=True)
class StreamTargets:
    """A sample of a stream of set-points, as its client means it.

    Attributes:
        stream: The stream's identifier.
        stamp: When it is meant, by a clock of the client that never jumps [s].
        targets: Actuators and joints [rad | m], or actions with their elements, such as
            ``PinchTight index thumb``, by intensity, 0 to 1.
        velocity: Velocities of some of them [rad/s | m/s], of actions [1/s].
        client: Who sends it.
    """

    stream: str
    stamp: float
    targets: Mapping[str, float]
    velocity: Mapping[str, float] = field(default_factory=dict)
    client: str = ""


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """How a stream of set-points is doing.

    Attributes:
        stream: Its identifier; empty: none runs.
        rate: Measured rate of its samples [Hz].
        lag: Time from a sample's stamp, as the fastest of them arrive, to its set-point [s].
        jitter: Mean deviation of the samples' delays [s].
        samples: Samples that were taken.
        duplicates: Samples dropped that had the stamp of the one before.
        out_of_order: Samples dropped that were older than the one before.
        outliers: Samples dropped that were too far from those around.
        late: Samples taken that came after their turn.
        thinned: Samples dropped unread since they were more than the stream's rate.
        refused: Samples refused: names, numbers or stamps that make no sense.
        pauses: Times that no sample came within the deadline.
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
