"""The sections of ``hand.yaml``: settings with defaults, bounds and meaning.

The loop, the recorder and the server use them directly; what is read from a file is checked against
their types and bounds, and `rtee.hand.schema` makes the editors' JSON schema from them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, field

from rtee.hand.validation import Section
from rtee.types import OnContact

MIN_RATE = 1.0
"""Slowest rate of the loop [Hz]: below it, its one-second statistics would see no tick."""

MAX_RATE = 2000.0
"""Fastest rate of the loop [Hz]: an exchange of one tick must fit into its period."""

LONGEST_DEADLINE = 10.0
"""Longest deadline of a stream [s]: samples further apart are goals, not a stream."""

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(ge=0, le=1)]


Names = tuple[str, ...]


class ProfileKind(StrEnum):
    """Profiles of the reference between set-points."""

    JERK_LIMITED = "jerk_limited"
    S_CURVE = "s_curve"
    FILTER = "filter"
    STEP = "step"


class Behaviour(StrEnum):
    """Behaviours of the hand when it is no longer driven."""

    HOLD = "hold"
    """Keep the measured posture, powered."""
    STOP = "stop"
    """Stop the devices' motion now, powered."""
    OPEN = "open"
    """Go to the rest posture, then hold."""
    DISABLE = "disable"
    """Cut the drive power, so that the actuators are limp."""


class Outside(StrEnum):
    """Treatment of the parts of a robot outside its hand."""

    ABSENT = "absent"
    """They are left out."""
    RIGID = "rigid"
    """They stay as obstacles, with all their joints at 0."""


class PositionRange(StrEnum):
    """Choice of the position limits in a URDF."""

    SOFT = "soft"
    """Those of ``<safety_controller>``, where it gives any."""
    HARD = "hard"
    """Those of ``<limit>``."""


class ActuatorLimits(Section, frozen=True):
    """Limits of one actuator; they may only tighten the URDF's."""

    velocity: Positive | None = None
    """Velocity limit [rad/s | m/s]; lowers a higher one of the URDF."""
    acceleration: Positive | None = None
    """Acceleration limit [rad/s² | m/s²]; lowers a higher one of the URDF. Without either, the
    velocity limit is reached in 0.1 s."""
    jerk: Positive | None = None
    """Jerk limit [rad/s³ | m/s³]; lowers a higher one of the URDF. Without either, the
    acceleration limit is reached in 0.05 s."""
    effort: Positive | None = None
    """Effort limit [N·m | N]; lowers a higher one of the URDF."""
    range: PositionRange | None = None
    """Choice of the URDF's position limits: ``soft`` (unless given) takes those of
    ``<safety_controller>``, if there are any, ``hard`` those of ``<limit>``."""
    lower: float | None = None
    """Lower position limit of references [rad | m]; a device's counts keep their meaning."""
    upper: float | None = None
    """Upper position limit of references [rad | m]; a device's counts keep their meaning."""


class Following(StrEnum):
    """Ways in which joints follow their actuator."""

    RIGID = "rigid"
    """Rigidly, as if geared."""
    SPRING = "spring"
    """Each on a spring of its own."""
    TENDON = "tendon"
    """On springs, with a tendon that shares the actuator's effort among them."""
    LINKAGE = "linkage"
    """On springs, with a linkage that shares the effort among the joints of each finger."""


class ActuatorDynamics(Section, frozen=True):
    """Dynamics of an actuator, as far as known; the simulation derives the rest."""

    kp: Positive | None = None
    """Position gain of its servo [N·m/rad | N/m]."""
    kd: NotNegative | None = None
    """Damping gain of its servo [N·m·s/rad | N·s/m]."""
    ki: NotNegative | None = None
    """Integral gain of its servo [N·m/(rad·s) | N/(m·s)]; 0 unless given."""
    armature: Positive | None = None
    """Inertia of motor and gear, seen at the joint [kg·m² | kg]."""
    damping: NotNegative | None = None
    """Viscous friction of the joint [N·m·s/rad | N·s/m]."""
    dry_friction: NotNegative | None = None
    """Dry friction of the joint [N·m | N]; estimates of forces at fingertips use it, too."""
    efficiency: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Share of its effort, after dry friction, that reaches the fingertips; 1 unless given.
    Estimates of forces at fingertips use it; the simulation does not."""
    coupling: Following | None = None
    """How joints follow it: ``rigid`` (unless given): as if geared; ``spring``: each on its own
    spring; ``tendon``: on springs, and one tendon shares the effort among them, so that free joints
    go on, ahead of the actuator, when others are blocked; ``linkage``: the same within each finger,
    while no finger gives way to another."""
    joints: Names | None = None
    """The joints that follow on springs or the tendon: names, or patterns such as
    ``*_distal_joint``; unless given, all that follow, and the actuator's own joint if it carries a
    shape."""
    shares: dict[str, float] | None = None
    """Instead of ``joints``: the ratio of their torques; unless given, in proportion to how far
    each joint follows."""
    finger_force: Positive | None = None
    """Largest force of each fingertip according to the data sheet [N], if the effort limit would
    give more at some openings: neither goals nor the simulation exceed it."""
    give: Positive | None = None
    """Deflection of a joint on a spring under its part of the full effort [rad | m]; 0.4 rad or
    4 mm unless given."""


class ProfileSettings(Section, frozen=True):
    """Motion of references between set-points."""

    kind: ProfileKind = ProfileKind.JERK_LIMITED
    """``jerk_limited``: within velocity, acceleration and jerk limits, all actuators arriving
    together, by ruckig; ``s_curve``: the same without ruckig, and the replacement for
    ``jerk_limited`` where ruckig is not installed; ``filter``: a critically damped second-order
    filter of a smoothed target; ``step``: at once."""
    bandwidth: Positive = 2.0
    """Bandwidth of ``filter`` [Hz]."""


class StallSettings(Section, frozen=True):
    """Criteria for a stalled actuator."""

    time: Positive = 0.25
    """Time for which the actuator must be slower than ``speed``, away from its reference [s]."""
    speed: Fraction = 0.02
    """Speed below which an actuator may be stalled, as a share of the velocity limit."""


class GraspSettings(Section, frozen=True):
    """Criteria for a finger that holds something, and its grip force."""

    effort: Fraction = 0.2
    """Share of the effort limit above which a stalled actuator holds something."""
    grip_effort: Annotated[float, Meta(gt=0, le=1)] = 0.4
    """Effort while holding, as a share of the effort limit."""
    grip_after: NotNegative = 2.0
    """Time after the grasp until the effort is lowered to ``grip_effort`` [s]."""
    touch: NotNegative = 0.1
    """Force on a finger above which it touches [N], where a device measures it."""
    on_contact: OnContact | None = None
    """Reaction of fingers that touch something, unless a goal says otherwise: ``stop`` where they
    are, ``hold`` there lightly, ``squeeze`` together once enough of them touch. Unless given, they
    go on closing with the effort limits until they stall."""
    contact_force: Positive = 0.5
    """Force at the fingertips above which an actuator's effort counts as a contact, if no device
    measures forces on the fingers [N]."""
    contact_fingers: Annotated[int, Meta(ge=1)] = 2
    """Number of fingers that must touch before they squeeze; actions with an opening need one on
    each of its sides instead."""
    squeeze_time: NotNegative = 0.3
    """Time in which the squeeze builds up its force [s]."""


class StreamSettings(Section, frozen=True):
    """Streams of set-points."""

    deadline: Annotated[float, Meta(gt=0, le=LONGEST_DEADLINE)] = 0.1
    """Time without a sample after which a stream brakes and holds [s]; a stream may ask for another
    deadline."""
    max_lag: Positive | None = None
    """Longest lag between a sample's stamp, as it arrives, and its set-point [s]; unless given, 1.2
    periods of the stream and 5 ms."""


class LoopSection(Section, frozen=True):
    """The control loop."""

    rate: Annotated[float, Meta(ge=MIN_RATE, le=MAX_RATE)] = 1000.0
    """Rate of the loop [Hz]."""
    goal_timeout: Positive = 10.0
    """Longest time a goal may take [s]."""
    opening_tolerance: Positive = 0.0005
    """Error within which an opening counts as reached [m]."""
    stall: StallSettings = StallSettings()
    """Criteria for a stalled actuator."""
    grasp: GraspSettings = GraspSettings()
    """When a finger counts as holding something."""
    stream: StreamSettings = StreamSettings()
    """Streams of set-points."""

    def __post_init__(self) -> None:
        """Check that a stall is noticed before the goal is given up."""
        if self.stall.time >= self.goal_timeout:
            raise ValueError(
                f"a stall is noticed after {self.stall.time:g} s, but a goal ends after "
                f"{self.goal_timeout:g} s: 'time' of stall should be below goal_timeout"
            )


class RealtimeSettings(Section, frozen=True):
    """Requests to the operating system."""

    enabled: bool = False
    """Ask for real-time scheduling (SCHED_FIFO)."""
    priority: Annotated[int, Meta(ge=1, le=99)] = 80
    """Priority of the loop's thread."""
    cpus: tuple[Annotated[int, Meta(ge=0)], ...] = ()
    """Processors the loop may run on; empty for all."""
    lock_memory: bool = True
    """Keep the process's memory from being swapped out."""
    helper_priority: Annotated[int, Meta(ge=0, le=98)] = 0
    """Real-time priority of the threads of the recorder and the network, for which the loop has to
    wait when other programs keep them from running; 0: no real-time priority."""


class SafetySettings(Section, frozen=True):
    """Behaviour of the hand when a program ends or a part fails."""

    on_exit: Behaviour = Behaviour.HOLD
    """When the loop ends: ``hold`` the pose, ``stop`` motion, ``open`` the hand, ``disable``
    the drives (limp)."""
    on_client_lost: Behaviour = Behaviour.HOLD
    """When the client that holds the hand has died."""
    on_link_lost: Behaviour = Behaviour.HOLD
    """When a device no longer answers, for the other devices."""
    on_error: Behaviour = Behaviour.STOP
    """When the loop itself fails."""
    max_step: Positive | None = None
    """Largest change of a reference within one tick [rad | m]; unless given, as much as the
    velocity limit allows."""
    idle_disable: Positive | None = None
    """Time without motion after which a hand that holds nothing goes limp, if its devices can [s];
    ``rtee recover`` wakes it. Unless given, it stays powered."""


class ThermalSettings(Section, frozen=True):
    """Temperatures of actuators [°C]."""

    warn: float = 60.0
    """Temperature above which a warning is given."""
    derate: float = 70.0
    """Temperature above which the effort limit decreases, down to a tenth at ``disable``."""
    disable: float = 80.0
    """Temperature above which the actuator's device is disabled."""
    nominal_current: Mapping[str, Positive] = field(default_factory=dict)
    """Largest continuous current by actuator [A]; ``defaults`` applies to all others. The
    temperature of an actuator without a sensor is estimated from its measured current."""
    time_constant: Positive = 30.0
    """Time in which an estimated temperature comes within 37 % of its final value [s]."""
    ambient: float = 25.0
    """Ambient temperature, at which estimates begin; below ``warn``."""

    def __post_init__(self) -> None:
        """Check that the temperatures rise."""
        if self.nominal_current and not self.ambient < self.warn:
            raise ValueError("should rise: ambient < warn")
        if not self.warn <= self.derate <= self.disable:
            raise ValueError("should rise: warn <= derate <= disable")


class Recorded(StrEnum):
    """Content of a recording."""

    FULL = "full"
    """Every tick."""
    GOALS = "goals"
    """From 5 s before a goal, command, stream or event to 5 s after it."""
    FAULTS = "faults"
    """The half minute before something fails, as the flight recorder writes it."""


class RecordingLayout(StrEnum):
    """Layouts of recorded states and references."""

    MESSAGES = "messages"
    """Three messages each, which any software reads."""
    COLUMNS = "columns"
    """Column by column, in a third of the space; other software reads only ``tf_rate`` of them a
    second."""


class LogSection(Section, frozen=True):
    """Recordings."""

    directory: Path | None = None
    """Folder of the recordings, relative to the working directory; unless given, ``logs``. With
    ``rtee run --no-log`` or ``enabled: false``, faults are recorded only if a folder is given."""
    enabled: bool = True
    """Record while the hand runs."""
    record: Recorded = Recorded.FULL
    """Content of recordings: ``full``, every tick; ``goals``, from 5 s before a goal, command,
    stream or event to 5 s after it; ``faults``, only what ``flight_recorder`` keeps. Only ``full``
    recordings can be recomputed."""
    layout: RecordingLayout = RecordingLayout.MESSAGES
    """Format of recorded ticks: ``messages``, which any software reads, or ``columns``, which take
    a third of the space, but of which other software reads only ``tf_rate`` a second. Both keep
    all data."""
    max_file_size: Positive = 1e9
    """Size after which a new file begins [bytes]."""
    max_file_time: Positive = 3600.0
    """Time after which a new file begins [s]."""
    max_total_size: Positive = 2e10
    """Largest size of all recordings of the hand [bytes]; beyond it, the oldest are deleted."""
    max_folder_size: Positive = 1e11
    """Largest size of the recordings of all hands in the folder [bytes]; beyond it, the oldest are
    deleted."""
    common_directory: Path | None = None
    """Folder above ``directory`` that several hands share: all recordings below it count together
    for these limits, and the oldest of them are deleted first."""
    reserve: NotNegative = 1e9
    """Space of the disk to keep free [bytes]: the oldest recordings in the folder are deleted, and
    when there are none, recording pauses."""
    flight_recorder: NotNegative = 30.0
    """Time that is kept in memory and written when something fails [s]; 0: nothing."""
    decimation: Annotated[int, Meta(ge=1)] = 1
    """Record every n-th tick; only recordings of every tick can be recomputed."""
    tf_rate: NotNegative = 50.0
    """Rate of the links' transforms on ``/tf``, with which Foxglove and RViz show the moving hand
    [Hz]; 0: none."""
    meshes: bool = True
    """Attach the hand's meshes to recordings and put them into ``/robot_description``."""

    @property
    def folder(self) -> Path:
        """Folder of the recordings."""
        return self.directory or Path("logs")


class SecuritySettings(Section, frozen=True):
    """Access to the hand over a network."""

    folder: Path | None = None
    """Folder with the certificates made by ``rtee secure``; unless given, its default folder."""
    insecure: bool = False
    """Allow endpoints without certificates beyond this computer: anyone who reaches them can move
    the hand."""


class RemoteSettings(Section, frozen=True):
    """The hand on the network."""

    listen: Names = ()
    """Zenoh endpoints to listen on, such as ``tls/192.168.1.10:7447``; empty: this machine only."""
    connect: Names = ()
    """Zenoh endpoints of routers to connect to, such as ``rtee router``; they may start later."""
    security: SecuritySettings = SecuritySettings()
    """Access to the hand over a network."""
    state_rate: Positive = 100.0
    """Rate at which states are published [Hz]."""


class Lines(StrEnum):
    """Destinations of log lines about events."""

    STDOUT = "stdout"
    """One JSON object per line."""
    JOURNALD = "journald"
    """Entries with fields ``RTEE_HAND``, ``RTEE_GOAL``, ``RTEE_DEVICE`` and so on."""


class MetricsSettings(Section, frozen=True):
    """Metrics of the hand for Prometheus, see `rtee.remote.metrics`."""

    listen: str = ""
    """``HOST:PORT`` to serve them on, such as ``127.0.0.1:9464``; empty: nowhere."""


class Gate(StrEnum):
    """Gates between an agent and the hand."""

    WATCH = "watch"
    """It reads, and may stop the hand."""
    APPROVE = "approve"
    """Each motion is simulated first, if possible, and a person must approve it."""
    SIMULATE = "simulate"
    """Each motion is simulated first, and refused if it fails there."""
    ACT = "act"
    """It moves the hand within the limits."""


class AgentSettings(Section, frozen=True):
    """Permissions of a language model that uses the hand by ``rtee mcp``.

    The command line of ``rtee mcp`` may allow less, but never more; it decides whatever is not
    given here.
    """

    gate: Gate | None = None
    """``watch`` (the default): the agent only reads; ``approve``: each motion is simulated, and a
    person must approve it; ``simulate``: each motion is simulated, and refused if it loses the
    object, collides or exceeds ``force``; ``act``: the agent moves the hand. The limits below
    always hold."""
    force: Annotated[float, Meta(gt=0, le=1000)] | None = None
    """Largest force that the agent may ask for, and that may occur in the simulation [N]; 10 N
    unless given."""
    effort: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Largest effort of actions without a force, as a share of the effort limits; 0.4 unless
    given."""
    speed: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Largest speed, as a share of the velocity limits; 0.5 unless given."""
    actions: Names = ()
    """Names of the allowed actions; ``grasp`` stands for grasping by width and force, and ``open``
    for opening. Empty: all."""


class Distro(StrEnum):
    """A distribution of ROS 2: it determines the interfaces and their hashes."""

    JAZZY = "jazzy"
    KILTED = "kilted"
    ROLLING = "rolling"
    HUMBLE = "humble"


class GripperUnit(StrEnum):
    """Units of the positions of ``gripper_cmd``."""

    METRES = "metres"
    MOVEIT = "moveit"


class Ros2Settings(Section, frozen=True):
    """The hand as a node of ROS 2, for nodes with the middleware ``rmw_zenoh_cpp``."""

    enabled: bool = False
    """Be a node of ROS 2. ROS 2 does not check identities: anyone who reaches its router can move
    the hand."""
    domain: Annotated[int, Meta(ge=0, le=232)] = 0
    """The domain, unless ``ROS_DOMAIN_ID`` gives another."""
    namespace: str = ""
    """Namespace of the node, such as ``left``; empty: none."""
    distro: Distro = Distro.JAZZY
    """Distribution of the other nodes: jazzy, kilted, rolling or humble."""
    router: str = "tcp/localhost:7447"
    """Zenoh endpoint of the router (``rmw_zenohd``)."""
    rate: Annotated[float, Meta(ge=1, le=1000)] = 100.0
    """Rate of ``joint_states`` and the other topics of measurements [Hz]."""
    tf: bool = False
    """Publish ``/tf`` and ``/tf_static``, for graphs without a ``robot_state_publisher``."""
    gripper: GripperUnit = GripperUnit.METRES
    """Meaning of positions in ``gripper_cmd``: the gap between the fingertips in metres, or the
    value of a joint, as MoveIt sends it."""
    gripper_joint: str = ""
    """Actuator that goals of ``gripper_cmd`` move, in a hand with several; empty with
    ``gripper: moveit``: the only one."""

    def __post_init__(self) -> None:
        """Check that ROS 2 takes the namespace."""
        if not re.fullmatch(r"/?([A-Za-z_]\w*(/[A-Za-z_]\w*)*/?)?", self.namespace, re.ASCII):
            raise ValueError(
                "the namespace should consist of names separated by slashes, each of letters, "
                f"digits and underscores and without a digit at its start, not '{self.namespace}'"
            )


Vector = tuple[float, float, float]
_Coordinate = Annotated[float, Meta(ge=-2, le=2)]
_Angle = Annotated[float, Meta(ge=-7, le=7)]
Place = tuple[_Coordinate, _Coordinate, _Coordinate]
"""A place on a hand or an adapter [m]; nothing there is farther away: millimetres are refused."""
Turn = tuple[_Angle, _Angle, _Angle]
"""Roll, pitch and yaw [rad], about a full turn at most, so that most degrees are refused."""
Vectors = tuple[Vector, ...]
Cells = Annotated[int, Meta(ge=1, le=100)]


class FlangeSection(Section, frozen=True):
    """Mounting of the hand on an arm: the pose of its base frame in the arm's flange frame."""

    frame: str = "flange"
    """Name of the flange's frame on the arm, such as ``tool0``."""
    xyz: Place = (0.0, 0.0, 0.0)
    """Origin of the hand's base frame in the flange frame [m], such as the height of an adapter."""
    rpy: Turn = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the hand's base frame in the flange frame [rad]."""

    def __post_init__(self) -> None:
        """Check the name, which becomes one in ROS and in messages."""
        if not re.fullmatch(r"/?[A-Za-z_][\w/-]*", self.frame, re.ASCII):
            raise ValueError(
                "'frame' should be the name of a frame: letters, digits, '_', '-', '/'"
            )


class TouchSection(Section, frozen=True):
    """Location of a touch sensor on the hand, and the meaning of its values."""

    link: str | None = None
    """The link of the sensor; unless given, the device's driver gives its place."""
    xyz: Place = (0.0, 0.0, 0.0)
    """Origin of the sensor's frame in the link's frame [m]."""
    rpy: Turn = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the sensor's frame in the link's frame [rad]; z points out of the
    surface."""
    grid: tuple[Cells, Cells] | None = None
    """Numbers of rows (along x) and columns (along y) of its taxels, which are read row by row; the
    origin is in the middle."""
    pitch: tuple[Positive, Positive] = (0.004, 0.004)
    """Distance from row to row and from column to column [m]."""
    positions: Vectors = ()
    """Instead of ``grid``: the positions of the taxels in the sensor's frame [m], in order. With
    neither, a single taxel is at the origin; of several taxels only the link is known."""
    normals: Vectors = ()
    """Directions out of the surface at the ``positions``; z unless given."""
    scale: Positive | None = None
    """Newtons per unit of a taxel's value, if the device does not measure in newtons; only forces
    count as contacts of a finger."""

    def __post_init__(self) -> None:
        """Check that the taxels are given in one way."""
        if self.link is None and (self.grid is not None or self.positions):
            raise ValueError("should name the link that the taxels are on")
        if self.grid is not None and self.positions:
            raise ValueError("should have a grid or positions, not both")
        if self.normals and len(self.normals) != len(self.positions):
            raise ValueError("should have as many normals as positions")
        if any(not any(normal) for normal in self.normals):
            raise ValueError("should have normals of non-zero length")


class DeviceSection(Section, frozen=True):
    """A physical device on a bus."""

    driver: str
    """Name of the driver, or ``module:Class`` for your own."""
    actuators: Literal["all"] | Names = "all"
    """Actuators that the device drives."""
    every: Annotated[int, Meta(ge=1)] | None = None
    """Exchange with the device every n ticks; unless given, as often as its bus allows."""
    deadline: Positive | None = None
    """Longest time one exchange may take [s]; after three without an answer, and at least half a
    second, the device is lost."""
    reconnect: Literal["inactive", "active"] = "inactive"
    """State after it is connected again: ``inactive`` waits for ``rtee recover``."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """The driver's own options."""
