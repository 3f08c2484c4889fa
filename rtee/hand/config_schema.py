"""The sections of ``hand.yaml``."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Reaction = Literal["hold", "stop", "open", "disable"]


class Section(BaseModel):
    """A part of hand.yaml: unknown keys and numbers that are none are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class DefaultLimits(Section):
    """Limits of all actuators that have none of their own here."""

    velocity: Positive | None = None
    """Velocity limit [rad/s | m/s]; lowers the URDF's where that is higher."""
    acceleration: Positive | None = None
    """Acceleration limit [rad/s² | m/s²]; unless given, the velocity limit in 0.1 s."""
    jerk: Positive | None = None
    """Jerk limit [rad/s³ | m/s³]; unless given, the acceleration limit in 0.05 s."""
    effort: Positive | None = None
    """Effort limit [N·m | N]; lowers the URDF's where that is higher."""


class ActuatorLimits(DefaultLimits):
    """Limits of one actuator; they may only tighten the URDF's."""

    lower: float | None = None
    """Lower position limit [rad | m]."""
    upper: float | None = None
    """Upper position limit [rad | m]."""


class LimitsSection(Section):
    """Limits by actuator, and those of all others under ``defaults``."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, ActuatorLimits] = Field(init=False)

    defaults: DefaultLimits = DefaultLimits()
    """Limits of all actuators that have none of their own here."""

    @property
    def actuators(self) -> dict[str, ActuatorLimits]:
        """The limits by actuator."""
        return dict(self.__pydantic_extra__ or {})


class Profile(Section):
    """How references move between set-points."""

    kind: Literal["jerk_limited", "s_curve", "filter", "step"] = "jerk_limited"
    """``jerk_limited``: within velocity, acceleration and jerk limits, all actuators arriving
    together, by ruckig; ``s_curve``: the same without ruckig, and what ``jerk_limited`` means where
    that is not installed; ``filter``: critically damped second order after a
    smoothed target; ``step``: at once."""
    bandwidth: Positive = 2.0
    """Bandwidth of ``filter`` [Hz]."""


class Stall(Section):
    """When an actuator counts as stalled."""

    time: Positive = 0.25
    """It has been slower than ``speed`` for this long while its reference is elsewhere [s]."""
    speed: Fraction = 0.02
    """Share of the velocity limit."""


class Grasp(Section):
    """When a finger counts as holding something, and how hard it then holds."""

    effort: Fraction = 0.2
    """A stalled actuator above this share of its effort limit holds something."""
    grip_effort: Fraction = 0.4
    """Effort while holding, as a share of the effort limit."""
    grip_after: NotNegative = 2.0
    """Time after the grasp until the effort is lowered to ``grip_effort`` [s]."""
    touch: NotNegative = 0.1
    """Force at a fingertip above which it touches [N], where a device measures it."""


class Loop(Section):
    """The control loop."""

    rate: Annotated[float, Field(ge=1, le=2000)] = 1000.0
    """Rate of the loop [Hz]."""
    goal_timeout: Positive = 10.0
    """Longest time a goal may take [s]."""
    stall: Stall = Stall()
    """When an actuator counts as stalled."""
    grasp: Grasp = Grasp()
    """When a finger counts as holding something."""


class RealTime(Section):
    """What the operating system is asked for."""

    enabled: bool = False
    """Ask for real-time scheduling (SCHED_FIFO)."""
    priority: Annotated[int, Field(ge=1, le=99)] = 80
    """Its priority."""
    cpus: list[Annotated[int, Field(ge=0)]] = []
    """Processors the loop may run on; empty for all."""
    lock_memory: bool = True
    """Keep the process's memory from being swapped out."""
    helper_priority: Annotated[int, Field(ge=0, le=98)] = 0
    """Real-time priority of the recorder's and the network's threads, for which the loop has to
    wait when other programs keep them from running; 0 leaves them ordinary."""


class Safety(Section):
    """What the hand does when something ends or breaks."""

    on_exit: Reaction = "hold"
    """When the loop ends: ``hold`` the pose, ``stop`` motion, ``open`` the hand, ``disable``
    the drives (limp)."""
    on_client_lost: Reaction = "hold"
    """When the client that holds the hand has died."""
    on_link_lost: Reaction = "hold"
    """When a device does not answer any more, for the others."""
    on_error: Reaction = "stop"
    """When the loop itself fails."""
    max_step: Positive | None = None
    """Largest change of a reference within one tick [rad | m]; unless given, what the velocity
    limit allows."""
    idle_disable: Positive | None = None
    """A hand that nobody has moved for this long [s], and that holds nothing, goes limp, where its
    devices can be; ``rtee recover`` wakes it. Unless given, it stays powered."""


class Thermal(Section):
    """Temperatures of actuators [°C]."""

    warn: float = 60.0
    """From here on a warning is given."""
    derate: float = 70.0
    """From here on the effort limit falls, to nothing at ``disable``."""
    disable: float = 80.0
    """From here on the actuator's device is disabled."""
    nominal_current: dict[str, Positive] = {}
    """Current by actuator that it may be given for ever [A]; ``defaults``: of all others. Where no
    temperature is measured, it is estimated from the measured current."""
    time_constant: Positive = 30.0
    """Time in which an estimated temperature comes within 37 % of its final value [s]."""
    ambient: float = 25.0
    """Temperature of the surroundings, where estimates begin; below ``warn``."""

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if self.nominal_current and not self.ambient < self.warn:
            raise ValueError("should rise: ambient < warn")
        if not self.warn <= self.derate <= self.disable:
            raise ValueError("should rise: warn <= derate <= disable")
        return self


class Log(Section):
    """Recordings."""

    enabled: bool = True
    """Record everything while the hand runs."""
    directory: str = "logs"
    """Folder of the recordings, relative to the working directory."""
    max_file_size: Positive = 1e9
    """A new file is begun beyond this size [bytes]."""
    max_file_time: Positive = 3600.0
    """A new file is begun after this time [s]."""
    max_total_size: Positive = 2e10
    """The oldest recordings are deleted beyond this size of all [bytes]."""
    flight_recorder: NotNegative = 60.0
    """This much is kept in memory, recording or not, and written when something fails [s];
    0: nothing."""
    decimation: Annotated[int, Field(ge=1)] = 1
    """Record every n-th tick; only recordings of every tick can be computed anew."""
    tf_rate: NotNegative = 50.0
    """Rate of the links' transforms on ``/tf``, from which Foxglove and RViz show the moving hand
    [Hz]; 0: none."""
    meshes: bool = True
    """Attach the hand's meshes to recordings and put them into ``/robot_description``."""


class Remote(Section):
    """The hand on the network."""

    listen: list[str] = []
    """Zenoh endpoints to listen on, such as ``tcp/192.168.1.10:7447``; empty: this machine only."""
    connect: list[str] = []
    """Zenoh endpoints to connect to."""
    state_rate: Positive = 100.0
    """Rate at which states are published [Hz]."""


class Device(Section):
    """A physical thing on a bus."""

    driver: str
    """Name of the driver, or ``module:Class`` for one of your own."""
    actuators: Literal["all"] | list[str] = "all"
    """The actuators it drives."""
    every: Annotated[int, Field(ge=1)] | None = None
    """Exchange with it every n ticks; unless given, as often as its bus allows."""
    deadline: Positive | None = None
    """Longest time one exchange may take [s]."""
    reconnect: Literal["inactive", "active"] = "inactive"
    """What it comes back as after it was lost: ``inactive`` waits for ``rtee recover``."""
    options: dict[str, Any] = {}
    """The driver's own options."""
