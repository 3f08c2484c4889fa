"""What the loop is told: plain data without pydantic, made from hand.yaml by `rtee.run`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from rtee.errors import ConfigError
from rtee.types import DeviceSpec

MIN_RATE = 1.0
"""Slowest rate of the loop [Hz]."""

MAX_RATE = 2000.0
"""Fastest rate of the loop [Hz]."""


class ProfileKind(StrEnum):
    """How the reference gets from one set-point to the next."""

    JERK_LIMITED = "jerk_limited"
    """By ruckig."""
    S_CURVE = "s_curve"
    """Under the same limits, without ruckig."""
    FILTER = "filter"
    STEP = "step"


def usual_profile() -> ProfileKind:
    """Return the default profile: ``s_curve`` where ruckig is not installed."""
    try:
        import ruckig  # noqa: F401
    except ImportError:
        return ProfileKind.S_CURVE
    return ProfileKind.JERK_LIMITED


class Behaviour(StrEnum):
    """What the hand does when nobody drives it any more."""

    HOLD = "hold"
    """Keep the measured posture, powered."""
    STOP = "stop"
    """Stop the devices' motion now, powered."""
    OPEN = "open"
    """Go to the rest posture, then hold."""
    DISABLE = "disable"
    """Take the drive power away, so that the actuators are limp."""


@dataclass(frozen=True, slots=True)
class ProfileSettings:
    """The profile between set-points.

    Attributes:
        kind: Which profile.
        bandwidth: Bandwidth of the `ProfileKind.FILTER` profile [Hz].
    """

    kind: ProfileKind = field(default_factory=usual_profile)
    bandwidth: float = 2.0


@dataclass(frozen=True, slots=True)
class StallSettings:
    """When an actuator counts as stalled.

    Attributes:
        time: How long it must be slow [s].
        speed: Slow means below this fraction of its velocity limit.
    """

    time: float = 0.25
    speed: float = 0.02


@dataclass(frozen=True, slots=True)
class GraspSettings:
    """When a stalled actuator counts as holding something, and how hard it holds afterwards.

    Attributes:
        effort: Measured effort above this fraction of the effort limit means contact.
        grip_effort: Effort limit while holding, as a fraction of the effort limit.
        grip_after: Time after the grasp at which the effort is reduced to it [s].
        touch: Force at a fingertip above which it touches [N], where that is measured.
    """

    effort: float = 0.2
    grip_effort: float = 0.4
    grip_after: float = 2.0
    touch: float = 0.1


@dataclass(frozen=True, slots=True)
class SafetySettings:
    """What happens when something ends or breaks.

    Attributes:
        on_exit: When the loop ends: SIGINT, SIGTERM, end of the given duration.
        on_client_lost: When the client that holds the hand has died.
        on_link_lost: What the remaining devices of a hand do when one of them is lost.
        on_error: When the loop itself fails.
        max_step: Largest change of a reference per tick [rad | m]; ``None``: one tick at the
            velocity limit.
        idle_disable: A hand that nobody has moved for this long, and that holds nothing, goes limp
            [s]; ``None``: never.
    """

    on_exit: Behaviour = Behaviour.HOLD
    on_client_lost: Behaviour = Behaviour.HOLD
    on_link_lost: Behaviour = Behaviour.HOLD
    on_error: Behaviour = Behaviour.STOP
    max_step: float | None = None
    idle_disable: float | None = None


@dataclass(frozen=True, slots=True)
class ThermalSettings:
    """Thresholds of actuator temperature [°C], and how it is estimated where it isn't measured.

    Attributes:
        warn: An event is raised.
        derate: The effort limit falls linearly from here, to nothing at `disable`.
        disable: The device is disabled.
        nominal_current: Current by actuator that it may be given for ever [A]; with it, the
            temperature is estimated from the measured current. ``defaults``: of all others.
        time_constant: Time in which it comes within 37 % of its final temperature [s].
        ambient: Temperature of the surroundings [°C].
    """

    warn: float = 60.0
    derate: float = 70.0
    disable: float = 80.0
    nominal_current: Mapping[str, float] = field(default_factory=dict)
    time_constant: float = 30.0
    ambient: float = 25.0


@dataclass(frozen=True, slots=True)
class RealtimeSettings:
    """Real-time set-up of the loop's thread.

    Attributes:
        enabled: Whether to ask the system for it.
        priority: SCHED_FIFO priority, 1 to 99.
        cpus: CPUs the loop's thread may run on; empty: all.
        lock_memory: Keep all pages of the process in memory.
        helper_priority: SCHED_FIFO priority of the process's other threads; 0: they stay ordinary.
    """

    enabled: bool = False
    priority: int = 80
    cpus: tuple[int, ...] = ()
    lock_memory: bool = True
    helper_priority: int = 0


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """A device of a hand, as the supervisor needs it.

    Attributes:
        spec: What the driver is made from.
        reconnect_active: Activate again by itself after the link came back; else stay inactive.
    """

    spec: DeviceSpec
    reconnect_active: bool = False


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """The loop of one hand.

    Attributes:
        rate: Ticks per second [Hz], `MIN_RATE` to `MAX_RATE`.
        goal_timeout: Longest time a goal may take that gives none [s].
        profile: The profile between set-points.
        stall: Stall detection.
        grasp: Grasp detection and grip effort.
        safety: What happens when something ends or breaks.
        thermal: Temperatures.
        feedback_rate: Feedback is given at most this often [Hz].
        statistics_window: Device status and loop statistics are given this often [s].

    Raises:
        ConfigError: if the rate is out of range.
    """

    rate: float = 1000.0
    goal_timeout: float = 10.0
    profile: ProfileSettings = field(default_factory=ProfileSettings)
    stall: StallSettings = field(default_factory=StallSettings)
    grasp: GraspSettings = field(default_factory=GraspSettings)
    safety: SafetySettings = field(default_factory=SafetySettings)
    thermal: ThermalSettings = field(default_factory=ThermalSettings)
    feedback_rate: float = 50.0
    statistics_window: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and MIN_RATE <= self.rate <= MAX_RATE):
            raise ConfigError(
                f"the loop's rate must be {MIN_RATE:g} to {MAX_RATE:g} Hz, not {self.rate:g}"
            )

    @property
    def period(self) -> float:
        """Time between ticks [s]."""
        return 1.0 / self.rate
