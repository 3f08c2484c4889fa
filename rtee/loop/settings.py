"""The settings of a loop and its devices: those of hand.yaml, and some fixed ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from msgspec import field

from rtee.errors import ConfigError
from rtee.hand.config_schema import (
    MAX_RATE,
    MIN_RATE,
    LoopSection,
    ProfileKind,
    ProfileSettings,
    SafetySettings,
    ThermalSettings,
)
from rtee.loop.free_motion import LearnedMotion
from rtee.types import DeviceSpec


def usual_profile() -> ProfileKind:
    """Return the default profile: ``s_curve`` where ruckig is not installed."""
    try:
        import ruckig  # noqa: F401
    except ImportError:
        return ProfileKind.S_CURVE
    return ProfileKind.JERK_LIMITED


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """The settings of a device, for its supervisor.

    Attributes:
        spec: The specification of the device, for its driver.
        reconnect_active: Whether to activate the device after reconnecting; else it stays inactive.
    """

    spec: DeviceSpec
    reconnect_active: bool = False


class LoopSettings(LoopSection, frozen=True):
    """The settings of one hand's loop.

    Attributes:
        profile: The profile between set-points.
        safety: Behaviour after the end of a run, and after the loss of clients and devices.
        thermal: Temperature limits.
        feedback_rate: Highest rate of feedback [Hz].
        statistics_window: Interval of device status and loop statistics [s].
        free_motion: The free motion of actuators learned before the start, by name.

    Raises:
        ConfigError: if the rate is out of range.
    """

    profile: ProfileSettings = field(default_factory=lambda: ProfileSettings(usual_profile()))
    safety: SafetySettings = field(default_factory=SafetySettings)
    thermal: ThermalSettings = field(default_factory=ThermalSettings)
    feedback_rate: float = 50.0
    statistics_window: float = 1.0
    free_motion: Mapping[str, LearnedMotion] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the rate, which may come from the command line."""
        if not (math.isfinite(self.rate) and MIN_RATE <= self.rate <= MAX_RATE):
            raise ConfigError(
                f"the loop's rate must be {MIN_RATE:g} to {MAX_RATE:g} Hz, not {self.rate:g}"
            )

    @property
    def period(self) -> float:
        """Time between ticks [s]."""
        return 1.0 / self.rate
