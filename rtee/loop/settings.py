"""The settings of a loop and its devices: those of hand.yaml, and some that it does not have."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

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
    """A device of a hand, as the supervisor needs it.

    Attributes:
        spec: What the driver is made from.
        reconnect_active: Activate again by itself after the link came back; else stay inactive.
    """

    spec: DeviceSpec
    reconnect_active: bool = False


@dataclass(frozen=True, slots=True)
class LoopSettings(LoopSection):
    """The loop of one hand.

    Attributes:
        profile: The profile between set-points.
        safety: What happens when something ends or breaks.
        thermal: Temperatures.
        feedback_rate: Feedback is given at most this often [Hz].
        statistics_window: Device status and loop statistics are given this often [s].

    Raises:
        ConfigError: if the rate is out of range.
    """

    profile: ProfileSettings = field(default_factory=lambda: ProfileSettings(usual_profile()))
    safety: SafetySettings = field(default_factory=SafetySettings)
    thermal: ThermalSettings = field(default_factory=ThermalSettings)
    feedback_rate: float = 50.0
    statistics_window: float = 1.0

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
