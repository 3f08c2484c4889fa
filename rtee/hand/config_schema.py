"""The sections of ``hand.yaml``: settings with defaults, bounds and meaning.

The loop, the recorder and the server use them directly; what is read from a file is checked against
their types and bounds, and `rtee.hand.schema` makes the JSON schema for editors of them.
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
    """Take the drive power away, so that the actuators are limp."""


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
    """Velocity limit [rad/s | m/s]; lowers the URDF's where that is higher."""
    acceleration: Positive | None = None
    """Acceleration limit [rad/s² | m/s²]; lowers the URDF's where that is higher. Without either,
    the velocity limit in 0.1 s."""
    jerk: Positive | None = None
    """Jerk limit [rad/s³ | m/s³]; lowers the URDF's where that is higher. Without either, the
    acceleration limit in 0.05 s."""
    effort: Positive | None = None
    """Effort limit [N·m | N]; lowers the URDF's where that is higher."""
    range: PositionRange | None = None
    """Which position limits of the URDF hold: ``soft``, those of ``<safety_controller>`` where it
    gives any, unless given; or ``hard``, those of ``<limit>``."""
    lower: float | None = None
    """Lower position limit [rad | m]."""
    upper: float | None = None
    """Upper position limit [rad | m]."""


class Following(StrEnum):
    """Ways in which joints follow their actuator."""

    RIGID = "rigid"
    """As geared."""
    SPRING = "spring"
    """Each on a spring of its own."""
    TENDON = "tendon"
    """On springs, with a tendon that shares the actuator's effort among them."""
    LINKAGE = "linkage"
    """On springs, with a linkage in each finger that shares its effort among the finger's own."""


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
    """Share of its effort that reaches the fingertips, besides dry friction; 1 unless given.
    Estimates of forces at fingertips use it; the simulation has none."""
    coupling: Following | None = None
    """How joints follow it: ``rigid``: as geared, unless given; ``spring``: each on a spring of its
    own; ``tendon``: on springs, and one tendon shares the effort among them, so that those that are
    free go on, ahead of the actuator, when others are stopped; ``linkage``: the same within each
    finger, while no finger gives way to another."""
    joints: Names | None = None
    """The joints that follow by springs or the tendon: names, or patterns such as
    ``*_distal_joint``; unless given, all that follow, with the actuator's own if it carries a
    shape."""
    shares: dict[str, float] | None = None
    """Instead of ``joints``: their torques in relation to one another; unless given, in proportion
    to how far each follows."""
    finger_force: Positive | None = None
    """Largest force of each fingertip by the device's sheet [N], where its effort limit would give
    more at some openings: goals ask for no more, and the simulation exerts no more."""
    give: Positive | None = None
    """How far a joint on a spring yields to its part of the full effort [rad | m]; 0.4 rad or 4 mm
    unless given."""


class ProfileSettings(Section, frozen=True):
    """Motion of references between set-points."""

    kind: ProfileKind = ProfileKind.JERK_LIMITED
    """``jerk_limited``: within velocity, acceleration and jerk limits, all actuators arriving
    together, by ruckig; ``s_curve``: the same without ruckig, and what ``jerk_limited`` means where
    that is not installed; ``filter``: critically damped second order after a
    smoothed target; ``step``: at once."""
    bandwidth: Positive = 2.0
    """Bandwidth of ``filter`` [Hz]."""


class StallSettings(Section, frozen=True):
    """Criteria for a stalled actuator."""

    time: Positive = 0.25
    """It has been slower than ``speed`` for this long while its reference is elsewhere [s]."""
    speed: Fraction = 0.02
    """Share of the velocity limit."""


class GraspSettings(Section, frozen=True):
    """Criteria for a finger that holds something, and its grip force."""

    effort: Fraction = 0.2
    """A stalled actuator above this share of its effort limit holds something."""
    grip_effort: Annotated[float, Meta(gt=0, le=1)] = 0.4
    """Effort while holding, as a share of the effort limit."""
    grip_after: NotNegative = 2.0
    """Time after the grasp until the effort is lowered to ``grip_effort`` [s]."""
    touch: NotNegative = 0.1
    """Force on a finger above which it touches [N], where a device measures it."""
    on_contact: OnContact | None = None
    """What fingers do when they touch something, unless a goal says otherwise: ``stop`` where they
    are, ``hold`` there lightly, ``squeeze`` together once enough of them touch. Unless given, they
    close on with the effort limits until they stall."""
    contact_force: Positive = 0.5
    """Where no device measures forces on the fingers: force at the fingertips above which an
    actuator's effort counts as a contact [N]."""
    contact_fingers: Annotated[int, Meta(ge=1)] = 2
    """Number of fingers that must touch before they squeeze; actions with an opening need one on
    each of its sides instead."""
    squeeze_time: NotNegative = 0.3
    """Time in which the force is then built up [s]."""


class StreamSettings(Section, frozen=True):
    """Streams of set-points."""

    deadline: Annotated[float, Meta(gt=0, le=LONGEST_DEADLINE)] = 0.1
    """A stream without a sample for this long brakes and holds [s]; a stream may ask for another
    one."""
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
    """An opening is reached when it is off by no more than this [m]."""
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
    """Its priority."""
    cpus: tuple[Annotated[int, Meta(ge=0)], ...] = ()
    """Processors the loop may run on; empty for all."""
    lock_memory: bool = True
    """Keep the process's memory from being swapped out."""
    helper_priority: Annotated[int, Meta(ge=0, le=98)] = 0
    """Real-time priority of the recorder's and the network's threads, for which the loop has to
    wait when other programs keep them from running; 0 leaves them ordinary."""


class SafetySettings(Section, frozen=True):
    """Behaviour of the hand when a program ends or a part fails."""

    on_exit: Behaviour = Behaviour.HOLD
    """When the loop ends: ``hold`` the pose, ``stop`` motion, ``open`` the hand, ``disable``
    the drives (limp)."""
    on_client_lost: Behaviour = Behaviour.HOLD
    """When the client that holds the hand has died."""
    on_link_lost: Behaviour = Behaviour.HOLD
    """When a device does not answer any more, for the others."""
    on_error: Behaviour = Behaviour.STOP
    """When the loop itself fails."""
    max_step: Positive | None = None
    """Largest change of a reference within one tick [rad | m]; unless given, what the velocity
    limit allows."""
    idle_disable: Positive | None = None
    """A hand that nobody has moved for this long [s], and that holds nothing, goes limp, where its
    devices can be; ``rtee recover`` wakes it. Unless given, it stays powered."""


class ThermalSettings(Section, frozen=True):
    """Temperatures of actuators [°C]."""

    warn: float = 60.0
    """From here on a warning is given."""
    derate: float = 70.0
    """From here on the effort limit falls, to nothing at ``disable``."""
    disable: float = 80.0
    """From here on the actuator's device is disabled."""
    nominal_current: Mapping[str, Positive] = field(default_factory=dict)
    """Largest continuous current by actuator [A]; ``defaults``: of all others. Where no
    temperature is measured, it is estimated from the measured current."""
    time_constant: Positive = 30.0
    """Time in which an estimated temperature comes within 37 % of its final value [s]."""
    ambient: float = 25.0
    """Temperature of the surroundings, where estimates begin; below ``warn``."""

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
    """What happens: from 5 s before a goal, command, stream or event to 5 s after it."""
    FAULTS = "faults"
    """The half minute before something fails, as the flight recorder writes it."""


class RecordingLayout(StrEnum):
    """Layouts of recorded states and references."""

    MESSAGES = "messages"
    """Three messages each, which any software reads."""
    COLUMNS = "columns"
    """Column by column, in a third of the room; other software reads ``tf_rate`` of them a
    second."""


class LogSection(Section, frozen=True):
    """Recordings."""

    directory: Path | None = None
    """Folder of the recordings, relative to the working directory; unless given, ``logs``. With
    ``rtee run --no-log`` or ``enabled: false`` faults are written only where a folder is given."""
    enabled: bool = True
    """Record while the hand runs."""
    record: Recorded = Recorded.FULL
    """What is recorded: ``full``, every tick; ``goals``, from 5 s before a goal, command, stream or
    event to 5 s after it; ``faults``, only what ``flight_recorder`` keeps. Only ``full`` recordings
    can be recomputed."""
    layout: RecordingLayout = RecordingLayout.MESSAGES
    """How ticks are recorded: ``messages``, which any software reads, or ``columns`` in a third of
    the room, of which other software reads ``tf_rate`` a second. Nothing is lost in either."""
    max_file_size: Positive = 1e9
    """A new file is begun beyond this size [bytes]."""
    max_file_time: Positive = 3600.0
    """A new file is begun after this time [s]."""
    max_total_size: Positive = 2e10
    """The oldest recordings of the hand are deleted beyond this size of all [bytes]."""
    max_folder_size: Positive = 1e11
    """The oldest recordings of all hands in the folder are deleted beyond this size [bytes]."""
    common_directory: Path | None = None
    """Folder above ``directory`` in which several hands have theirs: what is recorded anywhere
    below it counts together for all these bounds, and the oldest of it makes room."""
    reserve: NotNegative = 1e9
    """So much of the disk stays free [bytes]: the oldest recordings in the folder make room, and
    when there are none, recording pauses."""
    flight_recorder: NotNegative = 30.0
    """This much is kept in memory and written when something fails [s]; 0: nothing."""
    decimation: Annotated[int, Meta(ge=1)] = 1
    """Record every n-th tick; only recordings of every tick can be recomputed."""
    tf_rate: NotNegative = 50.0
    """Rate of the links' transforms on ``/tf``, from which Foxglove and RViz show the moving hand
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
    """Folder with the certificates that ``rtee secure`` has made; unless given, where it makes
    them."""
    insecure: bool = False
    """Allow endpoints without certificates beyond this computer: whoever reaches them can move the
    hand."""


class RemoteSettings(Section, frozen=True):
    """The hand on the network."""

    listen: Names = ()
    """Zenoh endpoints to listen on, such as ``tls/192.168.1.10:7447``; empty: this machine only."""
    connect: Names = ()
    """Zenoh endpoints of routers to connect to, as ``rtee router`` is; they may come up later."""
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
    """Each motion is played in simulation, where it can be, and a person says yes to it."""
    SIMULATE = "simulate"
    """Each motion is played in simulation first, and refused if it fails there."""
    ACT = "act"
    """It moves the hand within the limits."""


class AgentSettings(Section, frozen=True):
    """Permissions of a language model that uses the hand by ``rtee mcp``.

    Its command line may allow less than is given here, never more; what is not given here, the
    command line decides.
    """

    gate: Gate | None = None
    """``watch``, unless given anywhere: it only reads; ``approve``: each motion is played in
    simulation, and a person says yes to it; ``simulate``: each motion is played in simulation, and
    refused if it loses the object, collides or exceeds ``force``; ``act``: it moves the hand within
    the limits below, which always hold."""
    force: Annotated[float, Meta(gt=0, le=1000)] | None = None
    """Largest force that it may ask for, and that a simulation may come to [N]; 10 N unless
    given."""
    effort: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Largest effort of actions that are done without a force, as a share of the effort limits; 0.4
    unless given."""
    speed: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Largest speed, as a share of the velocity limits; 0.5 unless given."""
    actions: Names = ()
    """Names of the actions that it may do; ``grasp`` stands for grasping by width and force, and
    ``open`` for opening. Empty: all."""


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
    """Be a node of ROS 2. ROS 2 knows no identities: whoever reaches its router can move the
    hand."""
    domain: Annotated[int, Meta(ge=0, le=232)] = 0
    """The domain, unless ``ROS_DOMAIN_ID`` gives another."""
    namespace: str = ""
    """Namespace of the node, such as ``left``; empty: none."""
    distro: Distro = Distro.JAZZY
    """Distribution of the other nodes: jazzy, kilted, rolling or humble."""
    router: str = "tcp/localhost:7447"
    """Zenoh endpoint of the router (``rmw_zenohd``)."""
    rate: Annotated[float, Meta(ge=1, le=1000)] = 100.0
    """Rate of ``joint_states`` and of the other topics with what is measured [Hz]."""
    tf: bool = False
    """Publish ``/tf`` and ``/tf_static``, where no ``robot_state_publisher`` does."""
    gripper: GripperUnit = GripperUnit.METRES
    """What positions of ``gripper_cmd`` are: the gap between the fingertips in metres, or the value
    of a joint, as MoveIt sends it."""
    gripper_joint: str = ""
    """The actuator whose position goals of ``gripper_cmd`` give, in a hand with several; empty with
    ``gripper: moveit``: the only one."""

    def __post_init__(self) -> None:
        """Check that ROS 2 takes the namespace."""
        if not re.fullmatch(r"/?([A-Za-z_]\w*(/[A-Za-z_]\w*)*/?)?", self.namespace, re.ASCII):
            raise ValueError(
                "the namespace should be of letters, digits and underscores, parted by slashes"
            )


Vector = tuple[float, float, float]
Vectors = tuple[Vector, ...]
Cells = Annotated[int, Meta(ge=1, le=100)]


class FlangeSection(Section, frozen=True):
    """Mounting of the hand on an arm: the pose of its base frame in the arm's flange frame."""

    frame: str = "flange"
    """The flange's frame, as the arm calls it, such as ``tool0``."""
    xyz: Vector = (0.0, 0.0, 0.0)
    """Origin of the hand's base frame in the flange's [m], such as the height of an adapter."""
    rpy: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the hand's base frame in the flange's [rad]."""

    def __post_init__(self) -> None:
        """Check the name, which becomes one in ROS and in messages."""
        if not re.fullmatch(r"/?[A-Za-z_][\w/-]*", self.frame, re.ASCII):
            raise ValueError(
                "'frame' should be the name of a frame: letters, digits, '_', '-', '/'"
            )


class TouchSection(Section, frozen=True):
    """Location of a touch sensor on the hand, and the meaning of its values."""

    link: str | None = None
    """The link that it is on; unless given, its place is as the device's driver says."""
    xyz: Vector = (0.0, 0.0, 0.0)
    """Origin of its frame in the link's [m]."""
    rpy: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of its frame in the link's [rad]; z leads out of the surface."""
    grid: tuple[Cells, Cells] | None = None
    """Rows along x and columns along y of its taxels, which come row by row; the origin is in the
    middle."""
    pitch: tuple[Positive, Positive] = (0.004, 0.004)
    """Distance from row to row and from column to column [m]."""
    positions: Vectors = ()
    """Instead of ``grid``: the positions of the taxels in its frame [m], in their order. With
    neither, a single taxel is at the origin, and of several only the link is known."""
    normals: Vectors = ()
    """Directions out of the surface at the ``positions``; z unless given."""
    scale: Positive | None = None
    """Newtons per unit of a taxel's value, where the device does not measure in
    newtons itself; only forces make a finger feel a contact."""

    def __post_init__(self) -> None:
        """Check that the taxels are given in one way."""
        if self.link is None and (self.grid is not None or self.positions):
            raise ValueError("should name the link that the taxels are on")
        if self.grid is not None and self.positions:
            raise ValueError("should have a grid or positions, not both")
        if self.normals and len(self.normals) != len(self.positions):
            raise ValueError("should have as many normals as positions")
        if any(not any(normal) for normal in self.normals):
            raise ValueError("should have normals that are longer than 0")


class DeviceSection(Section, frozen=True):
    """A physical thing on a bus."""

    driver: str
    """Name of the driver, or ``module:Class`` for one of your own."""
    actuators: Literal["all"] | Names = "all"
    """The actuators it drives."""
    every: Annotated[int, Meta(ge=1)] | None = None
    """Exchange with it every n ticks; unless given, as often as its bus allows."""
    deadline: Positive | None = None
    """Longest time one exchange may take [s]."""
    reconnect: Literal["inactive", "active"] = "inactive"
    """Its lifecycle when it is back after a loss: ``inactive`` waits for ``rtee recover``."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """The driver's own options."""
