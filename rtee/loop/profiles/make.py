"""Make the profile that the settings name."""

from __future__ import annotations

from rtee.loop.motion import Limits
from rtee.loop.profiles.base import Profile
from rtee.loop.profiles.jerk_limited import JerkLimited
from rtee.loop.profiles.stepwise import Filter, Step
from rtee.loop.settings import ProfileKind, ProfileSettings


def make_profile(settings: ProfileSettings, limits: Limits, period: float) -> Profile:
    """Return a profile.

    Args:
        settings: Which one.
        limits: Limits of the actuators.
        period: Time between ticks [s].
    """
    match settings.kind:
        case ProfileKind.JERK_LIMITED:
            return JerkLimited(limits, period)
        case ProfileKind.FILTER:
            return Filter(limits, period, settings.bandwidth)
        case ProfileKind.STEP:
            return Step(limits, period)
