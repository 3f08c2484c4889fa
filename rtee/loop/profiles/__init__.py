"""Profiles between set-points."""

from rtee.loop.profiles.base import Profile
from rtee.loop.profiles.make import make_profile

__all__ = ["Profile", "make_profile"]
