"""Profiles between set-points."""

from __future__ import annotations

from rtee.errors import ConfigError
from rtee.hand.config_schema import ProfileKind, ProfileSettings
from rtee.loop.motion import MotionLimits
from rtee.loop.profiles.base import Profile
from rtee.loop.profiles.s_curve import SCurve
from rtee.loop.profiles.stepwise import Filter, Step

__all__ = ["Profile", "make_profile"]


def make_profile(settings: ProfileSettings, limits: MotionLimits, period: float) -> Profile:
    """Return a profile.

    Args:
        settings: Kind and parameters of the profile.
        limits: Limits of the actuators.
        period: Time between ticks [s].

    Raises:
        ConfigError: if the profile needs ruckig, and that is not installed.
    """
    match settings.kind:
        case ProfileKind.JERK_LIMITED:
            # Imported here: ruckig has no package for ARM.
            try:
                from rtee.loop.profiles.jerk_limited import JerkLimited
            except ImportError:
                raise ConfigError(
                    "the profile 'jerk_limited' needs ruckig, which is not installed: pip install"
                    " ruckig (where there is no package of it, this needs a C++ compiler), or use"
                    " the profile 's_curve'"
                ) from None
            return JerkLimited(limits, period)
        case ProfileKind.S_CURVE:
            return SCurve(limits, period)
        case ProfileKind.FILTER:
            return Filter(limits, period, settings.bandwidth)
        case ProfileKind.STEP:
            return Step(limits, period)
